"""Color models of the background, per pixel, and of the person's surface, per vertex.

The background model averages what earlier frames of a static camera have shown behind the person.
The appearance model averages each vertex's color over the frames in which it faces the camera: near
the border pixels are mixtures, and two pixels further in the surface may look different (a sole, a
collar, a stripe), but a person who turns shows each part of the surface from the front once.
"""

from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from capture.camera import Camera
from preprocess.masks.clothing_offset import ClothedBody

BACKGROUND_MAX_DIFFERENCE = 10.0
"""Largest difference from the background model, in levels, of a pixel that is background."""
FOREGROUND_MIN_DIFFERENCE = 18.0
"""Least difference from the background at any brightness, in levels, of a pixel that is person."""

MIN_LIGHT_GAIN = 0.5
"""Darkest factor by which the person's shadow changes the background."""
MAX_LIGHT_GAIN = 1.1
"""Brightest factor by which light reflected by the person changes the background."""

MIN_BACKGROUND_COUNT = 2.0
"""Frames in which a pixel must have been background before the model is used there."""

BACKGROUND_MEMORY_FRAMES = 20.0
"""Length of the running mean, frames: light changes."""

CAMERA_MOVED_PX = 0.5
"""Motion of the image corners at 5 m, px, from which the camera sees another background."""

MIN_BACKGROUND_SPREAD = 5.0
"""Least standard deviation of the background, in levels."""
LIGHT_BLUR_PX = 3.0
"""Gaussian σ, px, over which the background's brightness is estimated."""

CHANGED_DIFFERENCE = 12.0
"""Difference from the model, in levels, of a background pixel that has changed."""
MAX_CHANGED_FRACTION = 0.25
"""Fraction of changed background pixels from which the camera has moved, whatever its pose says."""
CHANGE_CHECK_STRIDE = 2
"""Check every n-th row and column for changes."""

PixelMask = Bool[np.ndarray, "height width"]


@final
class BackgroundModel:
    """Running mean and variance of the background of one static camera, per pixel."""

    def __init__(self) -> None:
        """Start empty."""
        self._mean: Float32[np.ndarray, "height width 3"] | None = None
        self._variance: Float32[np.ndarray, "height width"] | None = None
        self._times: Float32[np.ndarray, "height width"] | None = None
        self._camera: Camera | None = None

    @property
    def is_initialized(self) -> bool:
        """Whether the model holds any background."""
        return self._mean is not None

    def classify(
        self, rgb: UInt8[np.ndarray, "height width 3"], uncertain: PixelMask
    ) -> tuple[PixelMask, PixelMask]:
        """Uncertain pixels that are background, and those that are person; others are neither.

        A shadow of the person is neither: it has the background's color, only darker, I = g B
        (Horprasert et al. 1999, a statistical approach for background subtraction and shadow
        detection). So a pixel is person if no brightness g of the background comes near it.
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
        """Clear the model if the camera has moved.

        Args:
            camera: Camera of the image's size.
            rgb: The image.
            background: Pixels that are certainly not person.
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
        """Background behind the person at the brightness beside them, and its standard deviation.

        Args:
            rgb: The image.
            background: Pixels that are certainly not person.

        Returns:
            None of an empty model; where too few frames were seen, the deviation is infinite.
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
        """Average the certain background pixels of an image into the model."""
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
        # Welford 1962: the variance takes the squared deviation across the old and the new mean.
        squared = np.einsum("hwc,hwc->hw", off, off) / np.float32(3.0)
        self._variance += share * ((np.float32(1.0) - share) * squared - self._variance)


MIN_FACING_COSINE = 0.5
"""Least cosine between normal and ray at which a vertex's color is learnt."""
MIN_INSIDE_PX = 2.0
"""Least distance from the mask's border at which a color is learnt, px."""
RIM_COSINES = -0.3, 0.6
"""Range of cosines in which vertices predict the color along the outline."""

DEPTH_CELL_PX = 2
"""Edge of the depth buffer's cells, px."""
OCCLUSION_SLACK_M = 0.06
"""Depth behind the nearest vertex of neighboring cells from which a vertex is hidden, metres."""

COLOR_BLUR_PX = 1.0
"""Gaussian σ, px, by which vertex colors are spread over the image."""
COLOR_MARGIN_PX = 6
"""Margin around the rim's vertices in which colors are predicted, px."""
MIN_COLOR_WEIGHT = 1e-4
"""Least weight of spread vertex colors at which a color is predicted."""
KNOWN_VIEW_WEIGHT = 1.0
"""Sum of squared cosines over the views from which a vertex's color is known."""
MIN_COLOR_SPREAD = 8.0
"""Least standard deviation of a predicted color, in levels."""
UNSEEN_COLOR_SPREAD = 30.0
"""Further standard deviation where only neighboring vertices are known, in levels."""


