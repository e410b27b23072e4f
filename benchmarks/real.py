"""Captures like real ones, from end to end: three subjects filmed as by a phone, and your own.

    python -m benchmarks.real [CAPTURE ...] [--subjects N] [--size PX] [--seconds S | --steps N]

ia-ingest learns each capture as a user would, and each phone-like capture once more with exact
body, poses, camera and masks: the difference is what alignment still costs. Prints one table.
"""

import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from baselines.hardware import ROOT, Hardware
from benchmarks.measurements import format_value
from benchmarks.real_scores import (
    given_pose_error_deg,
    joint_error_cm,
    learnt_pose_error_deg,
    rest_joint_distance_cm,
    score_novel_poses,
)
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.body.parametric_body import load_body_model

Figures = dict[str, float | None]
"""Values by what was measured, in the order of the table; None where there is none."""
SUBJECTS: tuple[Literal[1, 2, 3], ...] = (1, 2, 3)
"""Who is filmed."""
STEPS_BEGIN = "loading torch"
"""What ia-ingest prints when opening, checks and alignment are done."""


@dataclass(frozen=True, kw_only=True)
class RealJob:
    """Learns captures like real ones with ia-ingest, and compares with the truth."""

    captures: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Capture folders of real people: they get the rows that need no truth."""
    subjects: int = 3
    """How many phone-like captures; 0: only the captures named."""
    size: int = 540
    """Height of the phone-like pictures, which is also the longer side of training."""
    frames: int = 300
    """Frames of each phone-like capture."""
    seconds: float = 120.0
    """Seconds of training."""
    steps: int | None = None
    """Steps of training instead: the result does not depend on the machine's speed."""
    seed: int = 0
    """Of the captures and of training."""
    exact: bool = True
    """Whether to learn each phone-like capture once more with exact inputs."""
    quick: bool = False
    """One subject, 60 frames of 240 pixels, 300 steps."""
    folder: Path = Path(tempfile.gettempdir()) / "instant-avatar-real"
    """Where captures are kept for the next time, and runs are left."""
    json: Path | None = None
    """File for the figures."""
    ingest_options: tuple[str, ...] = ()
    """More arguments of ia-ingest."""

    @property
    def effective(self) -> "RealJob":
        """The job with what `quick` means."""
        if not self.quick:
            return self
        return replace(self, subjects=min(self.subjects, 1), frames=60, size=240, steps=300)


class IngestRun:
    """One ia-ingest: its report and its costs."""

    def __init__(self, command: list[str], out: Path) -> None:
        """Runs the command to its end.

        Args:
            command: Of ia-ingest, without --out.
            out: Folder of the run; an older one is replaced.
        """
        words = [
            sys.executable,
            "-m",
            "instant_avatar.ingest",
            *command,
            "--out",
            str(out),
            "--overwrite",
        ]
        print(f"ia-ingest {shlex.join(words[3:])}", file=sys.stderr, flush=True)
        began, self.preparing_core_s = time.perf_counter(), None
        with subprocess.Popen(words, cwd=ROOT, stderr=subprocess.PIPE, text=True) as process:
            assert process.stderr is not None
            for line in process.stderr:
                print(line, end="", file=sys.stderr, flush=True)
                if line.startswith(STEPS_BEGIN):
                    self.preparing_core_s = core_seconds(process.pid)
        self.wall_s, self.folder = time.perf_counter() - began, out
        path = out / "report.json"
        if process.returncode not in (0, 1) or not path.exists():
            sys.exit(f"ia-ingest ended with exit code {process.returncode}.")
        self.report: dict[str, Any] = json.loads(path.read_text())


