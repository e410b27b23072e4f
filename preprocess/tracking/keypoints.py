"""Key points of one person in one frame, as a tracker's networks find them.

The 33 key points are those of BlazePose (Bazarevsky et al. 2020, arXiv:2006.10204): 0 nose, 1-6
eyes, 7-8 ears, 9-10 mouth, 11-12 shoulders, 13-14 elbows, 15-16 wrists, 17-22 fingers, 23-24 hips,
25-26 knees, 27-28 ankles, 29-30 heels, 31-32 toes; of each pair the person's left one first.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8

KEYPOINT_COUNT = 33
"""Number of key points of a person."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CroppedMask:
    """How far each pixel of a small square around the person is person.

    Attributes:
        values: 255 where a pixel is certainly person, 0 where it certainly is not.
        image_from_crop: Affine map from pixels of the square to pixels of the frame; in both, the
            first pixel's middle is at (0.5, 0.5).
    """

    values: UInt8[np.ndarray, "rows columns"]
    image_from_crop: Float[np.ndarray, "2 3"]

    def resample(
        self, frame_px: tuple[int, int], size_px: tuple[int, int]
    ) -> Float32[np.ndarray, "height width"]:
        """The mask of a whole frame, in [0, 1]; 0 outside the square.

        Args:
            frame_px: Width and height of the frame.
            size_px: Width and height of the mask to make.
        """
        import cv2  # heavy, and players, which read poses, do without

        scale = np.array(size_px) / np.array(frame_px)
        there = self.image_from_crop * scale[:, None]
        there[:, 2] += 0.5 * there[:, :2].sum(axis=1) - 0.5  # to OpenCV's pixels, middles at 0
        return cv2.warpAffine(self.values, there, size_px, flags=cv2.INTER_LINEAR).astype(
            np.float32
        ) / np.float32(255.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonKeypoints:
    """What a tracker finds of one person in one frame.

    Attributes:
        image_px: Key points in the frame, pixels; the first pixel's middle is at (0.5, 0.5). Some
            may lie outside the frame.
        world_m: The same in space, metres: the camera's axes (x right, y down, z away), from the
            middle of the hips. Their size and their depth are guesses.
        visibility: Probability that a key point is in the frame and not hidden.
        presence: Probability that a person is there at all.
        mask: How far each pixel is person.
        crowded: Whether another person is so near that the two may be mixed up.
    """

    image_px: Float[np.ndarray, "33 2"]
    world_m: Float[np.ndarray, "33 3"]
    visibility: Float[np.ndarray, "33"]
    presence: float
    mask: CroppedMask
    crowded: bool = False
