"""Key points of one person over time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped

from preprocess.tracking.keypoints import PersonKeypoints


@dataclass(frozen=True, eq=False, kw_only=True)
class KeypointTrack:
    """Key points of one person over time, one row a frame in which the person was found.

    Attributes:
        frames: Number of each row's frame, counted from 0.
        image_px, world_m, visibility, presence: As in `PersonKeypoints`.
        size_px: Width and height of the frames.
        times_s: Time of each row's frame, seconds, if known.
    """

    frames: Int[np.ndarray, "rows"]
    image_px: Float[np.ndarray, "rows 33 2"]
    world_m: Float[np.ndarray, "rows 33 3"]
    visibility: Float[np.ndarray, "rows 33"]
    presence: Float[np.ndarray, "rows"]
    size_px: tuple[int, int]
    times_s: Float[np.ndarray, "rows"] | None = None

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
        return arrays if self.times_s is None else {**arrays, "keypoint_times": self.times_s}

    @classmethod
    def from_arrays(cls, arrays: dict[str, Shaped[np.ndarray, "..."]]) -> "KeypointTrack | None":
        """What `as_arrays` returned; None if a file's arrays do not hold it."""
        if "keypoint_frames" not in arrays:
            return None
        width, height = arrays["keypoint_image_size"]
        return cls(
            frames=arrays["keypoint_frames"].astype(np.int64),
            image_px=arrays["keypoints_px"].astype(np.float64),
            world_m=arrays["keypoints_m"].astype(np.float64),
            visibility=arrays["keypoint_visibility"].astype(np.float64),
            presence=arrays["keypoint_presence"].astype(np.float64),
            size_px=(int(width), int(height)),
            times_s=arrays.get("keypoint_times"),
        )
