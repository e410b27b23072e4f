"""What the training benchmarks train on: a filmed sample, and a trainer that has seen all of it."""

import dataclasses
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch

from apps.recording.opening import open_recording
from apps.recording.recording import Recording
from apps.recording.wanted import RecordingPaths
from apps.studio.writer import ShootConfig, shoot
from avatar.config import TrainConfig
from avatar.hold import HeldOut, prepared
from avatar.prepare import PreparedFrame
from avatar.rig import Rig
from avatar.step import cosine
from avatar.train import Trainer


class Class(NamedTuple):
    """A trainer and all its frames.

    Attributes:
        trainer: Has taken in every frame.
        frames: To learn from.
        held: To be scored on.
        ready_seconds: CPU time that making the frames ready took.
    """

    trainer: Trainer
    frames: list[PreparedFrame]
    held: list[HeldOut]
    ready_seconds: float


def filmed(out: Path, size: int, **more: Any) -> Path:
    """Films the sample, unless it lies there already; its folder."""
    if not out.exists():
        shoot(out, ShootConfig(size=size, **more))
    return out


def opened(capture: Path, *, frames: slice | None = None, size: int | None = None) -> Recording:
    """A filmed sample or another capture, as it is or with a longer side of `size` pixels."""
    return open_recording(RecordingPaths(video=capture, frames=frames), size_px=size)


def recipe(recording: Recording, seconds: float, **changes: Any) -> TrainConfig:
    """What the dial chooses for a recording, with some of it changed."""
    config = TrainConfig.within(seconds, footprint_m=recording.footprint_m())
    return dataclasses.replace(config, **changes)


def assembled(recording: Recording, rig: Rig, config: TrainConfig, device: torch.device) -> Class:
    """A trainer that has taken in every frame before its first step."""
    trainer, frames, held = Trainer(rig, config, device), [], []
    began = time.process_time()
    total = recording.source.frame_count
    for item in prepared(recording.observations(), rig, every=config.hold_every, total=total):
        if isinstance(item, HeldOut):
            held.append(item)
        elif isinstance(item, PreparedFrame):
            frames.append(item)
            trainer.add(item)
    return Class(trainer, frames, held, time.process_time() - began)


def train_for_core_seconds(trainer: Trainer, seconds: float) -> None:
    """Trains for so much CPU time, with the rate falling over all of it."""
    began = time.process_time()
    while (share := (time.process_time() - began) / seconds) < 1.0:
        trainer.step(rate=cosine(share), hard_share=min(1.0, 4.0 * share))
