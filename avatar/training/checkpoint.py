"""Checkpoints: the trainer's state and its frames on disk, written whole and read as plain data.

Frames are saved beside the state to train a finished avatar further with another video. Keyframes
are saved as the replay buffer holds them, with 8-bit colors and their view; rays and
correspondences are recomputed.
"""

import copy
import dataclasses
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.config import TrainConfig
from avatar.rig import Rig
from avatar.training.replay_buffer import ReplayFrame
from avatar.training.trainer import Trainer
from avatar.training.training_pixels import RayView
from capture.atomic_files import atomic_file
from capture.camera import Camera
from capture.input_error import InputError
from preprocess.body.body_pose import BodyPose

CHECKPOINT_FORMAT = 3
"""Version of the checkpoint's layout; another version is refused."""
CHECKPOINT_FILE = "state.pt"
COUNTERS = ("steps", "rays", "samples", "frames_seen", "wall_seconds", "cpu_seconds")
"""Attributes of `Trainer` that the checkpoint saves as plain numbers."""


def save(trainer: Trainer, folder: Path, *, notes: dict[str, Any] | None = None) -> Path:
    """Writes the trainer's state, the rig and the caller's notes (plain data) into `folder`.

    Frames are not kept: the video still has them.
    """
    return write_state(current_state(trainer, notes=notes), folder)


def current_state(trainer: Trainer, *, notes: dict[str, Any] | None = None) -> dict[str, Any]:
    """The content of a checkpoint; its tensors are the trainer's own, and change with it."""
    occupancy, evidence = trainer.avatar.occupancy.density_grid, trainer.unseen.evidence
    return {
        "format": CHECKPOINT_FORMAT,
        "config": dataclasses.asdict(trainer.config),
        "rig": {
            item.name: torch.from_numpy(
                np.ascontiguousarray(getattr(trainer.avatar.rig, item.name))
            )
            for item in dataclasses.fields(Rig)
        },
        "field": [parameter.detach() for parameter in trainer.field.parameters()],
        "mean": [parameter.detach() for parameter in trainer.avatar.field.parameters()],
        "optimizer": trainer.optimizer.state_dict(),
        "density": occupancy.density,
        "occupied": occupancy.occupied,
        "counts": {name: getattr(trainer, name) for name in COUNTERS},
        "corrections": {
            frame: torch.from_numpy(numbers) for frame, numbers in trainer.pose_corrections.items()
        },
        "gains": {
            frame: torch.from_numpy(gain) for frame, gain in trainer.exposures.by_frame.items()
        },
        "shading": trainer.learner.shading.coefficients,
        "seen": torch.from_numpy(evidence.cosines),
        "seen_frames": torch.from_numpy(evidence.seen_frames),
        "seen_colors": torch.from_numpy(evidence.color_sums),
        "evidence_frame_count": evidence.frame_count,
        "notes": notes or {},
    }


def detached_state(trainer: Trainer, *, notes: dict[str, Any] | None = None) -> dict[str, Any]:
    """A copy of the checkpoint's content, to be written while training goes on.

    Copying takes a tenth of the time of writing. The rig never changes and is not copied.
    """
    state = current_state(trainer, notes=notes)
    return {name: part if name == "rig" else copy.deepcopy(part) for name, part in state.items()}


