"""What the training benchmarks train on: a filmed sample, and a trainer that has seen all of it."""

import dataclasses
import time
from pathlib import Path
from typing import Any, NamedTuple

from avatar.config import TrainConfig
from avatar.evaluation.held_out import HeldOutFrame
from avatar.rig import Rig
from avatar.training.frame_stream import TrainingFrame, prepare_stream
from avatar.training.train import Trainer
from avatar.training.trainer import cosine_decay
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.observation import Observation
from preprocess.open_capture import open_capture


class LoadedTrainer(NamedTuple):
    """A trainer and all its frames.

    Attributes:
        trainer: Has taken in every frame.
        frames: To learn from.
        held: To be scored on.
        ready_seconds: CPU time that making the frames ready took.
    """

    trainer: Trainer
    frames: list[TrainingFrame]
    held_out: list[HeldOutFrame]
    ready_seconds: float


def film_sample(out: Path, size: int, **more: Any) -> Path:
    """Films the sample, unless it lies there already; its folder."""
    if not out.exists():
        film_capture(out, ShootConfig(size=size, **more))
    return out


def open_sample(capture: Path, *, frames: slice | None = None, size: int | None = None) -> Capture:
    """A filmed sample or another capture, as it is or with a longer side of `size` pixels."""
    return open_capture(CaptureInputs(video=capture, frames=frames), size_px=size)


def novel_observations(capture: Path) -> list[Observation]:
    """The poses that were never filmed, with their true pictures and masks."""
    wanted = CaptureInputs(video=capture / "truth" / "novel", cameras=str(capture / "cameras.npz"))
    return [seen for seen in open_capture(wanted).observations() if isinstance(seen, Observation)]


def training_config(recording: Capture, seconds: float, **changes: Any) -> TrainConfig:
    """What the dial chooses for a recording, with some of it changed."""
    config = TrainConfig.for_budget(seconds, footprint_m=recording.pixel_footprint_m())
    return dataclasses.replace(config, **changes)


def load_trainer(recording: Capture, rig: Rig, config: TrainConfig) -> LoadedTrainer:
    """A trainer that has taken in every frame before its first step."""
    trainer, frames, held = Trainer(rig, config), [], []
    began = time.process_time()
    total = recording.source.frame_count
    for item in prepare_stream(
        recording.observations(), rig, stride=config.held_out_stride, total=total
    ):
        if isinstance(item, HeldOutFrame):
            held.append(item)
        elif isinstance(item, TrainingFrame):
            frames.append(item)
            trainer.add_frame(item)
    return LoadedTrainer(trainer, frames, held, time.process_time() - began)


def train_for_core_seconds(trainer: Trainer, seconds: float) -> None:
    """Trains for a CPU time, seconds, over all of which the learning rate falls."""
    began = time.process_time()
    while (share := (time.process_time() - began) / seconds) < 1.0:
        trainer.step(rate=cosine_decay(share), hard_surface_share=min(1.0, 4.0 * share))
