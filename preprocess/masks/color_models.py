"""What earlier frames have shown behind the person, if the camera stands still.

What colours the person has, vertex by vertex, learnt where the surface faces the camera.

A pixel of the border is a mixture, and two pixels farther in the person may look different: a sole
below a shoe, a collar, a stripe. But who turns shows each part of the surface from the front once.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from capture.camera import Camera
from preprocess.masks.clothing_offset import ClothedBody

BACKGROUND_MAX_DIFFERENCE, FOREGROUND_MIN_DIFFERENCE = 10.0, 18.0
"""Colors nearer to what was seen behind the person are background, farther ones are person."""

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
        unlike[known] = (
            np.abs(seen - gain[:, None] * before).max(axis=-1) > FOREGROUND_MIN_DIFFERENCE
        )
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
        gain = np.clip((seen + 1.0) / (before + 1.0), MIN_LIGHT_GAIN, MAX_LIGHT_GAIN).astype(
            np.float32
        )
        spread = np.sqrt(np.maximum(self._variance, np.float32(MIN_BACKGROUND_SPREAD**2)))
        return mean * gain[..., None], np.where(known, spread, np.float32(np.inf))

    def update(self, rgb: UInt8[np.ndarray, "height width 3"], background: PixelMask) -> None:
        """Takes in the pixels of a picture where the person surely is not."""
        if self._mean is None or self._variance is None or self._times is None:
            self._mean = np.zeros(rgb.shape, np.float32)
            self._variance = np.zeros(background.shape, np.float32)
            self._times = np.zeros(background.shape, np.float32)
        self._times += background
        share = background / np.clip(
            self._times, np.float32(1.0), np.float32(BACKGROUND_MEMORY_FRAMES)
        )
        off = rgb - self._mean
        self._mean += off * share[..., None]
        # Welford 1962: of what is new, its part across the new mean is the variance's
        squared = np.einsum("hwc,hwc->hw", off, off) / np.float32(3.0)
        self._variance += share * ((np.float32(1.0) - share) * squared - self._variance)


MIN_FACING_COSINE = 0.5
"""Colors are learnt where the cosine between normal and ray is greater."""
MIN_INSIDE_PX = 2.0
"""And where the mask's border is farther away than this."""
RIM_COSINES = -0.3, 0.6
"""Vertices between these cosines show their colour along the outline."""

DEPTH_CELL_PX = 2
"""So large are the pixels in which it is seen which vertex hides which."""
OCCLUSION_SLACK_M = 0.06
"""What is so much deeper than the nearest vertex beside it is hidden."""

COLOR_BLUR_PX = 1.0
"""How far around it a vertex tells the colour (a Gaussian's σ)."""
COLOR_MARGIN_PX, MIN_COLOR_WEIGHT = 6, 1e-4
"""Farther away, and where so little is told, nothing is."""
KNOWN_VIEW_WEIGHT = 1.0
"""A vertex seen so often from the front is known."""
MIN_COLOR_SPREAD = 8.0
"""Colors are never surer than this, in levels."""
UNSEEN_COLOR_SPREAD = 30.0
"""And this sure where only neighbours are known."""