def core_seconds(pid: int) -> float | None:
    """CPU time of a process until now, all threads; None where there is no /proc."""
    path = Path(f"/proc/{pid}/stat")
    if not path.exists():
        return None
    fields = path.read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """The benchmark."""
    asked = tyro.cli(RealJob, prog="python -m benchmarks.real", description=__doc__)
    job, hardware = asked.effective, Hardware.here()
    columns = dict(measure_all(job))
    budget = f"{job.steps} steps" if job.steps is not None else f"{job.seconds:g} s of training"
    title = f"{job.frames} frames, {job.size} px tall, {budget}, seed {job.seed}"
    print("\n".join([*hardware.lines(), title, "", *table_lines(columns)]))
    if job.json is not None:
        content = {"hardware": asdict(hardware), "title": title, "figures": columns}
        job.json.write_text(json.dumps(content, indent=1) + "\n")


def measure_all(job: RealJob) -> Iterator[tuple[str, Figures]]:
    """Each column of the table, by its heading."""
    for subject in SUBJECTS[: job.subjects]:
        yield f"subject {subject}", measure_phone_capture(job, subject)
    for capture in job.captures:
        name = capture.resolve().name
        yield name, run_figures(IngestRun(ingest_command(job, capture), job.folder / f"run-{name}"))


def measure_phone_capture(job: RealJob, subject: Literal[1, 2, 3]) -> Figures:
    """Films a phone-like capture and learns it, twice."""
    capture = film_phone_capture(job, subject)
    run = IngestRun(ingest_command(job, capture), job.folder / f"run-{subject}")
    figures = run_figures(run) | truth_figures(run.folder, capture)
    if not job.exact:
        return figures
    exact = IngestRun(ingest_command(job, capture, exact=True), job.folder / f"run-{subject}-exact")
    return figures | exact_figures(exact, capture, figures)


def film_phone_capture(
    job: RealJob,
    subject: Literal[1, 2, 3],
    motion: Literal["turn", "dance"] = "turn",
    *,
    tracker_error: float = 1.0,
) -> Path:
    """The folder of a phone-like capture, which is filmed unless it lies there already.

    Args:
        job: Size, length and seed of the film, and the folder above.
        subject: Who is filmed.
        motion: What the subject does.
        tracker_error: Factor of a good tracker's errors in the given poses.
    """
    width = 2 * round(job.size * 9 / 32)
    named = f"phone-{subject}-{width}px-{job.frames}-seed{job.seed}"
    named = named if motion == "turn" else f"{named}-{motion}"
    capture = job.folder / (named if tracker_error == 1.0 else f"{named}-error{tracker_error:g}")
    if not capture.exists():
        config = ShootConfig(
            frames=job.frames,
            size=width,
            seed=job.seed,
            subject=subject,
            like_a_phone=True,
            motion=motion,
            tracker_error=tracker_error,
        )
        film_capture(capture, config)
    return capture


def ingest_command(job: RealJob, capture: Path, *, exact: bool = False) -> list[str]:
    """Arguments of ia-ingest for a capture; `exact` for the truth of a phone-like one."""
    budget = ["--seconds", str(job.seconds)] if job.steps is None else ["--steps", str(job.steps)]
    common = ["--size", str(job.size), "--seed", str(job.seed), *budget, *job.ingest_options]
    if not exact:
        return [str(capture), *common]
    truth = capture / "truth"
    named = {
        "--poses": "poses.npz", "--masks": "masks", "--cameras": "cameras.npz", "--body": "body.npz"
    }  # fmt: skip
    inputs = [word for option, name in named.items() for word in (option, str(truth / name))]
    return [str(capture / "video.mp4"), *inputs, *common]


