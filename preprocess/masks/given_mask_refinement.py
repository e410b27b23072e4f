"""Refines given masks whose borders miss the edges in the picture, as segmenters' masks often do.

Where a mask is right, the picture changes along its border: color is a mixture of person and
background by alpha, so that the picture's gradient follows that of alpha. Given masks are refined
(`MaskRefiner`) and the two borders compared; only if the picture changes clearly more along the
refined one is it used. Exact masks stay as they are.
"""

from typing import final

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from preprocess.masks.mask_refinement import MaskRefiner
from preprocess.tracking.keypoints import CroppedMask

COMPARED_FRAMES = 10
"""Frames whose borders are compared; what they say holds for all others."""
MIN_EDGE_RATIO = 1.15
"""Ratio of the edge strengths along refined and given borders from which masks are refined; noise
in the pictures alone makes it up to 1.12."""
SQUARE_PX = 256
"""Width and height of the square that holds the person, as in a tracker's masks."""
SQUARE_MARGIN = 1.25
"""Its width as a multiple of the person's longer side."""


Plane = Float32[np.ndarray, "rows columns"]


@final
class GivenMaskRefiner:
    """Refines the masks of a recording or a stream, frame by frame in order, if that is needed."""

    def __init__(self) -> None:
        """Nothing is known yet."""
        self._refiner: MaskRefiner | None = None
        self._size_px = (0, 0)
        self._ratios: list[float] = []

    @property
    def is_needed(self) -> bool:
        """Whether masks are refined, by the frames that were seen; at first they are not."""
        return bool(self._ratios) and float(np.mean(self._ratios)) >= MIN_EDGE_RATIO

    @property
    def note(self) -> str | None:
        """What a user should know of it; None if the masks stay as they are."""
        if not self.is_needed:
            return None
        return (
            "The borders of the given masks miss the edges in the pictures and were refined (edges "
            f"are {np.mean(self._ratios):.1f} times as strong along the refined ones). "
            "--no-refine-masks uses the masks as they are."
        )

    @property
    def keeps_given_masks(self) -> bool:
        """Whether enough frames have shown that the given masks need no refinement."""
        return len(self._ratios) >= COMPARED_FRAMES and not self.is_needed

    def __call__(
        self, rgb: UInt8[np.ndarray, "rows columns 3"], alpha: Plane, size_px: tuple[int, int]
    ) -> Float32[np.ndarray, "height width"]:
        """Refine the mask of the next frame.

        Args:
            rgb: The frame.
            alpha: Its given mask, of the same size.
            size_px: Width and height of the result.

        Returns:
            The refined mask, or the given one if that is as good.
        """
        found = alpha
        if not self.keeps_given_masks and (alpha > 0.5).any():
            refined = self._refine(rgb, alpha)
            if len(self._ratios) < COMPARED_FRAMES:
                given = edge_strength(rgb, alpha)
                self._ratios.append(edge_strength(rgb, refined) / max(given, 1e-6))
            found = refined if self.is_needed else alpha
        if size_px == (rgb.shape[1], rgb.shape[0]):
            return found
        return np.asarray(cv2.resize(found, size_px, interpolation=cv2.INTER_AREA), np.float32)

    def _refine(self, rgb: UInt8[np.ndarray, "rows columns 3"], alpha: Plane) -> Plane:
        size_px = rgb.shape[1], rgb.shape[0]
        if self._refiner is None or size_px != self._size_px:
            self._refiner, self._size_px = MaskRefiner(size_px), size_px
        return self._refiner(rgb, _crop(alpha))


def edge_strength(
    rgb: UInt8[np.ndarray, "height width 3"], alpha: Float32[np.ndarray, "height width"]
) -> float:
    """How much a picture changes along a mask's border.

    Returns:
        Change of color across the border per pixel, levels; mean over the border, weighted by
        the gradient of alpha.
    """
    border, slopes = _gradient(alpha), [_gradient(channel) for channel in cv2.split(rgb)]
    steepness = np.hypot(*border)
    across = [(border[0] * x + border[1] * y) / np.maximum(steepness, 1e-6) for x, y in slopes]
    change = np.sqrt(sum(each**2 for each in across))
    return float((change * steepness).sum() / max(float(steepness.sum()), 1e-6))


def _gradient(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Change per pixel to the right and down (Scharr)."""
    x, y = (cv2.Scharr(plane, cv2.CV_32F, *axis, scale=1.0 / 32.0) for axis in ((1, 0), (0, 1)))
    return x, y


def _crop(alpha: Float32[np.ndarray, "height width"]) -> CroppedMask:
    """The square around the person, as a tracker would cut it out."""
    rows, columns = np.nonzero(alpha > 0.5)
    low = np.array([columns.min(), rows.min()], np.float64)
    high = np.array([columns.max(), rows.max()], np.float64) + 1.0
    scale = SQUARE_MARGIN * float((high - low).max()) / SQUARE_PX
    corner = 0.5 * (low + high) - 0.5 * SQUARE_PX * scale
    image_from_crop = np.column_stack([scale * np.eye(2), corner])
    there = image_from_crop.copy()
    there[:, 2] += 0.5 * scale - 0.5  # to OpenCV's pixels, whose middles are at 0
    way = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    values = cv2.warpAffine(255.0 * alpha, there, (SQUARE_PX, SQUARE_PX), flags=way)
    return CroppedMask(values=np.rint(values).astype(np.uint8), image_from_crop=image_from_crop)
