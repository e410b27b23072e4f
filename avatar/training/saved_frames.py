"""Frames saved beside a checkpoint, to train a finished avatar further with another video.

Keyframes are saved as the replay buffer holds them, with 8-bit colors and their view; rays and
correspondences are recomputed. A few held-out frames are saved to measure forgetting.
"""

import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from avatar.evaluation.held_out import HeldOutFrame, subsample_evenly
from avatar.rig import Rig
from avatar.training.checkpoint import save_atomically
from avatar.training.replay_buffer import ReplayBuffer, ReplayFrame
from avatar.training.training_frame import RayView, TrainingFrame, rebuild_frame
from capture.camera import Camera
from capture.input_error import InputError
from capture.source import Frame
from preprocess.body.body_pose import BodyPose
from preprocess.observation import Observation

REPLAY_FILE_FORMAT = 2
"""Version of the saved frames' layout; another version is refused."""
LAST_RUN_FILE = "frames.tensors"
"""File of the frames of the last finished run."""
EARLIER_VIDEOS_FILE = "earlier.tensors"
"""File of the frames of all videos before the current one."""
INDEX_SHIFT_PER_VIDEO = 1 << 32
"""Offset by which the indices of each earlier video's frames are lowered, which keeps them unique;
`number_in_video` removes it for display."""
MAX_HELD_OUT_KEPT = 12
"""Held-out frames that are saved."""


def number_in_video(index: int) -> int:
    """A frame's number in its own video."""
    return index % INDEX_SHIFT_PER_VIDEO


def video_age(index: int) -> int:
    """Number of videos added since a frame's own; 0 for the current video."""
    return -(index // INDEX_SHIFT_PER_VIDEO)


class SavedFrames(NamedTuple):
    """The frames that are saved.

    Attributes:
        replay_frames: Frames to train on.
        held_out: Frames to score, never trained on.
    """

    replay_frames: list[ReplayFrame]
    held_out: list[HeldOutFrame]

    @classmethod
    def of(cls, replay: ReplayBuffer, held_out: Sequence[HeldOutFrame]) -> "SavedFrames":
        """All frames of the replay buffer, and a few of the held-out frames, evenly spaced."""
        return cls(replay.replay_frames(), subsample_evenly(list(held_out), MAX_HELD_OUT_KEPT))

    def as_earlier_video(self) -> "SavedFrames":
        """The frames with their indices shifted to those of an earlier video."""
        held = [
            replace(
                kept,
                observation=replace(
                    kept.observation,
                    frame=replace(
                        kept.observation.frame,
                        index=kept.observation.frame.index - INDEX_SHIFT_PER_VIDEO,
                    ),
                ),
            )
            for kept in self.held_out
        ]
        return SavedFrames(
            [
                frame._replace(index=frame.index - INDEX_SHIFT_PER_VIDEO)
                for frame in self.replay_frames
            ],
            held,
        )

    def training_frames(self, rig: Rig) -> list[TrainingFrame]:
        """The key frames, ready to be learnt from again."""
        return [rebuild_frame(*frame, rig) for frame in self.replay_frames]

    def save(self, path: Path) -> None:
        """Writes them, whole or not at all.

        Raises:
            OSError: If the disk is full; what was there before stays.
        """
        state = {
            "format": REPLAY_FILE_FORMAT,
            "key_frames": [_replay_frame_state(frame) for frame in self.replay_frames],
            "held": [_observation_state(kept.observation) for kept in self.held_out],
        }
        save_atomically(state, path)

    @classmethod
    def load(cls, path: Path) -> "SavedFrames":
        """Reads them; none if there is no such file.

        Raises:
            InputError: If it cannot be read.
        """
        if not path.exists():
            return cls([], [])
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            return cls(
                [_replay_frame(kept) for kept in state["key_frames"]],
                [HeldOutFrame(observation=_observation(kept)) for kept in state["held"]],
            )
        except (OSError, RuntimeError, EOFError, KeyError, ValueError, TypeError,
                pickle.UnpicklingError) as error:  # fmt: skip
            raise InputError(
                f"The frames {path} cannot be read ({error}). Expected those that ia-ingest wrote; "
                "without the file the older video is no longer learnt from."
            ) from error


def _replay_frame_state(frame: ReplayFrame) -> dict[str, Any]:
    return {
        "index": frame.index,
        "colors": torch.from_numpy(frame.colors),
        "near": torch.from_numpy(frame.view.near_person_bits),
        "camera": _camera_state(frame.view.camera),
        "pose": _pose_state(frame.pose),
    }


def _replay_frame(state: dict[str, Any]) -> ReplayFrame:
    return ReplayFrame(
        index=state["index"],
        pose=_pose(state["pose"]),
        view=RayView(camera=_camera(state["camera"]), near_person_bits=state["near"].numpy()),
        colors=state["colors"].numpy(),
    )


def _observation_state(observation: Observation) -> dict[str, Any]:
    alpha = np.rint(observation.alpha * 65535.0).astype(np.int32)
    return {
        "index": observation.frame.index,
        "time_s": observation.frame.time_s,
        "rgb": torch.from_numpy(np.ascontiguousarray(observation.frame.rgb)),
        "alpha": torch.from_numpy(alpha),
        "camera": _camera_state(observation.camera),
        "pose": _pose_state(observation.pose),
    }


def _observation(state: dict[str, Any]) -> Observation:
    alpha = state["alpha"].numpy().astype(np.float32) / np.float32(65535.0)
    frame = Frame(index=state["index"], time_s=state["time_s"], rgb=state["rgb"].numpy())
    return Observation(
        frame=frame, alpha=alpha, pose=_pose(state["pose"]), camera=_camera(state["camera"])
    )


def _camera_state(camera: Camera) -> dict[str, Any]:
    return {
        "focal_px": list(camera.focal_px),
        "center_px": list(camera.center_px),
        "size_px": list(camera.size_px),
        "distortion": list(camera.distortion),
        "camera_from_world": torch.from_numpy(camera.camera_from_world),
    }


def _camera(state: dict[str, Any]) -> Camera:
    pairs = {name: tuple(state[name]) for name in ("focal_px", "center_px", "size_px")}
    return Camera(
        **pairs,
        distortion=tuple(state["distortion"]),
        camera_from_world=state["camera_from_world"].numpy(),
    )


def _pose_state(pose: BodyPose) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(np.array(values)) for name, values in vars(pose).items()}


def _pose(state: dict[str, torch.Tensor]) -> BodyPose:
    return BodyPose(**{name: values.numpy() for name, values in state.items()})
