"""A video is enough: people tracked in films, and avatars learnt from nothing but these.

    python -m benchmarks.tracking [CAPTURE ...] [--subjects N] [--size PX] [--seconds S | --steps N]

Films phone-like actors who turn and dance, tracks them in the bare videos, and compares joints,
masks and avatars with the truth. Real captures and films may be named, too. Prints one table.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import tyro

from baselines.hardware import ROOT
from benchmarks.measurements import Measurement, print_measurements
from benchmarks.real import SUBJECTS, IngestRun, RealJob, film_phone_capture, ingest_command
from benchmarks.real_scores import score_novel_poses
from benchmarks.tracking_scores import (
    JointScore,
    body_iou,
    held_out_on_exact_masks,
    mask_iou,
    open_tracked,
    score_joints,
)
from capture.source_opening import open_source
from preprocess.capture_inputs import find_own_masks

AVATAR_TARGETS = {
    "held out, fitted poses": ("≥ -3", "≥ -1"),
    "held out, fitted poses, cut out by exact masks": ("≥ -3", "≥ -1"),
    "novel poses, fitted": ("≥ -3.5", "≥ -1.5"),
    "novel poses, true rotations": ("", ""),
}
"""What is scored of an avatar, and by how much the one from the video alone may be worse, dB."""
ONE_THREAD = {
    f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB_MAXIMUM")
}
"""Environment of a process of one thread."""


@dataclass(frozen=True, kw_only=True)
class TrackingJob:
    """Tracks people in films, learns avatars from these, and compares with the truth."""

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Real captures (their masks are compared with) or films; they are tracked and graded."""
    subjects: int = 1
    """How many phone-like actors; 0: only the captures named."""
    size: int = 540
    """Height of the phone-like pictures, which is also the longer side of training."""
    frames: int = 300
    """Frames of each phone-like film."""
    seconds: float = 120.0
    """Seconds of training."""
    steps: int | None = None
    """Steps of training instead: the result does not depend on the machine's speed."""
    seed: int = 0
    """Of the films and of training."""
    avatar: bool = True
    """Whether to learn avatars."""
    cost: bool = True
    """Whether to measure costs and the first step."""
    quick: bool = False
    """One actor, 150 frames of 270 pixels, 600 steps."""
    folder: Path = Path(tempfile.gettempdir()) / "instant-avatar-real"
    """Where films are kept for the next time, and runs are left."""
    json: Path | None = None
    """File for the figures."""
    ingest_options: tuple[str, ...] = ()
    """More arguments of ia-ingest."""

    @property
    def effective(self) -> "TrackingJob":
        """The job with what `quick` means."""
        if not self.quick:
            return self
        steps = self.steps or 600
        return replace(self, subjects=min(self.subjects, 1), frames=150, size=270, steps=steps)

    @property
    def learning(self) -> RealJob:
        """Films and trains as `benchmarks.real` does."""
        return RealJob(
            size=self.size, frames=self.frames, seconds=self.seconds, steps=self.steps,
            seed=self.seed, folder=self.folder, ingest_options=self.ingest_options,
        )  # fmt: skip


def main() -> None:
    """The benchmark."""
    asked = tyro.cli(TrackingJob, prog="python -m benchmarks.tracking", description=__doc__)
    job = asked.effective
    budget = f"{job.steps} steps" if job.steps is not None else f"{job.seconds:g} s of training"
    title = f"{job.frames} frames, {job.size} px tall, {budget}, seed {job.seed}"
    print_measurements(measure_all(job), job.json, title)


def measure_all(job: TrackingJob) -> Iterator[Measurement]:
    """All rows."""
    subjects = SUBJECTS[: job.subjects]
    turning = [film_phone_capture(job.learning, subject) for subject in subjects]
    if subjects:
        yield from measure_joints(job, turning, "turning", ("≤ 60", "≤ 35"))
        dancing = [film_phone_capture(job.learning, subject, "dance") for subject in subjects]
        yield from measure_joints(job, dancing, "dancing", ("≤ 80", "≤ 50"))
    if subjects and job.avatar:
        yield from measure_avatars(job, turning)
    if subjects and job.cost:
        yield from measure_costs(job, bare_film(turning[0], job.folder))
    for capture in job.captures:
        yield from measure_real(job, capture)


def bare_film(capture: Path, folder: Path) -> Path:
    """The film of a capture where nothing lies beside it: a link in `folder`."""
    film = open_source(capture).path.resolve()
    bare = folder / f"{capture.resolve().name}-film"
    if not film.is_dir():
        bare /= film.name
    bare.parent.mkdir(parents=True, exist_ok=True)
    if bare.resolve() != film:
        bare.unlink(missing_ok=True)
        bare.symlink_to(film, target_is_directory=film.is_dir())
    return bare


def track(film: Path, folder: Path) -> dict[str, Any]:
    """Runs ia-track; poses.npz and masks/ are in `folder` then. Returns the grades."""
    words = [
        sys.executable,
        "-m",
        "instant_avatar.track",
        str(film),
        "--out",
        str(folder / "poses.npz"),
    ]
    done = subprocess.run([*words, "--no-film", "--overwrite"], cwd=ROOT, check=False)
    if done.returncode not in (0, 1):
        sys.exit(f"ia-track ended with exit code {done.returncode}.")
    return json.loads((folder / "grade.json").read_text())


