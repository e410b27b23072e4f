"""What each mechanism of training buys, and the paper's own ablations.

    python -m benchmarks.ablation [--tables mechanisms|paper] [--few CAPTURE] [--keep FOLDER]
        [--seconds S] [--quick] [--json FILE] [--write docs/ablation.md]

First, each mechanism is left out in turn on phone-like films, and each prior of estimated poses on
few frames of one and of a capture of your own (`benchmarks.mechanisms`). Then the paper's tables on
an exact sample: losses, empty-space skipping, root finding, refinement; all variants of a table are
trained in turns in one process, with one thread, each for the same seconds of one core and then
again for the same number of steps, and scored by the exact renderer on held-out frames and on poses
that were never filmed. There are no thresholds here.
"""

import json
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import tyro

from avatar.avatar_model import Avatar
from avatar.evaluation.held_out import HeldOutFrame
from avatar.rig import Rig
from avatar.training.frame_stream import TrainingFrame
from baselines.instant_avatar.samplers import BaselineScheme
from benchmarks.ablation_page import AblationPage, mechanism_lines, written
from benchmarks.hardware import Hardware
from benchmarks.mechanisms import CaptureScores, measured_scores
from benchmarks.paired_training import (
    TrainingBudget,
    Variant,
    VariantOutcome,
    VariantRun,
    score_variant,
    train_variants,
)
from benchmarks.sample_training import film_sample, load_trainer, open_sample, training_config
from benchmarks.scheme_timing import SchemeTiming, time_scheme
from benchmarks.stopwatch import limit_threads
from benchmarks.training_quality import NOISE, novel_pose_frames, with_true_poses
from preprocess.capture_session import Capture

PHONE_PX = 270
"""Longer side of phone-like pictures."""
FEW = 8
"""Frames of a capture of few frames, the held-out one included."""
TIMED_POSES = 3
"""Novel poses that every scheme draws."""
PAPER = "union grid, Broyden (the paper)"
POSES_AS_GIVEN = {"refine_poses": False}
LOSS_VARIANTS = [
    Variant(name="full", changes=POSES_AS_GIVEN),
    Variant(name="w/o alpha loss", changes={**POSES_AS_GIVEN, "alpha_weight": 0.0}),
    Variant(name="w/o hard surface", changes={**POSES_AS_GIVEN, "hard_surface_weight": 0.0}),
    Variant(
        name="w/o occupancy-based regulariser",
        changes={**POSES_AS_GIVEN, "empty_space_weight": 0.0},
    ),
    Variant(name="w/o total variation", changes={**POSES_AS_GIVEN, "density_tv_weight": 0.0}),
    Variant(
        name="global sparsity instead",
        changes=POSES_AS_GIVEN,
        scheme=BaselineScheme(empty_term="global"),
    ),
]
NO_EMPTY_SPACE = {**POSES_AS_GIVEN, "empty_space_weight": 0.0}
CORRESPONDENCE_VARIANTS = [
    Variant(
        name="union grid, cells", changes=POSES_AS_GIVEN, scheme=BaselineScheme(skipping="union")
    ),
    Variant(
        name="per-frame grids, cells",
        changes=POSES_AS_GIVEN,
        scheme=BaselineScheme(skipping="frame"),
    ),
    Variant(
        name="no skipping, cells", changes=NO_EMPTY_SPACE, scheme=BaselineScheme(skipping="none")
    ),
]
BROYDEN_VARIANTS = [
    Variant(
        name="canonical occupancy, Broyden",
        changes=POSES_AS_GIVEN,
        scheme=BaselineScheme(roots="broyden"),
    ),
    Variant(
        name=PAPER,
        changes=POSES_AS_GIVEN,
        scheme=BaselineScheme(skipping="union", roots="broyden"),
    ),
    Variant(
        name="no skipping, Broyden",
        changes=NO_EMPTY_SPACE,
        scheme=BaselineScheme(skipping="none", roots="broyden"),
    ),
]
REFINEMENT_VARIANTS = [
    Variant(name="poses as given", changes=POSES_AS_GIVEN),
    Variant(name="poses refined", changes={"refine_poses": True}),
]


