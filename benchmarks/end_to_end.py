"""The main job from end to end: film a sample, learn it, play it in poses never seen.

    python -m benchmarks.end_to_end [--size 256 --frames 120 --seconds 60] [--json FILE]

Prints one table. There are no thresholds here: figures are read beside those of earlier commits.
"""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from avatar.evaluation.image_metrics import composite_on_white, ground_truth_on_white, psnr, ssim
from benchmarks.hardware import ROOT, Hardware
from export.player import Player, premultiply
from instant_avatar.report.report_schema import CurvePoint
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.capture_inputs import CaptureInputs
from preprocess.observation import Observation
from preprocess.open_capture import open_capture


@dataclass(frozen=True, kw_only=True)
class EndToEndJob:
    """Films a sample, learns it with ia-ingest, and scores the avatar in poses never seen."""

    size: int = 256
    """Width and height of the pictures."""
    frames: int = 120
    """Frames of the video."""
    seconds: float = 60.0
    """Seconds of training."""
    seed: int = 0
    """Of the sample and of training."""
    subject: int = 1
    """Which of the studio's actors."""
    pose_noise_deg: float = 0.0
    """Noise of the given poses, degrees."""
    pose_noise_cm: float = 0.0
    """Noise of the given places, centimetres."""
    keep: Path | None = None
    """Folder for capture and run; without it both are thrown away."""
    json: Path | None = None
    """File for the figures."""
    ingest_options: list[str] = field(default_factory=list)
    """More arguments of ia-ingest."""


@dataclass(frozen=True, kw_only=True)
class EndToEndRow:
    """One figure.

    Attributes:
        name: What was measured, with its unit.
        value: None where there is none.
        reference: What to read it beside, and what that is.
    """

    name: str
    value: float | None
    reference: str = ""


@dataclass(frozen=True, kw_only=True)
class NovelPoseScores:
    """How well poses are shown that were never filmed: means over all of them.

    Attributes:
        psnr, psnr_mask, ssim: On white, against the studio's own pictures.
        ms: CPU time of a picture.
    """

    psnr: float
    psnr_mask: float
    ssim: float
    ms: float


def main() -> None:
    """The benchmark."""
    job = tyro.cli(EndToEndJob, prog="python -m benchmarks.end_to_end", description=__doc__)
    hardware = Hardware.here()
    with tempfile.TemporaryDirectory() as temporary:
        rows = measure_job(job, job.keep or Path(temporary))
    title = f"{job.frames} frames of {job.size} px, {job.seconds:g} s of training, seed {job.seed}"
    print("\n".join([*hardware.lines(), title, "", *markdown_lines(rows)]))
    if job.json is not None:
        content = {
            "hardware": asdict(hardware),
            "job": {k: v for k, v in vars(job).items() if k not in ("keep", "json")},
            "figures": {row.name: row.value for row in rows},
        }
        job.json.write_text(json.dumps(content, indent=1) + "\n")


def measure_job(job: EndToEndJob, folder: Path) -> list[EndToEndRow]:
    """Does the whole job in a folder."""
    capture, run = folder / "capture", folder / "run"
    config = ShootConfig(
        frames=job.frames, size=job.size, seed=job.seed, subject=job.subject,
        pose_noise_deg=job.pose_noise_deg, pose_noise_cm=job.pose_noise_cm,
    )  # fmt: skip
    began = time.perf_counter()
    film_capture(capture, config, overwrite=True)
    filmed = time.perf_counter() - began
    report, whole = run_ingest(job, capture, run)
    unseen = novel_observations(capture)
    rows = [*training_rows(report), *novel_rows(run, unseen), *cost_rows(report, run)]
    video = f"the video lasts {video_seconds(job):.1f} s"
    return [
        *rows,
        EndToEndRow(name="whole ia-ingest, s", value=whole, reference=video),
        EndToEndRow(name="filming the sample, s", value=filmed),
    ]


