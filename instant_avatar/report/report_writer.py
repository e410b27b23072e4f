"""Report of a run: report.json, report.html with its images, and the verdict on the console."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from avatar.evaluation.image_metrics import (
    MAX_MEASURABLE_BLUR,
    MIN_OVERLAP,
    ground_truth_on_white,
    overall_verdict,
)
from capture.atomic_files import atomic_file, write_text_atomically
from capture.input_error import quote_command
from capture.live_sources import camera_address
from capture.process_metrics import peak_memory_mb
from export.player import Player
from instant_avatar.animation.driving_motion import FollowingCamera, ResampledMotion, demo_motion
from instant_avatar.cli.command_line import DONE, INTERRUPTED, NO_AVATAR, CommandExit
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import option_words
from instant_avatar.report.page_rendering import data_uri, encode_webp, to_uint8, webp_data_uri
from instant_avatar.report.report_figures import CoverageMap
from instant_avatar.report.report_page import ComparisonPair, report_page
from instant_avatar.report.report_schema import (
    CoverageStats,
    FrameStats,
    HeldOutStats,
    MachineInfo,
    PackageStats,
    Report,
    TrainingStats,
    format_psnr,
)
from instant_avatar.run.final_scoring import TrainingResult
from instant_avatar.run.run_folder import RunFolder
from preprocess.body.body_pose import Motion
from preprocess.capture_session import Capture

MIN_STEPS_TO_JUDGE = 60
"""Training steps below which a failed avatar is undertrained: fog clears in about 50."""
CHECK_OPTIONS = ("poses", "person", "masks", "cameras", "body")
"""Arguments of ia-ingest that ia-check takes for the same capture."""


def diagnose_failure(report: Report) -> str | None:
    """Explain a failed avatar and suggest what to do; None if it has not failed."""
    if report.verdict != "failed":
        return None
    held = report.held_out_refined or report.held_out
    what = f"The result is no usable avatar: {_describe_scores(held)}."
    if report.training.steps < MIN_STEPS_TO_JUDGE:
        return (
            f"{what} Only {report.training.steps} steps were made: train longer (the same command "
            "with --resume and more --seconds)."
        )
    return (
        f"{what} The model did not converge to the person. Usual causes: masks that include "
        "background, or poses from another video. Compare video and avatar in report.html"
        + _check_advice(report.command)
    )


def _describe_scores(held: HeldOutStats) -> str:
    score = f"held-out PSNR is {format_psnr(held.psnr, held.verdict)}"
    if held.overlap is not None and held.overlap < MIN_OVERLAP:
        return (
            f"{score}, and the IoU of rendered alpha and masks is {held.overlap:.2f} (at least "
            f"{MIN_OVERLAP:.1f} expected)"
        )
    return f"{score}, below that of the video blurred by {MAX_MEASURABLE_BLUR:.0%} of body height"


def _check_advice(command: Mapping[str, Any]) -> str:
    """Return the ia-check command of the capture; a live camera leaves nothing to check."""
    video = str(command.get("video"))
    if camera_address(Path(video)) is not None:
        return "."
    named = {name: command.get(name) for name in CHECK_OPTIONS if command.get(name) != "solve"}
    words = quote_command("ia-check", video, *option_words(named))
    return f", and check poses and masks: {words}"


ANIMATION_PX = 480
"""Width and height of the animation on the page."""
ANIMATION_FPS = 16.0
"""Images per second of the animation on the page."""
ANIMATION_FRAMES = 96
"""Largest number of images of an animation."""


def write_report(
    result: TrainingResult,
    capture: Capture,
    run: RunFolder,
    console: Console,
    *,
    command: dict[str, Any],
    startup_seconds: float,
    threads: int,
) -> Report:
    """Write report.json, turning.webp and report.html; each appears whole or not at all.

    `result` is baked and scored; `command` holds the arguments of ia-ingest as given;
    `startup_seconds` last until the first frame.
    """
    package = _package_stats(result, run, console)
    report = _build_report(
        result, capture, package,
        command=command, startup_seconds=startup_seconds, threads=threads,
    )  # fmt: skip
    write_text_atomically(run.report_json, report.to_json())
    with console.status("drawing the report"):
        animation = None
        if package is not None:
            animation = demo_animation(Player.load(run.package))
            with atomic_file(run.animation) as part:
                part.write_bytes(animation)
        page = report_page(
            report,
            name=capture.paths.video.name,
            body_map=CoverageMap(capture.shaped, result.coverage).svg(),
            pairs=comparison_pairs(result),
            animation=None if animation is None else data_uri(animation),
            warnings=[*console.warnings, *filter(None, [_refusal(result)])],
            failure=diagnose_failure(report),
            present_files=[path.name for path in (run.cameras, run.poses) if path.exists()],
            play_command=None
            if package is None
            else play_command(run.package, capture.paths.poses),
        )
    write_text_atomically(run.report_html, page)
    return report


def print_results(
    report: Report, result: TrainingResult, run: RunFolder, console: Console, *, interrupted: bool
) -> int:
    """Print scores and files; return the exit code.

    Raises:
        CommandExit: If there is no package, or its avatar has failed.
    """
    held_out, fitted = report.held_out, report.held_out_refined
    score = "no frame was held out"
    if held_out.psnr is not None:
        score = f"held-out PSNR {format_psnr(held_out.psnr, held_out.verdict)}"
    if fitted is not None and fitted.psnr is not None:
        some = "" if len(fitted.frames) == len(held_out.frames) else f"{len(fitted.frames)} of "
        fitted_score = format_psnr(fitted.psnr, fitted.verdict)
        score += f", with poses fitted to {some}those frames {fitted_score}"
    training = report.training
    console.info(f"Trained for {training.wall_seconds:.1f} s ({training.steps} steps); {score}.")
    found = report.all_round
    if found.verdict is not None and found.verdict != "failed":
        console.info(
            f"From all sides the avatar is {found.verdict}."
            + (f" {found.advice}" if found.advice else "")
        )
    if report.package is not None:
        console.print_artifact("package", run.package)
    console.print_artifact("report", run.report_json)
    console.print_artifact("look at it", run.report_html)
    console.print_artifact("checkpoint", run.checkpoint)
    unusable = _refusal(result) or diagnose_failure(report)
    if unusable is not None:
        raise CommandExit(unusable, INTERRUPTED if interrupted else NO_AVATAR)
    return INTERRUPTED if interrupted else DONE


def _refusal(result: TrainingResult) -> str | None:
    """Return why no package was written; None if one was."""
    return None if result.package is None else result.package.refusal


def play_command(package: Path, poses: Path) -> str:
    """Return the command that plays a package in the poses it was learnt from, for a shell."""
    return quote_command("ia-play", package, "--poses", poses)


def comparison_pairs(result: TrainingResult) -> list[ComparisonPair]:
    """Held-out frames beside what the avatar shows, for the page."""
    shown = []
    scores = {score.frame: score for score in result.scores.given}
    for held in result.held_out:
        observation = held.observation
        index = observation.frame.index
        if index not in result.scores.renderings:
            continue
        shown.append(
            ComparisonPair(
                frame=index,
                psnr=scores[index].psnr,
                verdict=overall_verdict([scores[index]]),
                truth=webp_data_uri(to_uint8(ground_truth_on_white(observation))),
                render=webp_data_uri(result.scores.renderings[index]),
            )
        )
    return shown


def demo_animation(player: Player) -> bytes:
    """The avatar in a motion of our own, drawn by the player, as an animated WebP."""
    return motion_animation(player, demo_motion())


def motion_animation(player: Player, motion: Motion) -> bytes:
    """Draw the first seconds of a motion by the player, as an animated WebP."""
    camera = FollowingCamera.of(player, motion, ANIMATION_PX)
    frames = ResampledMotion.of(motion, fps=ANIMATION_FPS)
    poses = [frames.pose(frame) for frame in range(min(len(frames), ANIMATION_FRAMES))]
    return encode_webp([player.render(p, camera.camera_for(p)) for p in poses], fps=ANIMATION_FPS)


def _fitted_pose_stats(result: TrainingResult) -> HeldOutStats | None:
    """Scores in poses fitted to the frames, if there are any."""
    if not result.scores.fitted:
        return None
    return replace(HeldOutStats.of(result.scores.fitted, result.meter.size_px), poses="fitted")


def _package_stats(result: TrainingResult, run: RunFolder, console: Console) -> PackageStats | None:
    """Describe the package, or remove a resumed run's older one if none was written."""
    exported = None if result.package is None else result.package.export_report
    if exported is None:
        run.remove(run.package)
        run.remove(run.animation)
        return None
    for warning in exported.warnings:
        console.warning(warning)
    return PackageStats(
        path=run.package.name,
        bytes=exported.bytes,
        seconds=exported.seconds,
        psnr_to_renderer={"hq": None, "lite": None, **exported.psnr_to_renderer},
    )