@dataclass(frozen=True, kw_only=True)
class Ablation:
    """Trains every variant, and prints the tables."""

    tables: Literal["all", "mechanisms", "paper"] = "all"
    """What is measured: the mechanisms, the paper's tables, or both."""
    subjects: tuple[Literal[1, 2, 3], ...] = (1, 2)
    """Who is filmed as by a phone."""
    seeds: tuple[int, ...] = (0,)
    """Of training, for the mechanisms."""
    few: Path | None = None
    """Capture of a few photographs, for the priors of estimated poses."""
    quick: bool = False
    """Two seconds and twenty steps each: whether it runs, not what comes out."""
    size: int = 128
    """Width and height of the pictures."""
    seconds: float = 20.0
    """Core seconds for each variant."""
    steps: int = 400
    """Steps for each variant, where they are counted."""
    mechanism_steps: int = 600
    """Steps without each mechanism."""
    json: Path | None = None
    """File for the figures."""
    write: Path | None = None
    """Markdown file whose tables are replaced; text outside its marks is kept."""
    keep: Path | None = None
    """Folder for what is filmed; what lies there is used again."""


class AblationData(NamedTuple):
    """What is trained on, and what is scored."""

    recording: Capture
    rig: Rig
    frames: list[TrainingFrame]
    held_out: list[HeldOutFrame]
    novel: list[HeldOutFrame]


def main() -> None:
    """The benchmark."""
    job = tyro.cli(Ablation, prog="python -m benchmarks.ablation", description=__doc__)
    if job.quick:
        job = replace(job, seconds=2.0, steps=20, mechanism_steps=20)
    hardware = Hardware.here()
    with tempfile.TemporaryDirectory() as temporary:
        folder = job.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        if job.tables != "paper":
            show(job, "mechanisms", mechanism_lines(list(run_mechanisms(job, folder))))
        if job.tables == "mechanisms":
            return
        page = run_ablation(job, hardware, folder)
    show(job, "tables", page.lines())
    if job.json is not None:
        job.json.write_text(json.dumps(asdict(page), indent=1) + "\n")


def show(job: Ablation, mark: str, lines: list[str]) -> None:
    """Prints tables, and writes them between their marks of the page."""
    print("\n".join(lines))
    if job.write is not None:
        job.write.write_text(written(mark, lines, job.write))


def run_mechanisms(job: Ablation, folder: Path) -> Iterator[CaptureScores]:
    """The mechanisms on phone-like films, then the priors of estimated poses on few frames."""
    films = [film_by_phone(folder, subject, quick=job.quick) for subject in job.subjects]
    few = [films[-1], *([job.few] if job.few is not None else [])]
    for capture, frames in [*((film, None) for film in films), *((each, FEW) for each in few)]:
        for seed in job.seeds:
            name = f"{capture.name}-{frames or 'all'}-seed{seed}.json"
            yield measured_scores(
                capture, folder / name,
                size_px=PHONE_PX, steps=job.mechanism_steps, seed=seed, frames=frames,
                dance=None if frames is None else films[-1] / "dance.npz",
            )  # fmt: skip


def film_by_phone(folder: Path, subject: Literal[1, 2, 3], *, quick: bool) -> Path:
    """A phone-like film of ten seconds, ten frames a second."""
    frames = 30 if quick else 100
    return film_sample(
        folder / f"phone-{subject}", 2 * round(PHONE_PX * 9 / 32),
        like_a_phone=True, subject=subject, frames=frames, fps=10,
    )  # fmt: skip


