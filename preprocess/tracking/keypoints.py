"""Key points of one person, in one frame as a tracker's networks find them, and over time.

The 33 key points are those of BlazePose (Bazarevsky et al. 2020, arXiv:2006.10204): 0 nose, 1-6
eyes, 7-8 ears, 9-10 mouth, 11-12 shoulders, 13-14 elbows, 15-16 wrists, 17-22 fingers, 23-24 hips,
25-26 knees, 27-28 ankles, 29-30 heels, 31-32 toes; of each pair the person's left one first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8

from capture.source import AlphaMask

KEYPOINT_COUNT = 33
"""Number of key points of a person."""
HIPS = (23, 24)
"""Key points of the left and the right hip."""
MIRRORED_POINTS = np.array(
    [0, 4, 5, 6, 1, 2, 3, 8, 7, 10, 9, *(i + 1 if i % 2 else i - 1 for i in range(11, 33))]
)
"""The key point of the other side, for each of the 33."""
MIN_PRESENCE = 0.5
"""Probability of a person below which a frame's key points are not used."""
KEYPOINT_SHAPES = {
    "keypoint_frames": (-1,), "keypoints_px": (-1, 33, 2), "keypoints_m": (-1, 33, 3),
    "keypoint_visibility": (-1, 33), "keypoint_presence": (-1,), "keypoint_image_size": (2,),
    "keypoint_times": (-1,), "keypoint_problems": (-1,),
}  # fmt: skip
"""Arrays that hold key points in a file, and their shapes (-1: one row a frame)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CroppedMask:
    """The mask of a small square around the person: 255 is certainly person, 0 certainly not.

    `image_from_crop` is the affine map from its pixels to those of the frame; in both, the first
    pixel's middle is at (0.5, 0.5).
    """

    values: UInt8[np.ndarray, "rows columns"]
    image_from_crop: Float[np.ndarray, "2 3"]

    def person_px(self) -> float:
        """Area of the person in pixels of the frame."""
        pixel = abs(float(np.linalg.det(self.image_from_crop[:, :2])))
        return pixel * float((self.values > 127).sum())

    def resample(self, frame_px: tuple[int, int], size_px: tuple[int, int]) -> AlphaMask:
        """The mask of a whole frame, in [0, 1], at `size_px` (width, height); 0 off the square."""
        import cv2  # heavy, and players, which read poses, do without

        scale = np.array(size_px) / np.array(frame_px)
        there = self.image_from_crop * scale[:, None]
        there[:, 2] += 0.5 * there[:, :2].sum(axis=1) - 0.5  # to OpenCV's pixels, middles at 0
        return (
            cv2.warpAffine(self.values, there, size_px, flags=cv2.INTER_LINEAR).astype(np.float32)
            / 255.0
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonKeypoints:
    """The key points and the mask of one person in one frame.

    Attributes:
        image_px: Key points in the frame, pixels; the first pixel's middle is at (0.5, 0.5). Some
            may lie outside the frame.
        world_m: The same in space, metres: the camera's axes (x right, y down, z away), from the
            middle of the hips. Their size and their depth are guesses.
        visibility: Probability that a key point is in the frame and not hidden.
        presence: Probability that a person is there at all.
        crowded: Whether another person is so near that the two may be mixed up.
    """

    image_px: Float[np.ndarray, "33 2"]
    world_m: Float[np.ndarray, "33 3"]
    visibility: Float[np.ndarray, "33"]
    presence: float
    mask: CroppedMask
    crowded: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class KeypointTrack:
    """Key points of one person over time, one row a frame in which the person was found.

    They are as in `PersonKeypoints`; `problems` are sums of `PROBLEM_BITS`.
    """

    frames: Int[np.ndarray, "rows"]
    image_px: Float[np.ndarray, "rows 33 2"]
    world_m: Float[np.ndarray, "rows 33 3"]
    visibility: Float[np.ndarray, "rows 33"]
    presence: Float[np.ndarray, "rows"]
    size_px: tuple[int, int]
    times_s: Float[np.ndarray, "rows"] | None = None
    problems: Int[np.ndarray, "rows"] | None = None

    def __len__(self) -> int:
        """Number of frames in which the person was found."""
        return len(self.frames)

    @classmethod
    def of(
        cls,
        frames: Sequence[int],
        found: Sequence[PersonKeypoints],
        size_px: tuple[int, int],
        times_s: Sequence[float] | None = None,
    ) -> "KeypointTrack":
        """Join what was found in some frames of one size."""
        return cls(
            frames=np.array(frames, dtype=np.int64),
            image_px=np.array([each.image_px for each in found]).reshape(-1, 33, 2),
            world_m=np.array([each.world_m for each in found]).reshape(-1, 33, 3),
            visibility=np.array([each.visibility for each in found]).reshape(-1, 33),
            presence=np.array([each.presence for each in found]),
            size_px=size_px,
            times_s=None if times_s is None else np.array(times_s, dtype=np.float64),
        )

    def join(self, later: "KeypointTrack") -> "KeypointTrack":
        """This track and one of later frames, both with times and problems, as one."""
        names = ("frames", "image_px", "world_m", "visibility", "presence", "times_s", "problems")
        both = {name: (getattr(self, name), getattr(later, name)) for name in names}
        return replace(self, **{name: np.concatenate(parts) for name, parts in both.items()})

    def as_arrays(self) -> dict[str, Shaped[np.ndarray, "..."]]:
        """The arrays that a pose file holds of it."""
        arrays = {
            "keypoint_frames": self.frames,
            "keypoints_px": self.image_px.astype(np.float32),
            "keypoints_m": self.world_m.astype(np.float32),
            "keypoint_visibility": self.visibility.astype(np.float32),
            "keypoint_presence": self.presence.astype(np.float32),
            "keypoint_image_size": np.array(self.size_px),
        }
        optional = {"keypoint_times": self.times_s, "keypoint_problems": self.problems}
        return arrays | {key: each for key, each in optional.items() if each is not None}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Shaped[np.ndarray, "..."]]) -> "KeypointTrack | None":
        """Restore what `as_arrays` returned; None if a file's arrays do not hold it.

        A ValueError names the key under which they hold something else.
        """
        if "keypoint_frames" not in arrays:
            return None
        count = arrays["keypoint_frames"].size
        found: dict[str, Shaped[np.ndarray, ...]] = {}
        for key, shape in KEYPOINT_SHAPES.items():
            if key in ("keypoint_times", "keypoint_problems") and key not in arrays:
                continue
            if key not in arrays or arrays[key].dtype.kind not in "iuf":
                raise ValueError(f"it holds key points without numbers in `{key}`.")
            wanted = tuple(count if length < 0 else length for length in shape)
            if arrays[key].shape != wanted or not np.isfinite(arrays[key]).all():
                raise ValueError(f"`{key}` must be finite numbers of the shape {wanted}.")
            found[key] = arrays[key].astype(np.float64)
        frames = found["keypoint_frames"]
        if (np.diff(frames) <= 0.0).any():
            raise ValueError("`keypoint_frames` do not ascend.")
        width, height = found["keypoint_image_size"]
        problems = found.get("keypoint_problems")
        return cls(
            frames=frames.astype(np.int64),
            image_px=found["keypoints_px"],
            world_m=found["keypoints_m"],
            visibility=found["keypoint_visibility"],
            presence=found["keypoint_presence"],
            size_px=(int(width), int(height)),
            times_s=found.get("keypoint_times"),
            problems=None if problems is None else problems.astype(np.int64),
        )
