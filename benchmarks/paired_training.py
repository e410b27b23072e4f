"""Trains variants of the configuration in turns in one process, on the same machine state."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from avatar.config import TrainConfig
from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.events import HeldOutScore
from avatar.rig import Rig
from avatar.training.frame_stream import TrainingFrame
from avatar.training.train import warm_up
from avatar.training.trainer import Trainer, cosine_decay
from baselines.instant_avatar.samplers import BaselineScheme, BaselineTrainer
from benchmarks.sample_training import training_config
from benchmarks.stopwatch import limit_threads

LATE_PHASE_START = 0.8
"""Share of the budget after which steps count as late ones."""
SLICE_S = 0.5
"""Core time after which it is the next one's turn."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A row of a table: its name, its changes to the configuration, and its scheme."""

    name: str
    changes: Mapping[str, Any]
    scheme: BaselineScheme = field(default_factory=BaselineScheme)


@dataclass(frozen=True, kw_only=True)
class TrainingBudget:
    """Budget of each variant: seconds of one core, or a number of steps."""

    seconds: float = 0.0
    steps: int = 0


@dataclass(frozen=True, kw_only=True)
class VariantQuality:
    """Means over pictures: dB on white, dB in the mask, SSIM."""

    psnr: float
    psnr_mask: float
    ssim: float

    @classmethod
    def of(cls, scores: Sequence[HeldOutScore]) -> "VariantQuality":
        return cls(
            psnr=float(np.mean([s.psnr for s in scores])),
            psnr_mask=float(np.mean([s.psnr_mask for s in scores])),
            ssim=float(np.mean([s.ssim for s in scores])),
        )


@dataclass(frozen=True, kw_only=True)
class VariantOutcome:
    """What became of a variant.

    Attributes:
        name: Of the variant.
        steps: Done.
        step_ms: Core milliseconds each, all that a step brings with it included.
        late_ms: The same over the last fifth.
        samples: Of a ray, mean over all steps.
        held: Frames of the video that were not learnt.
        novel: Poses that were never filmed.
    """

    name: str
    steps: int
    step_ms: float
    late_ms: float
    samples: float
    held_out: VariantQuality
    novel: VariantQuality


@dataclass(kw_only=True)
class VariantRun:
    """A variant under way."""

    variant: Variant
    scheme_trainer: BaselineTrainer
    spent_s: float = 0.0
    late_s: float = 0.0
    late_steps: int = 0

    @property
    def trainer(self) -> Trainer:
        """The trainer that the scheme drives."""
        return self.scheme_trainer.trainer

    def progress(self, budget: TrainingBudget) -> float:
        """Share of the budget that is used up."""
        if budget.steps:
            return self.trainer.steps / budget.steps
        return self.spent_s / budget.seconds

    def train_slice(self, budget: TrainingBudget) -> None:
        """One turn."""
        began = now = time.process_time()
        while now - began < SLICE_S and (done := self.progress(budget)) < 1.0:
            self.scheme_trainer.step(
                rate=cosine_decay(done), hard_surface_share=min(1.0, 4.0 * done)
            )
            before, now = now, time.process_time()
            self.spent_s += now - before
            if done >= LATE_PHASE_START:
                self.late_s += now - before
                self.late_steps += 1


def train_variants(
    variants: Sequence[Variant],
    budget: TrainingBudget,
    recording: Any,
    rig: Rig,
    frames: Sequence[TrainingFrame],
) -> list[VariantRun]:
    """Every variant after its budget, with one thread."""
    limit_threads(1)
    runs = []
    for variant in variants:
        seconds = budget.seconds or 60.0
        config = training_config(recording, seconds, **variant.changes)
        compile_kernels(rig, config, variant.scheme, frames[0])
        trainer = BaselineTrainer(rig, config, variant.scheme)
        for frame in frames:
            trainer.add_frame(frame)
        runs.append(VariantRun(variant=variant, scheme_trainer=trainer))
    while under_way := [run for run in runs if run.progress(budget) < 1.0]:
        for run in under_way:
            run.train_slice(budget)
    return runs


def compile_kernels(
    rig: Rig,
    config: TrainConfig,
    scheme: BaselineScheme,
    frame: TrainingFrame,
) -> None:
    """Compiles every kernel that a variant uses, in a trainer that is thrown away."""
    trainer = BaselineTrainer(rig, replace(config, rays=64), scheme)
    trainer.add_frame(frame)
    warm_up(trainer.trainer)
    for _ in range(config.occupancy_interval):
        trainer.step(rate=1.0, hard_surface_share=1.0)


def score_variant(
    run: VariantRun, held: Sequence[HeldOutFrame], novel: Sequence[HeldOutFrame]
) -> VariantOutcome:
    """Scores of the exact renderer, the same for every row."""
    trainer = run.trainer
    return VariantOutcome(
        name=run.variant.name,
        steps=trainer.steps,
        step_ms=1000.0 * run.spent_s / trainer.steps,
        late_ms=1000.0 * run.late_s / max(run.late_steps, 1),
        samples=trainer.samples / trainer.rays,
        held_out=VariantQuality.of([score_frame(trainer.avatar, frame) for frame in held]),
        novel=VariantQuality.of([score_frame(trainer.avatar, frame) for frame in novel]),
    )