def run_figures(run: IngestRun) -> Figures:
    """What a run's own report says, and what it cost."""
    report = run.report
    training, package = report["training"], report["package"]
    given, fitted = report["held_out"], report["held_out_refined"] or {}
    in_steps = training.get("step_cpu_seconds")
    after = run.wall_s - training["startup_seconds"] - training["wall_seconds"]
    ready = report["stream"]["ready_after_last_frame_seconds"]
    return {
        "held out, given poses: PSNR, dB": given["psnr"],
        "held out, given poses: SSIM": given["ssim"],
        "held out, fitted poses: PSNR, dB": fitted.get("psnr"),
        "held out, fitted poses: SSIM": fitted.get("ssim"),
        "core-s before torch is loaded: opening, checks, alignment": run.preparing_core_s,
        "start-up, s": training["startup_seconds"],
        "skin that was seen, %": 100.0 * report["all_round"]["seen"],
        "half-transparent pixels, %": 100.0 * report["all_round"]["half_transparent"],
        "steps": float(training["steps"]),
        "core-ms a step": None if in_steps is None else 1e3 * in_steps / training["steps"],
        "share of training's core time in steps, %": None
        if in_steps is None
        else 100.0 * in_steps / training["cpu_seconds"],
        "samples a ray": training["samples_per_ray"],
        "peak memory, MiB": training["peak_memory_mb"],
        "package, MB": None if package is None else package["bytes"] / 1e6,
        "baking and checks, s": None if package is None else package["seconds"],
        "player Lite to renderer, dB": None
        if package is None
        else package["psnr_to_renderer"]["lite"],
        "package ready after the last frame, s": ready,
        "from the last step to the end, s": after,
        "whole command, s": run.wall_s,
    }


def truth_figures(run: Path, capture: Path) -> Figures:
    """How near a run came to the truth of its capture."""
    novel = score_novel_poses(run, capture)
    true_joints = load_body_model(capture / "truth" / "body.npz").joints
    return {
        "novel poses, true rotations: PSNR, dB": novel.placed,
        "novel poses, fitted as held-out frames: PSNR, dB": novel.fitted,
        "novel poses, fitted: PSNR in the mask, dB": novel.fitted_mask,
        "novel poses, fitted: SSIM": novel.fitted_ssim,
        "rest joints, given, cm": rest_joint_distance_cm(load_body_model().joints, true_joints),
        "rest joints, learnt, cm": joint_error_cm(run, capture),
        "pose error, given, degrees": given_pose_error_deg(capture),
        "pose error, learnt, degrees": learnt_pose_error_deg(run, capture),
    }


def exact_figures(exact: IngestRun, capture: Path, figures: Figures) -> Figures:
    """The same film with exact inputs, and what alignment still costs."""
    held = exact.report["held_out_refined"] or exact.report["held_out"]
    novel = score_novel_poses(exact.folder, capture)
    costs = {
        "held out": (held["psnr"], figures["held out, fitted poses: PSNR, dB"]),
        "novel poses": (novel.fitted, figures["novel poses, fitted as held-out frames: PSNR, dB"]),
    }
    return {
        "exact inputs: held out, given poses: PSNR, dB": exact.report["held_out"]["psnr"],
        "exact inputs: held out, fitted poses: PSNR, dB": held["psnr"],
        "exact inputs: novel poses, true rotations: PSNR, dB": novel.placed,
        "exact inputs: novel poses, fitted: PSNR, dB": novel.fitted,
        **{
            f"what alignment costs, {name}, dB": None if None in pair else pair[0] - pair[1]
            for name, pair in costs.items()
        },
    }


def table_lines(columns: dict[str, Figures]) -> list[str]:
    """The figures as Markdown: a row each, a column for each capture, and their mean."""
    names = list(dict.fromkeys(name for figures in columns.values() for name in figures))
    rows = [["figure", *columns, "mean"]]
    for name in names:
        values = [figures.get(name) for figures in columns.values()]
        known = [value for value in values if value is not None]
        mean = sum(known) / len(known) if known else None
        rows.append([name, *map(format_value, values), format_value(mean)])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "| " + " | ".join(
            [row[0].ljust(widths[0])]
            + [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
        ) + " |"
        for row in rows
    ]  # fmt: skip
    rule = "|" + "|".join(
        ["-" * (widths[0] + 2), *("-" * (width + 1) + ":" for width in widths[1:])]
    )
    return [lines[0], rule + "|", *lines[1:]]


if __name__ == "__main__":
    main()
