"""What earlier frames have shown behind the person, if the camera stands still."""

from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.camera import Camera

BACKGROUND_MAX_DIFFERENCE, FOREGROUND_MIN_DIFFERENCE = 10.0, 18.0
"""AppearanceModel nearer to what was seen behind the person are background, farther ones are person."""

MIN_LIGHT_GAIN, MAX_LIGHT_GAIN = 0.5, 1.1
"""Shadows, and what the person reflects, darken and brighten the background by such factors."""

MIN_BACKGROUND_COUNT = 2.0
"""How often a pixel must have been background before it says anything."""

BACKGROUND_MEMORY_FRAMES = 20.0
"""Over how many frames the background is averaged; light changes."""

CAMERA_MOVED_PX = 0.5
"""A camera that moved more than this in the picture sees another background."""

MIN_BACKGROUND_SPREAD = 5.0
"""The background is never known better than this, in levels."""
LIGHT_BLUR_PX = 3.0
"""How far around the brightness of the background is the same (a Gaussian's σ)."""

CHANGED_DIFFERENCE, MAX_CHANGED_FRACTION = 12.0, 0.25
"""Where more of the background than this differs by so much from before, the camera has moved even
if nobody says so."""
CHANGE_CHECK_STRIDE = 2
"""Every so manieth row and column is asked about that."""

PixelMask = Bool[np.ndarray, "height width"]


@final
class BackgroundModel:
    """The background of one camera, pixel by pixel."""

    def __init__(self) -> None:
        """Nothing is known yet."""
        self._mean: Float32[np.ndarray, "height width 3"] | None = None
        self._variance: Float32[np.ndarray, "height width"] | None = None
        self._times: Float32[np.ndarray, "height width"] | None = None
        self._camera: Camera | None = None

    @property
    def is_initialized(self) -> bool:
        """Whether anything is remembered."""
        return self._mean is not None

    def classify(
        self, rgb: UInt8[np.ndarray, "height width 3"], uncertain: PixelMask
    ) -> tuple[PixelMask, PixelMask]:
        """Doubtful pixels that look like what was seen there before, and those that do not.

        A shadow of the person is neither: it is the background's colour, only darker, I = g B
        (Horprasert et al. 1999, a statistical approach for background subtraction and shadow
        detection). So person is what no brightness g of the background comes near to.
        """
        if self._mean is None or self._times is None:
            nothing = np.zeros(uncertain.shape, dtype=bool)
            return nothing, nothing
        known = uncertain & (self._times >= MIN_BACKGROUND_COUNT)
        like, unlike = np.zeros_like(known), np.zeros_like(known)
        seen, before = rgb[known].astype(np.float32), self._mean[known]
        squared = np.maximum((before**2).sum(axis=-1), np.float32(1.0))
        gain = np.clip((seen * before).sum(axis=-1) / squared, MIN_LIGHT_GAIN, MAX_LIGHT_GAIN)
        like[known] = np.abs(seen - before).max(axis=-1) < BACKGROUND_MAX_DIFFERENCE
        unlike[known] = np.abs(seen - gain[:, None] * before).max(axis=-1) > FOREGROUND_MIN_DIFFERENCE
        return like, unlike & ~like

    def reset_if_moved(
        self, camera: Camera, rgb: UInt8[np.ndarray, "height width 3"], background: PixelMask
    ) -> None:
        """Forgets all if the camera looks elsewhere.

        Args:
            camera: Of the picture's size.
            rgb: The picture.
            free: Where the person surely is not.
        """
        before, self._camera = self._camera, camera
        if before is None or self._mean is None or self._times is None:
            return
        width, height = camera.size_px
        corners = np.array([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]])
        same = before.size_px == camera.size_px
        if same and not np.array_equal(before.camera_from_world, camera.camera_from_world):
            far = camera.center_world + 5.0 * camera.ray_directions(corners)
            same = bool((np.abs(before.project(far) - corners) < CAMERA_MOVED_PX).all())
        if same:
            some = np.s_[::CHANGE_CHECK_STRIDE, ::CHANGE_CHECK_STRIDE]
            known = background[some] & (self._times[some] > 0.0)
            off = np.abs(rgb[some][known] - self._mean[some][known]).max(axis=-1, initial=0.0)
            same = not len(off) or float((off > CHANGED_DIFFERENCE).mean()) < MAX_CHANGED_FRACTION
        if not same:
            self._mean = self._variance = self._times = None

    def predict(
        self, rgb: UInt8[np.ndarray, "height width 3"], background: PixelMask
    ) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]] | None:
        """What lies behind the person, as bright as it is beside, and its standard deviation.

        Args:
            rgb: The picture.
            free: Where the person surely is not.

        Returns:
            None if nothing is known yet; where not enough is, the deviation is infinite.
        """
        if self._mean is None or self._variance is None or self._times is None:
            return None
        known, mean = self._times >= MIN_BACKGROUND_COUNT, self._mean
        if not known.any():
            return None
        beside = (known & background).astype(np.float32)
        seen = np.einsum("hwc,hwc->hw", rgb, mean, dtype=np.float32) * beside
        before = np.einsum("hwc,hwc->hw", mean, mean) * beside
        seen, before = (cv2.GaussianBlur(each, (0, 0), LIGHT_BLUR_PX) for each in (seen, before))
        gain = np.clip((seen + 1.0) / (before + 1.0), MIN_LIGHT_GAIN, MAX_LIGHT_GAIN).astype(np.float32)
        spread = np.sqrt(np.maximum(self._variance, np.float32(MIN_BACKGROUND_SPREAD**2)))
        return mean * gain[..., None], np.where(known, spread, np.float32(np.inf))

    def update(self, rgb: UInt8[np.ndarray, "height width 3"], background: PixelMask) -> None:
        """Takes in the pixels of a picture where the person surely is not."""
        if self._mean is None or self._variance is None or self._times is None:
            self._mean = np.zeros(rgb.shape, np.float32)
            self._variance = np.zeros(background.shape, np.float32)
            self._times = np.zeros(background.shape, np.float32)
        self._times += background
        share = background / np.clip(self._times, np.float32(1.0), np.float32(BACKGROUND_MEMORY_FRAMES))
        off = rgb - self._mean
        self._mean += off * share[..., None]
        # Welford 1962: of what is new, its part across the new mean is the variance's
        squared = np.einsum("hwc,hwc->hw", off, off) / np.float32(3.0)
        self._variance += share * ((np.float32(1.0) - share) * squared - self._variance)