class VertexVisibility(NamedTuple):
    """How a camera sees the vertices of the shell.

    Attributes:
        pixels: Where, in pixels.
        facing: The cosine between normal and ray; negative if it looks away.
        seen: Whether nothing nearer hides it.
    """

    pixels: Float[np.ndarray, "vertices 2"]
    facing: Float[np.ndarray, "vertices"]
    visible: Bool[np.ndarray, "vertices"]

    @classmethod
    def of(cls, clothed: ClothedBody, camera: Camera) -> "VertexVisibility":
        """The sight of a shell, every vertex lifted by its thickness."""
        points = clothed.skin + clothed.normals * clothed.offset_m[:, None]
        rays = camera.center_world - points
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        pixels = camera.project(points)
        depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        size = tuple(each // DEPTH_CELL_PX + 1 for each in camera.size_px)
        column, row = np.clip((pixels / DEPTH_CELL_PX).astype(int), 0, np.array(size) - 1).T
        nearest = np.full(size[::-1], np.inf, dtype=np.float32)
        np.minimum.at(nearest, (row, column), depth.astype(np.float32))
        nearest = cv2.erode(nearest, np.ones((3, 3), np.uint8))
        return cls(
            pixels=pixels,
            facing=np.einsum("va,va->v", clothed.normals, rays),
            visible=depth < nearest[row, column] + OCCLUSION_SLACK_M,
        )


@final
class AppearanceModel:
    """The colours of one person's surface."""

    def __init__(self, count: int) -> None:
        """Nothing is known yet of so many vertices."""
        self._seen = np.zeros(count)
        self._sums = np.zeros((count, 4))  # of red, green, blue, and of their squares' mean

    def update(
        self,
        visibility: VertexVisibility,
        rgb: UInt8[np.ndarray, "height width 3"],
        inside_px: Float32[np.ndarray, "height width"],
    ) -> None:
        """Takes in what a picture shows of the vertices that face the camera.

        Args:
            sight: How the camera sees them.
            rgb: The picture.
            inside_px: How far each pixel is inside the person.
        """
        facing = np.flatnonzero(visibility.visible & (visibility.facing > MIN_FACING_COSINE))
        x, y = (visibility.pixels[facing] - 0.5).astype(np.float32).T.reshape(2, -1, 1)
        inside = cv2.remap(inside_px, x, y, cv2.INTER_LINEAR)[:, 0] > MIN_INSIDE_PX
        colours = cv2.remap(rgb, x, y, cv2.INTER_LINEAR).reshape(-1, 3)[inside].astype(np.float64)
        facing = facing[inside]
        weight = visibility.facing[facing] ** 2
        self._seen[facing] += weight
        self._sums[facing, :3] += weight[:, None] * colours
        self._sums[facing, 3] += weight * (colours**2).mean(axis=1)

    def predict(
        self, visibility: VertexVisibility, size_px: tuple[int, int]
    ) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
        """The colour that the person should have in each pixel along the outline, and its spread.

        Far from all known vertices of the rim the spread is infinite.
        """
        width, height = size_px
        colour = np.zeros((height, width, 3), dtype=np.float32)
        spread = np.full((height, width), np.inf, dtype=np.float32)
        low, high = RIM_COSINES
        rim = visibility.visible & (visibility.facing > low) & (visibility.facing < high)
        rim &= ((visibility.pixels >= 0.0) & (visibility.pixels < size_px)).all(axis=1)
        if rim.any():
            column, row = visibility.pixels[rim].astype(int).T
            box = np.s_[max(0, row.min() - COLOR_MARGIN_PX) : row.max() + COLOR_MARGIN_PX,
                        max(0, column.min() - COLOR_MARGIN_PX) : column.max() + COLOR_MARGIN_PX]  # fmt: skip
            rows, columns = spread[box].shape
            flat = (row - box[0].start) * columns + column - box[1].start
            laid = self._splat(flat, rim, rows * columns).reshape(rows, columns, 6)
            colour[box], spread[box] = _interpolate_colors(laid)
        return colour, spread

    def _splat(
        self, pixels: Int[np.ndarray, "rim"], rim: Bool[np.ndarray, "vertices"], count: int
    ) -> Float32[np.ndarray, "count 6"]:
        """Sums over the vertices in each pixel: colour, square, known vertices, and all."""
        seen = self._seen[rim]
        known = np.minimum(seen / KNOWN_VIEW_WEIGHT, 1.0)
        mean = self._sums[rim] / np.maximum(seen, 1e-9)[:, None]
        told = [*(known * mean.T), known, np.ones(len(known))]
        planes = [np.bincount(pixels, each, minlength=count) for each in told]
        return np.stack(planes, axis=-1).astype(np.float32)


def _interpolate_colors(
    splatted: Float32[np.ndarray, "rows columns 6"],
) -> tuple[Float32[np.ndarray, "rows columns 3"], Float32[np.ndarray, "rows columns"]]:
    """Color and spread around what vertices tell."""
    splatted = cv2.GaussianBlur(splatted, (0, 0), COLOR_BLUR_PX)
    told = np.maximum(splatted[..., 4], np.float32(MIN_COLOR_WEIGHT))
    mean = splatted[..., :4] / told[..., None]
    variance = np.maximum(mean[..., 3] - (mean[..., :3] ** 2).mean(axis=-1), np.float32(0.0))
    share = splatted[..., 4] / np.maximum(splatted[..., 5], np.float32(MIN_COLOR_WEIGHT))
    spread = np.sqrt(variance + np.float32(MIN_COLOR_SPREAD**2))
    spread += (np.float32(1.0) - share) * np.float32(UNSEEN_COLOR_SPREAD)
    return mean[..., :3], np.where(splatted[..., 4] > MIN_COLOR_WEIGHT, spread, np.float32(np.inf))
