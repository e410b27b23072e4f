"""Pictures inside a page: encoded as WebP, in the address itself.

What a user should know of a result that is no avatar: what it is, and what to look at.

What a run leaves on disk beside its package: report.json and report.html.
"""

import base64
import io
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from apps.animation.driving_motion import demo_motion
from apps.animation.following_camera import FollowingCamera
from apps.cli.console import Console
from apps.report.coverage_map import CoverageMap
from apps.report.report_page import ComparisonPair, report_page
from apps.report.report_schema import (
    CoverageStats,
    FrameStats,
    HeldOutStats,
    MachineInfo,
    PackageStats,
    Report,
    TrainingStats,
    format_psnr,
)
from apps.run.package_snapshot import PackageSnapshot
from apps.run.run_folder import RunFolder
from apps.run.training_result import TrainingResult
from avatar.evaluation.held_out import subsample_evenly
from avatar.evaluation.image_metrics import composite_on_white, ground_truth_on_white
from avatar.evaluation.sharpness import MAX_MEASURABLE_BLUR, MIN_OVERLAP, overall_verdict
from avatar.render import render
from capture.atomic_files import write_text_atomically
from capture.live.camera_device import camera_address
from capture.process_metrics import peak_memory_mb
from export.build import ExportReport
from export.player import Player
from preprocess.capture_session import Capture


