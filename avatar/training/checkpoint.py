"""Checkpoints: the trainer's state on disk, written atomically and read as plain data."""

import copy
import dataclasses
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.config import TrainConfig
from avatar.rig import Rig
from avatar.training.trainer import Trainer
from capture.atomic_files import atomic_file
from capture.input_error import InputError

CHECKPOINT_FORMAT = 2
"""Version of the checkpoint's layout; another version is refused."""
CHECKPOINT_FILE = "state.pt"
"""File name of the checkpoint in its folder."""
COUNTERS = ("steps", "rays", "samples", "frames_seen", "wall_seconds", "cpu_seconds")
"""Attributes of `Trainer` that the checkpoint saves as plain numbers."""


def save(trainer: Trainer, folder: Path, *, notes: dict[str, Any] | None = None) -> Path:
    """Writes the trainer's state, the rig and the caller's notes into `folder`.

    Args:
        trainer: What has been learnt. Frames are not kept: the video still has them.
        folder: Made if it is not there.
        notes: What the caller wants back (plain data: numbers, text, lists, dicts).

    Raises:
        OSError: If the disk is full, or the folder cannot be written. An older checkpoint stays.
    """
    return write_state(current_state(trainer, notes=notes), folder)


def current_state(trainer: Trainer, *, notes: dict[str, Any] | None = None) -> dict[str, Any]:
    """The content of a checkpoint; its tensors are the trainer's own, and change with it."""
    occupancy = trainer.avatar.occupancy.density_grid
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
        "notes": notes or {},
    }


def detached_state(trainer: Trainer, *, notes: dict[str, Any] | None = None) -> dict[str, Any]:
    """A copy of the checkpoint's content, to be written while training goes on.

    Copying takes a tenth of the time of writing. The rig never changes and is not copied.
    """
    state = current_state(trainer, notes=notes)
    return {name: part if name == "rig" else copy.deepcopy(part) for name, part in state.items()}


def write_state(state: dict[str, Any], folder: Path) -> Path:
    """Writes the content of a checkpoint into `folder`, which is made if it is not there.

    Raises:
        OSError: If the disk is full, or the folder cannot be written. An older checkpoint stays.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / CHECKPOINT_FILE
    save_atomically(state, path)
    return path


def load(folder: Path, device: torch.device) -> tuple[Trainer, dict[str, Any]]:
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
        return _restored(state, device), state["notes"]
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


def _restored(state: dict[str, Any], device: torch.device) -> Trainer:
    rig = Rig(**{item.name: state["rig"][item.name].numpy() for item in dataclasses.fields(Rig)})
    trainer = Trainer(rig, TrainConfig(**state["config"]), device)
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
    gains = state.get("gains", {})  # checkpoints before 2026-11-22 have none
    trainer.exposures.restore({frame: gain.numpy() for frame, gain in gains.items()})
    if "shading" in state:
        trainer.learner.shading.restore(state["shading"])
    for name in COUNTERS:
        setattr(trainer, name, state["counts"][name])
    return trainer


def save_atomically(state: dict[str, Any], path: Path) -> None:
    """Writes plain data and tensors as a file that appears whole or not at all.

    Raises:
        InputError: If the folder's list says that the file there is not ours.
        OSError: If the disk is full, or the folder cannot be written; what was there before stays.
    """
    try:
        with atomic_file(path) as part, part.open("wb") as file:
            torch.save(state, file)
    except RuntimeError as error:  # torch stumbles once more after the disk has failed
        if isinstance(error.__context__, OSError):
            raise error.__context__ from None
        raise