def measure_joints(
    job: TrackingJob, captures: list[Path], what: str, targets: tuple[str, str]
) -> Iterator[Measurement]:
    """Joints, sides and masks of the actors in one motion."""
    scores, grades, ious = list[JointScore](), list[dict[str, Any]](), list[float]()
    for capture in captures:
        film, tracked = bare_film(capture, job.folder), job.folder / f"tracked-{capture.name}"
        grades.append(track(film, tracked))
        scores.append(score_joints(tracked, film, capture / "truth"))
        size_px = open_source(film).size_px
        ious.append(mask_iou(tracked / "masks", capture / "truth" / "masks", size_px))
    missing = ", ".join(f"{score.missing_percent:.1f}" for score in scores)
    yield Measurement(
        name=f"{what}: joints to the truth, mm",
        value=fmean(score.error_mm for score in scores),
        required=targets[0],
        stretch_goal=targets[1],
        context=f"each actor {_each(score.error_mm for score in scores)}; pelvis on pelvis, one "
        f"scale a film; frames without a pose, %: {missing}",
    )
    yield Measurement(
        name=f"{what}: frames with left and right exchanged, %",
        value=fmean(score.swapped_percent for score in scores),
        required="≤ 1",
        stretch_goal="0",
        context=f"hips or shoulders; each actor {_each(s.swapped_percent for s in scores)}",
    )
    yield Measurement(
        name=f"{what}: tracked and exact masks, IoU",
        value=fmean(ious),
        context=f"body and tracked masks {_each(grade['iou_mean'] for grade in grades)}; good "
        f"enough by its own grade: {', '.join(str(grade['good_enough']) for grade in grades)}",
    )


def measure_avatars(job: TrackingJob, captures: list[Path]) -> Iterator[Measurement]:
    """Avatars from the video alone, beside those from exact inputs of the same films."""
    scores: dict[str, list[dict[str, float]]] = {"alone": [], "exact": []}
    for capture in captures:
        film = bare_film(capture, job.folder)
        commands = {
            "alone": ingest_command(job.learning, film),
            "exact": ingest_command(job.learning, capture, exact=True),
        }
        for inputs, command in commands.items():
            run = IngestRun(command, job.folder / f"run-{capture.name}-{inputs}")
            scores[inputs].append(avatar_scores(run, capture))
    for name, (required, stretch_goal) in AVATAR_TARGETS.items():
        alone, exact = ([each[name] for each in scores[inputs]] for inputs in ("alone", "exact"))
        yield Measurement(
            name=f"{name}: video alone less exact inputs, dB",
            value=fmean(alone) - fmean(exact),
            required=required,
            stretch_goal=stretch_goal,
            context=f"PSNR of each actor: video alone {_each(alone)}, exact inputs {_each(exact)}",
        )


def avatar_scores(run: IngestRun, capture: Path) -> dict[str, float]:
    """PSNR of an avatar by the names in `AVATAR_TARGETS`, dB.

    Novel poses are scored at the true camera; the product's fitting of held-out poses makes up for
    a body that is not the true one.
    """
    held = run.report["held_out_refined"] or run.report["held_out"]
    novel = score_novel_poses(run.folder, capture)
    exact = held_out_on_exact_masks(run.folder, capture / "truth")
    figures = (held["psnr"], exact, novel.fitted, novel.placed)
    return dict(zip(AVATAR_TARGETS, figures, strict=True))


def measure_costs(job: TrackingJob, film: Path) -> Iterator[Measurement]:
    """What a frame costs on one core, and how soon a stream is learnt from."""
    costs = json.loads(_run_child("tracking_cost", str(film), environment=ONE_THREAD))
    yield Measurement(
        name="networks and fit, core-ms a frame",
        value=costs["networks"] + costs["fit"],
        required="≤ 60",
        stretch_goal="≤ 25",
        context=f"networks {costs['networks']:.1f}, lift and fit {costs['fit']:.1f}; refining "
        f"masks besides {costs['masks']:.1f}; {costs['frames']:.0f} frames",
    )
    with tempfile.TemporaryDirectory() as scratch:
        options = ["--size", str(job.size), *job.ingest_options]
        lines = [
            _run_child("first_tracked_step", str(film), f"{scratch}/{n}", *options)
            for n in range(2)
        ]
    (first_s, _), (wall_s, cpu_s) = (map(float, line.split()) for line in lines)
    yield Measurement(
        name="from the first frame to the first step, s",
        value=wall_s,
        required="≤ 3",
        stretch_goal="≤ 1",
        context=f"second of two runs, the first {first_s:.2f}; played at its own speed, networks "
        f"and kernels loaded; {cpu_s:.2f} core-s",
    )


def measure_real(job: TrackingJob, capture: Path) -> Iterator[Measurement]:
    """A real film, tracked without what lies beside it; given masks tell how well."""
    film, name = bare_film(capture, job.folder), capture.resolve().name
    tracked = job.folder / f"tracked-{name}"
    grade, masks = track(film, tracked), find_own_masks(capture) if capture.is_dir() else None
    if masks is not None:
        size_px = open_source(film).size_px
        yield Measurement(
            name=f"{name}: body and given masks, IoU",
            value=body_iou(open_tracked(tracked, film, masks)),
            required="≥ 0.88",
            stretch_goal="≥ 0.93",
            context=f"tracked and given masks {mask_iou(tracked / 'masks', masks, size_px):.3f}",
        )
    yield Measurement(
        name=f"{name}: body and tracked masks, IoU",
        value=body_iou(open_tracked(tracked, film)),
        context=f"its own grade: {grade['summary']}",
    )


def _run_child(module: str, *words: str, environment: dict[str, str] | None = None) -> str:
    """Last line that a module of this package prints in a process of its own."""
    command = [sys.executable, "-m", f"benchmarks.{module}", *words]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **(environment or {})}, stdout=subprocess.PIPE,
        text=True, check=True,
    )  # fmt: skip
    return done.stdout.splitlines()[-1]


def _each(values: Iterator[float] | list[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values)


if __name__ == "__main__":
    main()