def to_uint8(
    picture: Float[np.ndarray, "height width channels"],
) -> UInt8[np.ndarray, "height width channels"]:
    """A picture in [0, 1] as bytes."""
    return (np.clip(picture, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def webp_data_uri(picture: UInt8[np.ndarray, "height width channels"]) -> str:
    """One RGB or RGBA picture."""
    return _encode_webp([picture], frame_ms=0)


def animated_webp_data_uri(
    pictures: Sequence[UInt8[np.ndarray, "height width channels"]], *, fps: float
) -> str:
    """Pictures that follow each other again and again; transparency stays."""
    return _encode_webp(pictures, frame_ms=max(1, round(1000.0 / fps)))


def _encode_webp(pictures: Sequence[UInt8[np.ndarray, "..."]], *, frame_ms: int) -> str:
    first, *others = [Image.fromarray(picture) for picture in pictures]
    buffer = io.BytesIO()
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    first.save(buffer, format="WEBP", quality=82, method=3, **(moving if others else {}))
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


MIN_STEPS_TO_JUDGE = 60
"""Below this many steps the avatar may simply not have had the time: fog clears in about 50."""
CHECK_OPTIONS = ("poses", "person", "masks", "cameras", "body")
"""Arguments of ia-ingest that ia-check needs to look at the same capture."""


def diagnose_failure(report: Report) -> str | None:
    """Why the result is no avatar of the person, and what to do; None if it is one."""
    if report.verdict != "failed":
        return None
    held = report.held_out_refined or report.held_out
    what = f"The result is no usable avatar: {_describe_scores(held)}."
    if report.training.steps < MIN_STEPS_TO_JUDGE:
        return (
            f"{what} Only {report.training.steps} steps were made: learn longer (the same command "
            "with --resume and more --seconds)."
        )
    return (
        f"{what} It has learnt something other than the person; masks that show too much, or poses "
        "of another video, are the usual causes. Compare video and avatar in report.html"
        + _check_advice(report.command)
    )


def _describe_scores(held: HeldOutStats) -> str:
    said = f"frames that it was not trained on are drawn at {format_psnr(held.psnr, held.verdict)}"
    if held.overlap is not None and held.overlap < MIN_OVERLAP:
        return (
            f"{said}, and the body that is drawn agrees with the masks by only {held.overlap:.2f} "
            f"(0 to 1; at least {MIN_OVERLAP:.1f} was expected)"
        )
    return (
        f"{said}, worse than the video itself blurred by {MAX_MEASURABLE_BLUR:.0%} of the person's height, in "
        "which no person can be made out"
    )


def _check_advice(command: Mapping[str, Any]) -> str:
    """The command that looks at poses and masks; of a live camera nothing is left to look at."""
    video = str(command.get("video"))
    if camera_address(Path(video)) is not None:
        return "."
    words = ["ia-check", video]
    for name in CHECK_OPTIONS:
        if command.get(name) not in (None, "solve"):
            words += [f"--{name}", str(command[name])]
    return f", and let poses and masks be checked: {shlex.join(words)}"


MAX_PAIRS = 6
ANIMATION_PX = 320
ANIMATION_FPS = 16.0


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """What only the command knows.

    Attributes:
        command: The arguments, as given.
        startup_seconds: From the start of the command to the first frame.
        threads: Of torch and numba.
    """

    command: dict[str, Any]
    startup_seconds: float
    threads: int


@dataclass(frozen=True, kw_only=True)
class RunOutcome:
    """What was written.

    Attributes:
        report: As in report.json.
        refused: Why there is no package, if there is none.
        failure: Why the result is no avatar of the person, if it is none.
    """

    report: Report
    refusal: str | None
    failure: str | None


def write_report(
    result: TrainingResult,
    snapshot: PackageSnapshot,
    recording: Capture,
    run: RunFolder,
    info: RunInfo,
    console: Console,
) -> RunOutcome:
    """Writes the report, then the page; each whole or not at all.

    Args:
        learnt: With its scores.
        taken: The package of the same avatar.
        recording: What it was learnt from.
        run: Where it goes.
        note: What only the command knows.
        console: Where warnings are collected and progress is shown.

    Raises:
        OSError: If the disk is full; what was written before stays.
    """
    refused, package = snapshot.refusal, None
    if snapshot.export_report is None:
        run.remove(run.package)  # a resumed run's older avatar would contradict
    else:
        for warning in snapshot.export_report.warnings:
            console.warning(warning)
        package = _package_stats(snapshot.export_report, run)
    ready_at = None if snapshot.export_report is None else snapshot.ready_at
    report = _build_report(result, recording, info, package, ready_at)
    failure = diagnose_failure(report)
    write_text_atomically(run.report_json, report.to_json())
    with console.status("drawing the report"):
        page = report_page(
            report,
            name=recording.paths.video.name,
            body_map=CoverageMap(recording.shaped, result.coverage).svg(),
            pairs=comparison_pairs(result),
            animation=None if package is None else demo_animation(Player.load(run.package)),
            warnings=[*console.warnings, *([] if refused is None else [refused])],
            failure=failure,
            present_files=[path.name for path in (run.cameras, run.poses) if path.exists()],
            play_command=None
            if package is None
            else play_command(run.package, recording.paths.poses),
        )
    write_text_atomically(run.report_html, page)
    return RunOutcome(report=report, refusal=refused, failure=failure)


def play_command(package: Path, poses: Path) -> str:
    """What plays a package in the poses that it was learnt from, to be pasted into a shell."""
    return shlex.join(["ia-play", str(package), "--poses", str(poses)])


def comparison_pairs(result: TrainingResult) -> list[ComparisonPair]:
    """Held-out frames beside what the avatar shows, for the page."""
    shown = []
    scores = {score.frame: score for score in result.scores}
    for held in subsample_evenly(result.held_out, MAX_PAIRS):
        observation = held.observation
        if observation.frame.index not in scores:
            continue
        picture = render(
            result.trainer.avatar, observation.pose, observation.camera, cells=held.correspondences
        )
        shown.append(
            ComparisonPair(
                frame=observation.frame.index,
                psnr=scores[observation.frame.index].psnr,
                verdict=overall_verdict([scores[observation.frame.index]]),
                truth=webp_data_uri(to_uint8(ground_truth_on_white(observation))),
                render=webp_data_uri(to_uint8(composite_on_white(picture))),
            )
        )
    return shown


def demo_animation(player: Player) -> str:
    """The avatar in a motion of our own, drawn by the player, as a moving picture."""
    motion = demo_motion(fps=ANIMATION_FPS)
    camera = FollowingCamera.of(player, motion, ANIMATION_PX)
    poses = [motion[row] for row in range(len(motion))]
    return animated_webp_data_uri(
        [player.render(p, camera.camera_for(p)) for p in poses], fps=ANIMATION_FPS
    )


def _fitted_pose_stats(result: TrainingResult) -> HeldOutStats | None:
    """Scores in poses fitted to the frames, if there are any."""
    if not result.fitted_pose_scores:
        return None
    return replace(HeldOutStats.of(result.fitted_pose_scores, result.meter.size_px), poses="fitted")


def _package_stats(exported: ExportReport, run: RunFolder) -> PackageStats:
    return PackageStats(
        path=run.package.name,
        bytes=exported.bytes,
        seconds=exported.seconds,
        psnr_to_renderer={"hq": None, "lite": None, **exported.psnr_to_renderer},
    )


def _build_report(
    result: TrainingResult,
    recording: Capture,
    info: RunInfo,
    package: PackageStats | None,
    ready_at: float | None,
) -> Report:
    trainer = result.trainer
    held = HeldOutStats.of(result.scores, result.meter.size_px if result.scores else None)
    recipe = asdict(trainer.config) | {
        "camera": recording.cameras.source,
        "body": recording.shaped.body.family,
        "pose_model": recording.motion.body_model,
        "body_fit": recording.body_fit_report(),
        **recording.mask_report(),
    }
    return Report(
        command=info.command,
        recipe=recipe,
        machine=MachineInfo(
            device=trainer.avatar.field.table.device.type,
            backend=trainer.backend.name,
            threads=info.threads,
        ),
        frames=_frame_stats(result),
        training=_training_stats(result, info),
        held_out=held,
        held_out_refined=_fitted_pose_stats(result),
        curve=result.curve,
        stream=result.meter.stats(ready_at=ready_at),
        package=package,
        coverage=CoverageStats.of(result.coverage),
        earlier_videos=result.earlier_videos,
        cameras=recording.camera_report,
    )


def _frame_stats(result: TrainingResult) -> FrameStats:
    meter = result.meter
    return FrameStats(
        read=result.frames_added
        + meter.held_out_count
        + meter.dropped_count
        + meter.near_duplicates,
        used=result.frames_added,
        held_out=meter.held_out_count,
        dropped=tuple(meter.dropped),
        near_duplicates=meter.near_duplicates,
        not_replayed=result.frames_added - sum(i >= 0 for i in result.trainer.replay.frame_indices),
    )


def _training_stats(result: TrainingResult, info: RunInfo) -> TrainingStats:
    trainer = result.trainer
    return TrainingStats(
        wall_seconds=trainer.wall_seconds,
        cpu_seconds=trainer.cpu_seconds,
        cpu_contention_seconds=result.cpu_time.waited_s,
        startup_seconds=info.startup_seconds,
        steps=trainer.steps,
        rays=trainer.rays,
        rays_per_second=trainer.rays / max(trainer.wall_seconds, 1e-6),
        samples_per_ray=trainer.samples / max(trainer.rays, 1),
        peak_memory_mb=peak_memory_mb(),
    )