def _build_report(
    result: TrainingResult,
    capture: Capture,
    package: PackageStats | None,
    *,
    command: dict[str, Any],
    startup_seconds: float,
    threads: int,
) -> Report:
    trainer, snapshot = result.trainer, result.package
    ready_at = None if package is None or snapshot is None else snapshot.ready_at
    scores = result.scores.given
    held_out = HeldOutStats.of(scores, result.meter.size_px if scores else None)
    recipe = asdict(trainer.config) | {
        "camera": capture.cameras.source,
        "body": capture.shaped.body.family,
        "pose_model": capture.motion.body_model,
        "body_fit": capture.body_fit_report(),
        "mask_fit": None if capture.fit is None else capture.fit.as_json(),
        **capture.mask_report(),
    }
    return Report(
        command=command,
        recipe=recipe,
        machine=MachineInfo(threads=threads),
        frames=_frame_stats(result),
        training=_training_stats(result, startup_seconds),
        held_out=held_out,
        held_out_refined=_fitted_pose_stats(result),
        curve=result.curve,
        stream=result.meter.stats(ready_at=ready_at),
        package=package,
        all_round=result.all_round_verdict(),
        coverage=CoverageStats.of(result.coverage),
        earlier_videos=result.earlier_videos,
        cameras=capture.camera_report,
        tracking=capture.tracking_report,
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


def _training_stats(result: TrainingResult, startup_seconds: float) -> TrainingStats:
    trainer = result.trainer
    return TrainingStats(
        wall_seconds=trainer.wall_seconds,
        cpu_seconds=trainer.cpu_seconds,
        step_cpu_seconds=trainer.step_cpu_seconds,
        cpu_contention_seconds=max(0.0, trainer.step_wall_seconds - trainer.step_cpu_seconds),
        startup_seconds=startup_seconds,
        steps=trainer.steps,
        rays=trainer.rays,
        rays_per_second=trainer.rays / max(trainer.wall_seconds, 1e-6),
        samples_per_ray=trainer.samples / max(trainer.rays, 1),
        peak_memory_mb=peak_memory_mb(),
    )
