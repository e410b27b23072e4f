"""Training pixels of an image: those near the person in runs of adjacent ones, and those about."""

from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Int, Int32, Shaped, UInt8

from capture.camera import Camera
from capture.source import AlphaMask

NEAR_MASK_SHARE = 0.035
"""Distance from the mask within which pixels are near the person, in image heights."""
BOX_MARGIN_SHARE = 0.04
"""Margin of the training pixels around the near ones, in image heights."""


class RayView(NamedTuple):
    """Camera of a training frame, and the mask of the pixels near the person, packed in bits."""

    camera: Camera
    near_person_bits: UInt8[np.ndarray, "bytes"]

    @classmethod
    def of(cls, camera: Camera, near: Bool[np.ndarray, "height width"]) -> "RayView":
        """The view of a camera whose pixels near the person are known."""
        return cls(camera, np.packbits(near))

    def near_person(self) -> Bool[np.ndarray, "height width"]:
        """Mask of the pixels near the person."""
        width, height = self.camera.size_px
        bits = np.unpackbits(self.near_person_bits, count=width * height)
        return bits.reshape(height, width) > 0


class PixelRuns(NamedTuple):
    """Pixels of an image in runs of adjacent ones: those near the person, then those about them.

    The pixels are numbered through; 100 bytes of runs stand for a thousand pixels. `ends` are the
    numbers of pixels up to the end of each run, `shifts` the differences between a pixel's flat
    index in the image and its number.
    """

    ends: Int32[np.ndarray, "runs"]
    shifts: Int32[np.ndarray, "runs"]
    near_count: int

    @classmethod
    def of(
        cls, near: Bool[np.ndarray, "height width"], far: Bool[np.ndarray, "height width"]
    ) -> "PixelRuns":
        """The runs of two masks."""
        sides = [_run_sides(mask) for mask in (near, far)]
        starts, stops = (np.concatenate(parts) for parts in zip(*sides, strict=True))
        ends = np.cumsum(stops - starts)
        shifts = stops - ends
        return cls(ends.astype(np.int32), shifts.astype(np.int32), int(near.sum()))

    @property
    def count(self) -> int:
        """Number of pixels."""
        return int(self.ends[-1]) if len(self.ends) else 0

    def flat_indices(self) -> Int[np.ndarray, "pixels"]:
        """Flat indices of all pixels in the image."""
        return np.arange(self.count) + np.repeat(self.shifts, np.diff(self.ends, prepend=0))


class TrainingPixels(NamedTuple):
    """The pixels of an image to train on.

    `colors` are premultiplied RGBA of those near the person; that of the others is zero. With the
    colors alone they can be rebuilt from `view`.
    """

    view: RayView
    runs: PixelRuns
    colors: UInt8[np.ndarray, "near 4"]


def premultiplied_rgba(
    rgb: Shaped[np.ndarray, "height width 3"],
    alpha: AlphaMask,
    near: Bool[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "near 4"]:
    """Color times alpha, and alpha, of the pixels near the person, in 8 bits; `rgb` in levels."""
    places = np.flatnonzero(near)
    alphas = alpha.reshape(-1).take(places)
    colors = rgb.reshape(-1, 3).take(places, axis=0)
    premultiplied = np.empty((4, len(places)), dtype=np.float32)
    for channel in range(3):
        np.multiply(colors[:, channel], alphas, out=premultiplied[channel])
    np.multiply(alphas, np.float32(255.0), out=premultiplied[3])
    rounded = np.rint(premultiplied, out=premultiplied).astype(np.uint8)
    return np.ascontiguousarray(rounded.T)


def near_person_mask(alpha: AlphaMask) -> Bool[np.ndarray, "height width"]:
    """The pixels near the person."""
    kernel = np.ones((max(5, int(NEAR_MASK_SHARE * len(alpha)) | 1),) * 2, dtype=np.uint8)
    return cv2.dilate((alpha > 0).astype(np.uint8), kernel) > 0


def around_person(near: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """The pixels in a box around those near the person."""
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    margin = int(BOX_MARGIN_SHARE * len(near))
    box = np.zeros_like(near)
    box[
        max(0, rows[0] - margin) : rows[-1] + margin + 1,
        max(0, columns[0] - margin) : columns[-1] + margin + 1,
    ] = True
    return box


def _run_sides(
    mask: Bool[np.ndarray, "height width"],
) -> tuple[Int[np.ndarray, "runs"], Int[np.ndarray, "runs"]]:
    """Flat indices at which the runs of a mask begin, and behind which they end."""
    changes = np.flatnonzero(np.diff(mask.reshape(-1).view(np.int8), prepend=0, append=0))
    return changes[::2], changes[1::2]