def run_ablation(job: Ablation, hardware: Hardware, folder: Path) -> AblationPage:
    """Measures all tables, and prints each row on standard error when it is ready."""
    began = time.process_time()
    scene = load_data(film_sample(folder / f"sample{job.size}", job.size))
    runs = train_on_scene(
        scene,
        [*LOSS_VARIANTS, *CORRESPONDENCE_VARIANTS, *BROYDEN_VARIANTS],
        TrainingBudget(seconds=job.seconds),
    )
    by_time = outcomes_of(runs, scene)
    occupancy_ms, ours = occupancy_update_ms(runs[0]), runs[0].trainer.avatar
    del runs
    counted = TrainingBudget(steps=job.steps)
    runs = train_on_scene(
        scene, [LOSS_VARIANTS[0], *CORRESPONDENCE_VARIANTS, *BROYDEN_VARIANTS], counted
    )
    by_steps = outcomes_of(runs, scene)
    schemes = time_schemes(ours, _run_named(runs, PAPER).trainer.avatar, scene)
    del runs
    noisy_capture = film_sample(folder / f"noisy{job.size}", job.size, **NOISE)
    noisy = load_data(noisy_capture)
    noisy = noisy._replace(held_out=with_true_poses(noisy_capture, noisy.held_out, noisy.rig))
    budget = TrainingBudget(seconds=job.seconds)
    return AblationPage(
        hardware=hardware.lines(),
        size=job.size,
        seconds=job.seconds,
        steps=job.steps,
        pictures=(len(scene.frames), len(scene.held_out), len(scene.novel), TIMED_POSES),
        occupancy_ms=occupancy_ms,
        losses=by_time[: len(LOSS_VARIANTS)],
        by_time=[by_time[0], *by_time[len(LOSS_VARIANTS) :]],
        by_steps=by_steps,
        scheme_timings=schemes,
        exact=outcomes_of(train_on_scene(scene, REFINEMENT_VARIANTS, budget), scene),
        noisy=outcomes_of(train_on_scene(noisy, REFINEMENT_VARIANTS, budget), noisy),
        core_minutes=(time.process_time() - began) / 60.0,
    )


def load_data(capture: Path) -> AblationData:
    """A filmed sample, every frame made ready."""
    limit_threads(1)
    recording = open_sample(capture)
    rig = Rig.from_shaped_body(recording.shaped)
    seen = load_trainer(recording, rig, training_config(recording, 60.0))
    return AblationData(recording, rig, seen.frames, seen.held_out, novel_pose_frames(capture, rig))


def train_on_scene(
    scene: AblationData, variants: list[Variant], budget: TrainingBudget
) -> list[VariantRun]:
    """Every variant after its budget."""
    return train_variants(variants, budget, scene.recording, scene.rig, scene.frames)


def outcomes_of(runs: Iterable[VariantRun], scene: AblationData) -> list[VariantOutcome]:
    """What became of them."""
    outcomes = []
    for run in runs:
        outcomes.append(score_variant(run, scene.held_out, scene.novel))
        print(outcomes[-1], file=sys.stderr, flush=True)
    return outcomes


def occupancy_update_ms(run: VariantRun) -> float:
    """What keeping the canonical occupancy costs a step: every variant pays it, ours alone must."""
    every = run.trainer.config.occupancy_interval
    began = time.process_time()
    for _ in range(3):
        run.trainer._update_occupancy(0.0)
    return 1000.0 * (time.process_time() - began) / 3 / every


def _run_named(runs: list[VariantRun], name: str) -> VariantRun:
    return next(run for run in runs if run.variant.name == name)


def time_schemes(ours: Avatar, theirs: Avatar, scene: AblationData) -> list[SchemeTiming]:
    """Two avatars, ours and that of the paper's own training, drawn by each scheme."""
    step = max(1, len(scene.novel) // TIMED_POSES)
    pictures = scene.novel[::step][:TIMED_POSES]
    rows = [
        time_scheme("canonical occupancy, cells", ours, pictures, scheme=None),
        time_scheme(
            "per-frame grid, cells", ours, pictures, scheme=BaselineScheme(skipping="frame")
        ),
        time_scheme("no skipping, cells", ours, pictures, scheme=BaselineScheme(skipping="none")),
        time_scheme(
            "per-frame grid, Broyden (the paper)", theirs, pictures,
            scheme=BaselineScheme(skipping="frame", roots="broyden"),
        ),
        time_scheme(
            "no skipping, Broyden", theirs, pictures,
            scheme=BaselineScheme(skipping="none", roots="broyden"),
        ),
    ]  # fmt: skip
    for row in rows:
        print(row, file=sys.stderr, flush=True)
    return rows


if __name__ == "__main__":
    main()