def video_seconds(job: EndToEndJob) -> float:
    """Of the video, seconds."""
    return job.frames / ShootConfig().fps


def run_ingest(job: EndToEndJob, capture: Path, run: Path) -> tuple[dict[str, Any], float]:
    """Runs ia-ingest as a user does; its report, and how long all of it took."""
    command = [sys.executable, "-m", "instant_avatar.ingest", str(capture / "video.mp4")]
    command += ["--poses", str(capture / "poses.npz"), "--out", str(run), "--overwrite"]
    command += ["--seconds", str(job.seconds), "--seed", str(job.seed), *job.ingest_options]
    began = time.perf_counter()
    done = subprocess.run(command, cwd=ROOT, stdout=sys.stderr, check=False)
    took = time.perf_counter() - began
    if not (run / "report.json").exists():
        sys.exit(f"ia-ingest ended with exit code {done.returncode} and left no report.")
    return json.loads((run / "report.json").read_text()), took


def novel_observations(capture: Path) -> list[Observation]:
    """The poses that were never filmed, with their true pictures and masks."""
    wanted = CaptureInputs(video=capture / "truth" / "novel", cameras=str(capture / "cameras.npz"))
    return [seen for seen in open_capture(wanted).observations() if isinstance(seen, Observation)]


def training_rows(report: dict[str, Any]) -> list[EndToEndRow]:
    """Held-out frames, and the way there."""
    rows = []
    for key, name in (("held_out", "held out"), ("held_out_refined", "held out, refined poses")):
        held = report.get(key)
        if held is not None:
            frames = f"{len(held['frames'])} frames"
            rows += [
                EndToEndRow(name=f"{name}, PSNR dB", value=held["psnr"], reference=frames),
                EndToEndRow(name=f"{name}, PSNR in the mask dB", value=held["psnr_mask"]),
                EndToEndRow(name=f"{name}, SSIM", value=held["ssim"]),
            ]
    curve = [point for point in report["curve"] if point["psnr"] is not None]
    told = ", ".join(f"{point['wall_seconds']:.0f} s {point['psnr']:.1f}" for point in curve)
    fall = largest_drop([CurvePoint.from_checkpoint(point) for point in curve])
    return [
        *rows,
        EndToEndRow(name="largest fall of a frame from its best, dB", value=fall, reference=told),
    ]


def largest_drop(curve: list[CurvePoint]) -> float | None:
    """Return the largest drop of a frame below its own earlier best, dB; None if none can have."""
    best: dict[tuple[int, int], float] = {}
    drops = list[float]()
    for point in curve:
        for number, score in point.frames:
            frame = point.video, number
            if frame in best:
                drops.append(max(0.0, best[frame] - score))
            best[frame] = max(best.get(frame, score), score)
    return max(drops, default=None)


def novel_rows(run: Path, unseen: list[Observation]) -> list[EndToEndRow]:
    """Poses never filmed: by the player, by the volume renderer, and as a white sheet."""

    from avatar.render import render
    from avatar.training import checkpoint

    trainer, _ = checkpoint.load(run / "checkpoint")
    exact = score_images(
        unseen, lambda seen: composite_on_white(render(trainer.avatar, seen.pose, seen.camera))
    )
    sheet = score_images(unseen, lambda seen: np.ones_like(ground_truth_on_white(seen)))
    rows = [
        EndToEndRow(
            name="novel poses, volume renderer, PSNR dB",
            value=exact.psnr,
            reference=f"{len(unseen)} poses; a white sheet: {sheet.psnr:.2f}",
        ),
        EndToEndRow(
            name="novel poses, volume renderer, PSNR in the mask dB", value=exact.psnr_mask
        ),
        EndToEndRow(name="novel poses, volume renderer, SSIM", value=exact.ssim),
    ]
    if not (run / "avatar.iavatar").exists():
        return rows
    player = Player.load(run / "avatar.iavatar")
    played = score_images(
        unseen, lambda seen: composite_on_white(premultiply(player.render(seen.pose, seen.camera)))
    )
    lost = f"{played.psnr - exact.psnr:+.2f} to the volume renderer"
    faster = f"volume renderer {exact.ms:.0f}: {exact.ms / played.ms:.1f} times"
    return [
        EndToEndRow(name="novel poses, player, PSNR dB", value=played.psnr, reference=lost),
        EndToEndRow(name="novel poses, player, PSNR in the mask dB", value=played.psnr_mask),
        EndToEndRow(name="novel poses, player, SSIM", value=played.ssim),
        *rows,
        EndToEndRow(name="player, CPU ms a picture", value=played.ms, reference=faster),
    ]