def write_state(state: dict[str, Any], folder: Path) -> Path:
    """Writes the content of a checkpoint into `folder`, which is made if it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / CHECKPOINT_FILE
    save_atomically(state, path)
    return path


def load(folder: Path) -> tuple[Trainer, dict[str, Any]]:
    """The trainer that `save` left, without frames, and the caller's notes.

    Raises:
        FileNotFoundError: If there is no checkpoint in `folder`.
        InputError: If it cannot be read.
    """
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        raise FileNotFoundError(path)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if state["format"] != CHECKPOINT_FORMAT:
            raise InputError(
                f"The checkpoint {path} has format {state['format']}; this version reads "
                f"{CHECKPOINT_FORMAT}. Train again with --overwrite."
            )
        return _restored(state), state["notes"]
    except InputError:
        raise
    except pickle.UnpicklingError as error:
        raise InputError(
            f"The checkpoint {path} holds something other than numbers and is refused. "
            "Train again with --overwrite."
        ) from error
    except Exception as error:  # what a damaged file makes torch stumble over has many types
        raise InputError(
            f"The checkpoint {path} cannot be read ({str(error).split('. ')[0]}). "
            "Expected one that ia-ingest wrote. Train again with --overwrite."
        ) from error


def _restored(state: dict[str, Any]) -> Trainer:
    rig = Rig(**{item.name: state["rig"][item.name].numpy() for item in dataclasses.fields(Rig)})
    trainer = Trainer(rig, TrainConfig(**state["config"]))
    with torch.no_grad():
        for field, name in ((trainer.field, "field"), (trainer.avatar.field, "mean")):
            for parameter, values in zip(field.parameters(), state[name], strict=True):
                parameter.copy_(values)
    trainer.optimizer.load_state_dict(state["optimizer"])
    grid = trainer.avatar.occupancy.density_grid
    grid.density.copy_(state["density"])
    grid.occupied.copy_(state["occupied"])
    trainer.pose_corrections = {
        frame: tensor.numpy() for frame, tensor in state["corrections"].items()
    }
    trainer.exposures.restore({frame: gain.numpy() for frame, gain in state["gains"].items()})
    trainer.learner.shading.restore(state["shading"])
    evidence, cosines = trainer.unseen.evidence, state["seen"].numpy()
    evidence.cosines[:] = cosines
    evidence.seen_frames[:] = state.get("seen_frames", cosines > 0.0)  # of earlier versions
    evidence.color_sums[:] = state.get("seen_colors", 0.0)
    evidence.frame_count = state.get("evidence_frame_count", 1)
    for name in COUNTERS:
        setattr(trainer, name, state["counts"][name])
    return trainer


def save_atomically(state: dict[str, Any], path: Path) -> None:
    """Writes plain data and tensors as a file that appears whole or not at all."""
    try:
        with atomic_file(path) as part, part.open("wb") as file:
            torch.save(state, file)
    except RuntimeError as error:  # torch stumbles once more after the disk has failed
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise


REPLAY_FILE_FORMAT = 3
"""Version of the saved frames' layout; another version is refused."""
LAST_RUN_FILE = "frames.tensors"
"""File of the frames of the last finished run."""
EARLIER_VIDEOS_FILE = "earlier.tensors"
"""File of the frames of all videos before the current one."""
INDEX_SHIFT_PER_VIDEO = 1 << 32
"""Offset by which the indices of each earlier video's frames are lowered: they stay unique."""


def as_earlier_video(frames: Sequence[ReplayFrame]) -> list[ReplayFrame]:
    """Key frames with their indices shifted to those of an earlier video."""
    return [frame._replace(index=frame.index - INDEX_SHIFT_PER_VIDEO) for frame in frames]


def save_frames(frames: Sequence[ReplayFrame], path: Path) -> None:
    """Writes key frames, whole or not at all."""
    plain = [_to_plain(frame) for frame in frames]
    save_atomically({"format": REPLAY_FILE_FORMAT, "replay": plain}, path)


def load_frames(path: Path) -> list[ReplayFrame]:
    """Reads key frames; none if there is no such file."""
    if not path.exists():
        return []
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        if state["format"] != REPLAY_FILE_FORMAT:
            raise ValueError(f"format {state['format']} instead of {REPLAY_FILE_FORMAT}")
        return [_from_plain(frame) for frame in state["replay"]]
    except (OSError, RuntimeError, EOFError, KeyError, ValueError, TypeError,
            pickle.UnpicklingError) as error:  # fmt: skip
        raise InputError(
            f"The frames {path} cannot be read ({error}). Expected those that ia-ingest wrote; "
            "without the file the older video is no longer learnt from."
        ) from error


SAVED_RECORDS = {record.__name__: record for record in (ReplayFrame, RayView, Camera, BodyPose)}
"""Records that saved frames consist of, by name."""


def _to_plain(value: Any) -> Any:
    """Data that `torch.load` reads without executing any: records as dicts, arrays as tensors."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.ascontiguousarray(value))
    name = type(value).__name__
    if name in SAVED_RECORDS:
        fields = value._asdict() if hasattr(value, "_asdict") else vars(value)
        return {"record": name} | {key: _to_plain(part) for key, part in fields.items()}
    return [_to_plain(part) for part in value] if isinstance(value, tuple | list) else value


def _from_plain(value: Any) -> Any:
    if isinstance(value, torch.Tensor):
        return value.numpy()
    if isinstance(value, dict):
        fields = {name: _from_plain(part) for name, part in value.items()}
        return SAVED_RECORDS[fields.pop("record")](**fields)
    return tuple(map(_from_plain, value)) if isinstance(value, list) else value
