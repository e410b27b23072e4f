"""The systems by name: the product, and each baseline in a preset."""

from collections.abc import Callable
from typing import Any, Protocol, final, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32

from avatar.config import TrainConfig
from avatar.render import render
from avatar.training.trainer import Trainer, cosine_decay
from baselines.systems import anim_nerf, instant_ngp, neural_body, snarf
from baselines.systems.baseline_training import BaselineSystem
from baselines.systems.compared_capture import ComparedCapture
from baselines.systems.method_settings import MethodSettings
from baselines.systems.posed_person import PoseTable, SkinnedPerson
from baselines.systems.ray_rendering import PosedRadiance
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


FieldMaker = Callable[[SkinnedPerson, ComparedCapture, MethodSettings, TrainConfig], PosedRadiance]


def _make_ngp(
    person: SkinnedPerson, data: ComparedCapture, settings: MethodSettings, config: TrainConfig
) -> PosedRadiance:
    with torch.no_grad():
        bodies = PoseTable(person, data.frames).bodies(torch.arange(len(data.frames)))
    return instant_ngp.InstantNgp(bodies.vertices, settings, config)


METHODS: dict[str, tuple[Any, FieldMaker]] = {
    "anim-nerf": (anim_nerf, lambda person, data, how, _: anim_nerf.AnimNerf(person, how)),
    "neural-body": (
        neural_body,
        lambda person, data, how, _: neural_body.NeuralBody(person, len(data.frames), how),
    ),
    "snarf": (snarf, lambda person, data, how, _: snarf.Snarf(person, how)),
    "instant-ngp": (instant_ngp, _make_ngp),
}
"""Modules of the baselines, with their `PRESETS`, and what makes their fields."""


def make_system(
    name: str, data: ComparedCapture, config: TrainConfig, *, preset: str, seed: int
) -> ComparedSystem:
    """An untrained system.

    Args:
        name: "ours", or a key of `METHODS`.
        data: What it will be trained on.
        config: The product's configuration; Instant-NGP takes its hash grid from it.
        preset: "small" or "paper", of a baseline.
        seed: Of all random numbers of a baseline; the product's lies in `config`.
    """
    if name == "ours":
        return ProductSystem(data, config)
    module, make = METHODS[name]
    settings: MethodSettings = module.PRESETS[preset]
    torch.manual_seed(seed)
    person = SkinnedPerson(data.rig, data.capture.shaped)
    field = make(person, data, settings, config)
    return BaselineSystem(field, person, data.frames, settings)