def score_images(unseen: list[Observation], picture: Any) -> NovelPoseScores:
    """Scores what `picture` shows of each observation, and times it."""
    picture(unseen[0])  # warms up
    scores, spent = [], 0.0
    for seen in unseen:
        began = time.process_time()
        image = np.clip(picture(seen), 0.0, 1.0)
        spent += time.process_time() - began
        truth, mask = ground_truth_on_white(seen), seen.alpha > 0.5
        scores.append((psnr(image, truth), psnr(image, truth, mask), ssim(image, truth)))
    whole, inside, alike = np.mean(scores, axis=0)
    milliseconds = 1000.0 * spent / len(unseen)
    return NovelPoseScores(
        psnr=float(whole), psnr_mask=float(inside), ssim=float(alike), ms=milliseconds
    )


def cost_rows(report: dict[str, Any], run: Path) -> list[EndToEndRow]:
    """Time, work and bytes."""
    training, package = report["training"], report["package"]
    rows = [
        EndToEndRow(name="start-up, s", value=training["startup_seconds"]),
        EndToEndRow(
            name="training, wall s",
            value=training["wall_seconds"],
            reference=f"CPU {training['cpu_seconds']:.1f}: "
            f"{training['cpu_seconds'] / max(training['wall_seconds'], 1e-6):.2f} cores",
        ),
        EndToEndRow(name="steps", value=training["steps"]),
        EndToEndRow(name="rays a second", value=training["rays_per_second"]),
        EndToEndRow(name="samples a ray", value=training["samples_per_ray"]),
        EndToEndRow(name="peak memory, MB", value=training["peak_memory_mb"]),
    ]
    if package is None:
        return [*rows, EndToEndRow(name="package, MB", value=None, reference="refused")]
    state = sum(path.stat().st_size for path in (run / "checkpoint").iterdir())
    smaller = f"the checkpoint is {state / package['bytes']:.1f} times as large"
    to_renderer = package["psnr_to_renderer"]["hq"]
    return [
        *rows,
        EndToEndRow(name="bake and checks, s", value=package["seconds"]),
        EndToEndRow(name="package, MB", value=package["bytes"] / 1e6, reference=smaller),
        EndToEndRow(name="player to volume renderer, dB", value=to_renderer),
    ]


def markdown_lines(rows: list[EndToEndRow]) -> list[str]:
    """The rows as Markdown."""
    values = ["-" if row.value is None else format_number(row.value) for row in rows]
    cells = [("figure", "value", "beside it")]
    cells += [(row.name, value, row.reference) for row, value in zip(rows, values, strict=True)]
    name, value, beside = (max(map(len, column)) for column in zip(*cells, strict=True))
    lines = [f"| {a:<{name}} | {b:>{value}} | {c:<{beside}} |" for a, b, c in cells]
    return [lines[0], f"|{'-' * (name + 2)}|{'-' * (value + 1)}:|{'-' * (beside + 2)}|", *lines[1:]]


def format_number(value: float) -> str:
    """A number with as many digits as anybody reads."""
    digits = 0 if float(value).is_integer() or abs(value) >= 1000 else 2 if abs(value) >= 1 else 3
    return f"{value:,.{digits}f}"


if __name__ == "__main__":
    main()
