"""What earlier frames have shown behind the person, if the camera stands still."""

from typing import final

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.camera import Camera

LIKE, UNLIKE = 10.0, 18.0
"""Colours nearer to what was seen behind the person are background, farther ones are person."""

DARKEST, BRIGHTEST = 0.5, 1.1
"""Shadows, and what the person reflects, darken and brighten the background by such factors."""

TRUSTED = 2.0
"""How often a pixel must have been background before it says anything."""

REMEMBERED = 20.0
"""Over how many frames the background is averaged; light changes."""

MOVED_PX = 0.5
"""A camera that moved more than this in the picture sees another background."""

OTHER, MOST_OTHER = 12.0, 0.25
"""Where more of the background than this differs by so much from before, the camera has moved even
if nobody says so."""

Pixels = Bool[np.ndarray, "height width"]


@final
class Behind:
    """The background of one camera, pixel by pixel."""

    def __init__(self) -> None:
        """Nothing is known yet."""
        self._mean: Float32[np.ndarray, "height width 3"] | None = None
        self._times: Float32[np.ndarray, "height width"] | None = None
        self._camera: Camera | None = None

    @property
    def known(self) -> bool:
        """Whether anything is remembered."""
        return self._mean is not None

    def compared(
        self, rgb: UInt8[np.ndarray, "height width 3"], doubtful: Pixels
    ) -> tuple[Pixels, Pixels]:
        """Doubtful pixels that look like what was seen there before, and those that do not.

        A shadow of the person is neither: it is the background's colour, only darker, I = g B
        (Horprasert et al. 1999, a statistical approach for background subtraction and shadow
        detection). So person is what no brightness g of the background comes near to.
        """
        if self._mean is None or self._times is None:
            nothing = np.zeros(doubtful.shape, dtype=bool)
            return nothing, nothing
        known = doubtful & (self._times >= TRUSTED)
        like, unlike = np.zeros_like(known), np.zeros_like(known)
        seen, before = rgb[known].astype(np.float32), self._mean[known]
        squared = np.maximum((before**2).sum(axis=-1), np.float32(1.0))
        gain = np.clip((seen * before).sum(axis=-1) / squared, DARKEST, BRIGHTEST)
        like[known] = np.abs(seen - before).max(axis=-1) < LIKE
        unlike[known] = np.abs(seen - gain[:, None] * before).max(axis=-1) > UNLIKE
        return like, unlike & ~like

    def seen_by(
        self, camera: Camera, rgb: UInt8[np.ndarray, "height width 3"], free: Pixels
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
            far = camera.center_world + 5.0 * camera.directions(corners)
            same = bool((np.abs(before.project(far) - corners) < MOVED_PX).all())
        if same:
            known = free & (self._times > 0.0)
            off = np.abs(rgb[known] - self._mean[known]).max(axis=-1, initial=0.0)
            same = not len(off) or float((off > OTHER).mean()) < MOST_OTHER
        if not same:
            self._mean = self._times = None

    def learn(self, rgb: UInt8[np.ndarray, "height width 3"], free: Pixels) -> None:
        """Takes in the pixels of a picture where the person surely is not."""
        if self._mean is None or self._times is None:
            self._mean = np.zeros(rgb.shape, np.float32)
            self._times = np.zeros(free.shape, np.float32)
        self._times[free] += 1.0
        share = 1.0 / np.minimum(self._times[free], REMEMBERED)
        self._mean[free] += (rgb[free] - self._mean[free]) * share[:, None]
