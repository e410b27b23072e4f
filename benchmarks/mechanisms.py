"""What each mechanism of training buys: each off in turn, on phone-like films.

A row trains without one mechanism for as many steps as the others, in turns with them, and is
scored in fitted poses and exposures. A row with a tenth more steps tells what time could buy.
"""

import inspect
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.evaluation.unfilmed_views import half_transparent_share, render_unfilmed_views
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.trainer import Trainer, cosine_decay
from baselines.hardware import Hardware
from baselines.systems.compared_capture import ComparedCapture
from benchmarks.stopwatch import limit_threads
from instant_avatar.run.session_start import new_trainer

SCORED_FRAMES = 6
"""Held-out frames, and novel poses, that each row is scored on, spread evenly."""
SLICE_S = 0.5
"""Core time after which it is the next one's turn."""
MORE_STEPS = 1.1
"""Factor of the steps in the row that trains longer."""


@dataclass(frozen=True, kw_only=True)
class Mechanism:
    """What a row leaves out.

    Attributes:
        name: Of the mechanism.
        off: Changes of `TrainConfig` that turn it off.
        patched: Constants or functions that turn it off, by their full names.
        code: Full names of the definitions that it alone needs, or how many lines these have.
        steps_factor: Factor of the steps.
    """

    name: str
    off: Mapping[str, Any] = field(default_factory=dict)
    patched: Mapping[str, Any] = field(default_factory=dict)
    code: Sequence[str] = ()
    steps_factor: float = 1.0

    @property
    def lines(self) -> int:
        """Lines of production code that it alone needs, beside its calls and its configuration."""
        found = map(resolve_name, self.code)
        sources = [getattr(each, "func", each) for each in found]  # `func` of a cached property
        return sum(len(inspect.getsourcelines(each)[0]) for each in sources)

    @contextmanager
    def turned_off(self) -> Iterator[None]:
        """Leaves it out in this block, where it is not turned off by the configuration."""
        with ExitStack() as stack:
            for name, value in self.patched.items():
                stack.enter_context(mock.patch(name, value))
            yield


FULL = Mechanism(name="all of them")
LONGER = Mechanism(name="(nothing, a tenth more steps)", steps_factor=MORE_STEPS)
MECHANISMS = [
    FULL,
    LONGER,
    Mechanism(name="alpha loss", off={"alpha_weight": 0.0}),
    Mechanism(name="hard surface", off={"hard_surface_weight": 0.0}),
    Mechanism(
        name="occupancy-based term",
        off={"empty_space_weight": 0.0},
        code=(
            "avatar.kernels.numba_priors.empty_space",
            "avatar.occupancy_grid.OccupancyGrid._empty_cells",
        ),
    ),
    Mechanism(
        name="total variation",
        off={"density_tv_weight": 0.0},
        code=("avatar.kernels.numba_priors.density_tv", "avatar.radiance_field.sample_tv_pairs"),
    ),
    Mechanism(
        name="occupancy-based term and total variation",
        off={"empty_space_weight": 0.0, "density_tv_weight": 0.0},
    ),
    Mechanism(
        name="faint gradients by chance",
        off={"faint_gradient_share": 0.0},
        code=("avatar.kernels.numba_training_step._draw_strong",),
    ),
    Mechanism(
        name="coarse samples at first",
        off={"initial_step_factor": 1.0},
        code=(
            "avatar.config.TrainConfig.sample_step_at",
            "avatar.training.trainer.Trainer._config_at",
        ),
    ),
    Mechanism(name="end of rays at a surface", off={"opaque_margin_m": 10.0}),
    Mechanism(
        name="exposures",
        off={"estimate_exposures": False},
        code=("avatar.training.frame_exposure",),
    ),
    Mechanism(
        name="room light",
        off={"estimate_shading": False},
        code=("avatar.avatar_model.OrientationShading", "avatar.kernels.numba_shading"),
    ),
    Mechanism(
        name="more rays for the head",
        patched={"avatar.training.replay_buffer.HEAD_SIDE_RAY_SHARE": 0.0},
    ),
    Mechanism(
        name="mean of the parameters",
        patched={"avatar.training.trainer.EMA_HORIZON_STEPS": 1},
        code=("avatar.training.trainer.update_ema",),
    ),
    Mechanism(
        name="floaters dropped",
        patched={"avatar.occupancy_grid.MIN_COMPONENT_SHARE": 0.0},
        code=("avatar.occupancy_grid.find_floaters",),
    ),
    Mechanism(
        name="densities cached by samples",
        patched={"avatar.kernels.operations.scatter_max_density": lambda *_: None},
        code=(
            "avatar.kernels.operations.scatter_max_density",
            "avatar.kernels.numba_rendering.scatter_max_density",
        ),
    ),
    Mechanism(
        name="neighbors' pose errors",
        patched={"avatar.training.pose_correction.NEIGHBOR_PRECISION": 0.0},
        code=(
            "avatar.training.pose_correction.TemporalPosePrior",
            "avatar.training.pose_correction.prior_from_neighbors",
            "avatar.training.pose_correction._add_up_neighbors",
        ),
    ),
    Mechanism(
        name="pose refinement",
        off={"refine_poses": False},
        code=(
            "avatar.training.pose_optimizer",
            "avatar.training.pose_correction",
            "avatar.kernels.numba_pose",
        ),
    ),
    Mechanism(
        name="double well",
        off={"double_well_weight": 0.0},
        code=("avatar.kernels.numba_priors.double_well",),
    ),
    Mechanism(
        name="interior",
        off={"interior_weight": 0.0, "head_interior_weight": 0.0},
        code=("avatar.kernels.numba_priors.interior",),
    ),
    Mechanism(
        name="density slope and color variation",
        off={"density_slope_weight": 0.0, "color_tv_weight": 0.0},
        code=(
            "avatar.kernels.numba_priors.density_slope",
            "avatar.kernels.numba_priors.color_tv",
            "avatar.radiance_field.sample_smoothness_pairs",
        ),
    ),
    Mechanism(name="least density of occupied cells", off={"min_occupied_density": 0.0}),
    Mechanism(
        name="density off the skin",
        off={"off_skin_weight": 0.0},
        code=("avatar.kernels.numba_priors.log_density_l1",),
    ),
    Mechanism(
        name="unseen skin",
        off={"unseen_weight": 0.0},
        code=(
            "avatar.kernels.numba_priors.toward_sources",
            "avatar.training.unseen_skin",
            "avatar.training.unseen_skin",
        ),
    ),
]
"""What films are trained without, one by one."""