class VertexVisibility(NamedTuple):
    """How a camera sees the vertices of the clothed body.

    Attributes:
        pixels: Image coordinates, px.
        facing: Cosine between normal and ray; negative if a vertex faces away.
        visible: Whether no nearer vertex occludes it.
    """

    pixels: Float[np.ndarray, "vertices 2"]
    facing: Float[np.ndarray, "vertices"]
    visible: Bool[np.ndarray, "vertices"]

    @classmethod
    def of(cls, clothed: ClothedBody, camera: Camera) -> "VertexVisibility":
        """Visibility of the body's vertices, each lifted by its clothing offset."""
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
    """Mean color and spread of one person's surface, per vertex."""

    def __init__(self, count: int) -> None:
        """Start with this many unobserved vertices."""
        self._seen = np.zeros(count)
        self._sums = np.zeros((count, 4))  # red, green, blue, and the mean of their squares

    def update(
        self,
        visibility: VertexVisibility,
        rgb: UInt8[np.ndarray, "height width 3"],
        inside_px: Float32[np.ndarray, "height width"],
    ) -> None:
        """Learn the colors of the vertices that face the camera.

        Args:
            visibility: How the camera sees them.
            rgb: The image.
            inside_px: Distance of each pixel inside the person's border, px.
        """
        facing = np.flatnonzero(visibility.visible & (visibility.facing > MIN_FACING_COSINE))
        x, y = (visibility.pixels[facing] - 0.5).astype(np.float32).T.reshape(2, -1, 1)
        inside = cv2.remap(inside_px, x, y, cv2.INTER_LINEAR)[:, 0] > MIN_INSIDE_PX
        colors = cv2.remap(rgb, x, y, cv2.INTER_LINEAR).reshape(-1, 3)[inside].astype(np.float64)
        facing = facing[inside]
        weight = visibility.facing[facing] ** 2
        self._seen[facing] += weight
        self._sums[facing, :3] += weight[:, None] * colors
        self._sums[facing, 3] += weight * (colors**2).mean(axis=1)

    def predict(
        self, visibility: VertexVisibility, size_px: tuple[int, int]
    ) -> tuple[Float32[np.ndarray, "height width 3"], Float32[np.ndarray, "height width"]]:
        """Predicted color of the person in each pixel along the outline, and its spread.

        The spread is infinite far from all vertices of the rim.
        """
        width, height = size_px
        color = np.zeros((height, width, 3), dtype=np.float32)
        spread = np.full((height, width), np.inf, dtype=np.float32)
        low, high = RIM_COSINES
        rim = visibility.visible & (visibility.facing > low) & (visibility.facing < high)
        rim &= ((visibility.pixels >= 0.0) & (visibility.pixels < size_px)).all(axis=1)
        if rim.any():
            column, row = visibility.pixels[rim].astype(int).T
            margin = COLOR_MARGIN_PX
            box = (
                slice(max(0, row.min() - margin), row.max() + margin),
                slice(max(0, column.min() - margin), column.max() + margin),
            )
            rows, columns = spread[box].shape
            flat = (row - box[0].start) * columns + column - box[1].start
            splatted = self._splat(flat, rim, rows * columns).reshape(rows, columns, 6)
            color[box], spread[box] = _interpolate_colors(splatted)
        return color, spread

    def _splat(
        self, pixels: Int[np.ndarray, "rim"], rim: Bool[np.ndarray, "vertices"], count: int
    ) -> Float32[np.ndarray, "count 6"]:
        """Sums over the vertices in each pixel: color, square, known vertices, all vertices."""
        seen = self._seen[rim]
        known = np.minimum(seen / KNOWN_VIEW_WEIGHT, 1.0)
        mean = self._sums[rim] / np.maximum(seen, 1e-9)[:, None]
        sums = [*(known * mean.T), known, np.ones(len(known))]
        planes = [np.bincount(pixels, each, minlength=count) for each in sums]
        return np.stack(planes, axis=-1).astype(np.float32)


def _interpolate_colors(
    splatted: Float32[np.ndarray, "rows columns 6"],
) -> tuple[Float32[np.ndarray, "rows columns 3"], Float32[np.ndarray, "rows columns"]]:
    """Blurred color and spread of splatted vertex colors."""
    splatted = cv2.GaussianBlur(splatted, (0, 0), COLOR_BLUR_PX)
    weight = np.maximum(splatted[..., 4], np.float32(MIN_COLOR_WEIGHT))
    mean = splatted[..., :4] / weight[..., None]
    variance = np.maximum(mean[..., 3] - (mean[..., :3] ** 2).mean(axis=-1), np.float32(0.0))
    share = splatted[..., 4] / np.maximum(splatted[..., 5], np.float32(MIN_COLOR_WEIGHT))
    spread = np.sqrt(variance + np.float32(MIN_COLOR_SPREAD**2))
    spread += (np.float32(1.0) - share) * np.float32(UNSEEN_COLOR_SPREAD)
    return mean[..., :3], np.where(splatted[..., 4] > MIN_COLOR_WEIGHT, spread, np.float32(np.inf))
