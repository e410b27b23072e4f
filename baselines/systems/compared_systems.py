"""The systems by name: the product, and Anim-NeRF in a preset."""

from typing import Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32

from avatar.config import TrainConfig
from avatar.render import render
from avatar.training.trainer import Trainer, cosine_decay
from baselines.systems.anim_nerf import PRESETS, AnimNerf
from baselines.systems.baseline_training import BaselineSystem
from baselines.systems.compared_capture import ComparedCapture
from baselines.systems.posed_person import SkinnedPerson
from preprocess.observation import Observation


@runtime_checkable
class ComparedSystem(Protocol):
    """What is trained and scored.

    Attributes:
        steps: Steps done.
    """

    steps: int

    def step(self, progress: float) -> float:
        """Makes one step at a share of the budget; returns its loss."""
        ...

    def render(self, observation: Observation) -> Float32[np.ndarray, "height width 4"]:
        """Renders the observation's pose as a premultiplied RGBA image in [0, 1]."""
        ...


@final
class ProductSystem:
    """The product's trainer, driven by core time instead of wall time.

    Attributes:
        steps: Steps done.
    """

    def __init__(self, data: ComparedCapture, config: TrainConfig) -> None:
        """Takes in all frames."""
        self.steps = 0
        self._trainer = Trainer(data.rig, config)
        for frame in data.frames:
            self._trainer.add_frame(frame)

    def step(self, progress: float) -> float:
        """One step with the product's schedule."""
        falling = cosine_decay(progress)
        result = self._trainer.step(
            rate=falling, hard_surface_share=min(1.0, 4.0 * progress), detail_share=1.0 - falling
        )
        self.steps += 1
        return float(result.loss.mean())

    def render(self, observation: Observation) -> Float32[np.ndarray, "height width 4"]:
        """The exact renderer's picture, in the light of the room."""
        return render(self._trainer.avatar, observation.pose, observation.camera, shaded=True)


def train_config(
    data: ComparedCapture, seconds: float | None, steps: int | None, *, seed: int = 0
) -> TrainConfig:
    """The product's configuration for a budget and this capture, as ia-ingest makes it."""
    capture = data.capture
    return TrainConfig.for_budget(
        seconds, steps=steps, footprint_m=capture.pixel_footprint_m(),
        filmed_footprint_m=capture.pixel_footprint_m(as_filmed=True),
        pose_uncertainty=capture.pose_uncertainty, seed=seed,
    )  # fmt: skip


def make_system(
    name: str, data: ComparedCapture, config: TrainConfig, *, preset: str, seed: int
) -> ComparedSystem:
    """An untrained system.

    Args:
        name: "ours" or "anim-nerf".
        data: What it will be trained on.
        config: The product's configuration.
        preset: "small" or "paper", of Anim-NeRF.
        seed: Of all random numbers of Anim-NeRF; the product's lies in `config`.
    """
    if name == "ours":
        return ProductSystem(data, config)
    torch.manual_seed(seed)
    person, settings = SkinnedPerson(data.rig, data.capture.shaped), PRESETS[preset]
    return BaselineSystem(AnimNerf(person, settings), person, data.frames, settings)