class MechanismScore(NamedTuple):
    """What a row came to on one capture with one seed.

    Attributes:
        name: Of the mechanism that was left out.
        step_ms: Core milliseconds a step.
        held_out: PSNR on white of held-out frames in fitted poses, dB.
        novel: The same of poses never filmed; None where there are none.
        half_transparent: Share of half-transparent pixels from four sides of poses never filmed.
    """

    name: str
    step_ms: float
    held_out: float
    novel: float | None
    half_transparent: float | None = None


class CaptureScores(NamedTuple):
    """All rows of one capture with one seed.

    Attributes:
        capture: Name of the capture.
        seed: Of training.
        steps: Of training.
        size_px: Longer side of the pictures, pixels.
        measured: Commit, date and machine.
        scores: A score for each row.
    """

    capture: str
    seed: int
    steps: int
    size_px: int
    measured: str
    scores: list[MechanismScore]


@dataclass(kw_only=True)
class _Run:
    mechanism: Mechanism
    trainer: Trainer
    steps: int
    spent_s: float = 0.0

    def train_slice(self) -> None:
        """One turn."""
        trainer, began = self.trainer, time.process_time()
        with self.mechanism.turned_off():
            while trainer.steps < self.steps and time.process_time() - began < SLICE_S:
                done = trainer.steps / self.steps
                falling = cosine_decay(done)
                trainer.step(
                    rate=falling,
                    hard_surface_share=min(1.0, 4.0 * done),
                    detail_share=1.0 - falling,
                )
        self.spent_s += time.process_time() - began


def measured_scores(
    folder: Path,
    kept: Path,
    *,
    size_px: int,
    steps: int,
    seed: int,
) -> CaptureScores:
    """The scores of every row on a capture; what `kept` holds is not measured again.

    Args:
        folder: Capture.
        kept: File of the scores, JSON.
        size_px: Longer side, pixels.
        steps, seed: Of training.
    """
    if not kept.exists():
        compared = ComparedCapture.open(folder, size_px)
        measured = ", ".join(Hardware.here().lines()[:2])
        scores = list(score_mechanisms(compared, MECHANISMS, steps, seed))
        found = CaptureScores(folder.name, seed, steps, size_px, measured, scores)
        kept.write_text(json.dumps(found._asdict(), indent=1) + "\n")
    found = CaptureScores(**json.loads(kept.read_text()))
    return found._replace(scores=[MechanismScore(*score) for score in found.scores])


def score_mechanisms(
    compared: ComparedCapture,
    mechanisms: Sequence[Mechanism],
    steps: int,
    seed: int,
) -> Iterator[MechanismScore]:
    """Trains without each mechanism, in turns, and scores each row in fitted poses.

    Args:
        compared: What is trained and scored on.
        mechanisms: Rows.
        steps, seed: Of training.
    """
    limit_threads(1)
    runs = [_begin(compared, mechanism, steps, seed) for mechanism in mechanisms]
    while under_way := [run for run in runs if run.trainer.steps < run.steps]:
        for run in under_way:
            run.train_slice()
    held_out, novel = (_some(frames) for frames in (compared.held_out, compared.novel))
    for run in runs:
        score = MechanismScore(
            run.mechanism.name,
            1e3 * run.spent_s / run.trainer.steps,
            _fitted_psnr(run.trainer, held_out),
            _fitted_psnr(run.trainer, novel) if novel else None,
            half_transparent_share(render_unfilmed_views(run.trainer.avatar)),
        )
        print(seed, *score, file=sys.stderr, flush=True)
        yield score


def _begin(compared: ComparedCapture, mechanism: Mechanism, steps: int, seed: int) -> _Run:
    total = round(steps * mechanism.steps_factor)
    trainer = new_trainer(
        compared.capture, seconds=60.0, steps=total, seed=seed, refine_poses=True,
    )  # fmt: skip
    trainer = Trainer(trainer.avatar.rig, replace(trainer.config, **mechanism.off))
    with mechanism.turned_off():
        for frame in compared.frames:
            trainer.add_frame(frame)
    return _Run(mechanism=mechanism, trainer=trainer, steps=total)


def _some(frames: list[HeldOutFrame]) -> list[HeldOutFrame]:
    places = np.linspace(0, len(frames) - 1, min(SCORED_FRAMES, len(frames))).round()
    return [frames[int(place)] for place in places]


def _fitted_psnr(trainer: Trainer, frames: list[HeldOutFrame]) -> float:
    fitted = fit_test_poses(trainer, frames)
    return float(np.mean([score_frame(trainer.avatar, frame).psnr for frame in fitted]))
