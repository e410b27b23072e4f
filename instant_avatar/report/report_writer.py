"""Report of a run: report.json, report.html with its images, and the verdict on the console."""

import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, final

import numba

from avatar.evaluation.all_round_verdict import TRAIN_LONGER
from avatar.evaluation.image_metrics import (
    MAX_MEASURABLE_BLUR,
    MIN_OVERLAP,
    ground_truth_on_white,
    overall_verdict,
)
from capture.atomic_files import atomic_file, write_text_atomically
from capture.hardware import peak_memory_mb
from capture.input_error import counted, quote_command
from capture.live_sources import camera_address
from export.build import GOOD_PSNR
from export.player import Player
from instant_avatar.animation.driving_motion import FollowingCamera, ResampledMotion, demo_motion
from instant_avatar.cli.command_line import DONE, INTERRUPTED, NO_AVATAR, CommandExit
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import capture_name, option_words
from instant_avatar.report.page_rendering import data_uri, encode_webp, to_uint8, webp_data_uri
from instant_avatar.report.report_page import ComparisonPair, CoverageMap, report_page
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
from instant_avatar.run.session_events import Ended, PackageWritten, SessionEvent
from preprocess.capture_session import Capture


def diagnose_failure(report: Report) -> str | None:
    """Explain a failed avatar and suggest what to do; None if it has not failed."""
    if report.verdict != "failed":
        return None
    held = report.held_out_refined or report.held_out
    what = f"The result is no usable avatar: {_describe_scores(held)}."
    # fog clears in about 50
    if report.training.steps < 60:
        return f"{what} Only {counted(report.training.steps, 'step')} of training: {TRAIN_LONGER}."
    return (
        f"{what} The model did not converge to the person. Usual causes: masks that include "
        "background, or poses from another video. Compare video and avatar in report.html"
        + _check_advice(report.command)
    )


def describe_verdict(report: Report, refusal: str | None, *, is_final: bool) -> str:
    """Return the verdict on an avatar as a sentence, and what would make it better."""
    if (failure := refusal or diagnose_failure(report)) is not None:
        return failure
    if report.verdict is None and report.held_out.psnr is not None:
        return "The avatar is there. It was not judged from all sides."
    if report.verdict is None:
        scored = [point for point in report.curve if point.psnr is not None]
        estimate = f", at about {format_psnr(scored[-1].psnr, None, digits=0)}" if scored else ""
        ending = "It was not scored." if is_final else "Its scores are being made."
        return f"The avatar is there{estimate}. {ending}"
    if report.all_round.advice is None:
        return f"The avatar is {report.verdict} from all sides."
    return f"The avatar is {report.verdict}. {report.all_round.advice}"


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
    shared = ("poses", "person", "masks", "cameras", "body")  # with ia-ingest
    named = {name: command.get(name) for name in shared if command.get(name) != "solve"}
    words = quote_command("ia-check", video, *option_words(named))
    return f", and check poses and masks: {words}"


ANIMATION_PX = 480
"""Width and height of the animation on the page."""
ANIMATION_FPS = 16.0
"""Images per second of the animation on the page."""
ANIMATION_FRAMES = 96
"""Largest number of images of an animation."""


@final
class ReportWriter:
    """A reader of a session: writes the report once there is a package, and whole at the end.

    Attributes:
        report: The report as it was last written; None before.
    """

    def __init__(
        self,
        capture: Capture,
        run: RunFolder,
        console: Console,
        *,
        command: dict[str, Any],
        started_at: float,
        threads: int,
        copy: tuple[Path, bool] | None = None,
    ) -> None:
        """Write nothing yet.

        `command` holds the arguments of ia-ingest as given, which was `started_at` on
        `time.perf_counter`'s clock; `copy` is another path for report.json, and whether a file
        there may be replaced.
        """
        self._capture, self._run, self._console, self._copy = capture, run, console, copy
        self._command, self._started_at, self._threads = command, started_at, threads
        self._animation: bytes | None = None
        self._drawn_psnr = -math.inf
        self._result: TrainingResult | None = None
        self.report: Report | None = None

    def __call__(self, event: SessionEvent) -> None:
        """Write report.json, turning.webp and report.html; each appears whole or not at all."""
        match event:
            case PackageWritten(result=result, is_final=is_final):
                if not is_final:
                    self._console.print_artifact("package", self._run.package)
                    self._console.print_artifact("play it", self._play_command())
                with self._console.status("drawing the report"):
                    assert result.exported is not None
                    psnr = min(result.exported.psnr_to_renderer["hq"], GOOD_PSNR)
                    if psnr - self._drawn_psnr > 1.0:
                        self._animation = demo_animation(Player.load(self._run.package))
                        self._drawn_psnr = psnr
                        with atomic_file(self._run.animation) as part:
                            part.write_bytes(self._animation)
                    if not is_final:
                        self._write(result, is_final=False)
                if not is_final:
                    self._console.print_artifact("look at it", self._run.report_html)
                    self._console.info("Finer detail and scores follow; Ctrl-C leaves them out.")
            case Ended(result=result):
                self._write(result, is_final=True)
                self._print(result)

    def exit_code(self) -> int:
        """Return the exit code of a session that has ended; raise that of a failed avatar."""
        assert self._result is not None
        assert self.report is not None
        is_interrupted = self._result.interrupted
        unusable = self._result.refusal or diagnose_failure(self.report)
        if unusable is not None:
            raise CommandExit(unusable, INTERRUPTED if is_interrupted else NO_AVATAR)
        return INTERRUPTED if is_interrupted else DONE

    def _write(self, result: TrainingResult, *, is_final: bool) -> None:
        self._result = result
        package = _package_stats(result, self._run)
        started_at = self._started_at
        self.report = report = _build_report(
            result, self._capture, package, command=self._command, threads=self._threads,
            startup_seconds=(result.meter.first_frame_at or started_at) - started_at,
        )  # fmt: skip
        write_text_atomically(self._run.report_json, report.to_json())
        if self._copy is not None and is_final:
            path, may_replace = self._copy
            write_text_atomically(path, report.to_json(), replace=may_replace)
        page = report_page(
            report,
            name=capture_name(self._capture.paths.video),
            verdict=describe_verdict(report, result.refusal, is_final=is_final),
            body_map=CoverageMap(self._capture.shaped, result.coverage).svg(),
            pairs=comparison_pairs(result),
            animation=None if self._animation is None else data_uri(self._animation),
            warnings=self._console.warnings,
            notes=self._console.notes,
            present_files=[p.name for p in (self._run.cameras, self._run.poses) if p.exists()],
            next_steps={} if package is None else self._next_steps(),
        )
        write_text_atomically(self._run.report_html, page)

    def _play_command(self) -> str:
        """Return the command that plays the package, in the poses of the video if they are kept."""
        poses = self._capture.paths.poses
        options = ("--poses", poses) if poses.is_file() else ()
        return quote_command("ia-play", self._run.package, *options)

    def _next_steps(self) -> dict[str, str]:
        package, mesh = self._run.package, self._run.path / "avatar.glb"
        return {
            "Play it as a video": self._play_command(),
            "Turn it in your browser": quote_command("ia-play", package, "--web"),
            "Take it into Blender, Unity or a page of your own": quote_command(
                "ia-export", package, "--to", "glb", "--out", mesh
            ),
        }

    def _print(self, result: TrainingResult) -> None:
        report, run, console = self.report, self._run, self._console
        assert report is not None
        held_out, fitted = report.held_out, report.held_out_refined
        score = "no frame was scored"
        if held_out.psnr is not None:
            score = f"held-out PSNR {format_psnr(held_out.psnr, held_out.verdict)}"
        if fitted is not None and fitted.psnr is not None:
            some = "" if len(fitted.frames) == len(held_out.frames) else f"{len(fitted.frames)} of "
            fitted_score = format_psnr(fitted.psnr, fitted.verdict)
            score += f", with poses fitted to {some}those frames {fitted_score}"
        training = report.training
        console.info(report.frames.sentence())
        console.info(
            f"Trained for {training.wall_seconds:.1f} s ({counted(training.steps, 'step')}); "
            f"{score}."
        )
        if result.refusal is None and diagnose_failure(report) is None:
            console.info(describe_verdict(report, None, is_final=True))
        if report.package is not None:
            console.print_artifact("package", run.package)
            console.print_artifact("play it", self._play_command())
        console.print_artifact("look at it", run.report_html)
        console.print_artifact("report", run.report_json)
        console.print_artifact("checkpoint", run.checkpoint)


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
    """Draw the avatar in a motion of our own by the player, as an animated WebP."""
    motion = demo_motion()
    camera = FollowingCamera.of(player, motion, ANIMATION_PX)
    frames = ResampledMotion.of(motion, fps=ANIMATION_FPS)
    poses = (frames.pose(frame) for frame in range(min(len(frames), ANIMATION_FRAMES)))
    shots = ((pose, camera.camera_for(pose)) for pose in poses)
    drawn = player.render_all(shots, workers=numba.get_num_threads())
    return encode_webp(list(drawn), fps=ANIMATION_FPS)


def _fitted_pose_stats(result: TrainingResult) -> HeldOutStats | None:
    if not result.scores.fitted:
        return None
    return replace(HeldOutStats.of(result.scores.fitted, result.meter.size_px), poses="fitted")


def _package_stats(result: TrainingResult, run: RunFolder) -> PackageStats | None:
    """Describe the package, or remove a resumed run's older one if none was written."""
    exported = result.exported
    if exported is None:
        run.remove(run.package)
        run.remove(run.animation)
        return None
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
    trainer = result.trainer
    scores = result.scores.given
    held_out = HeldOutStats.of(scores, result.meter.size_px if scores else None)
    recipe = asdict(trainer.config) | {
        "camera": capture.cameras.source,
        "body": capture.shaped.body.family,
        "pose_model": capture.motion.body_model,
        "body_fit": capture.figures("body"),
        "mask_fit": capture.figures("fit"),
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
        stream=result.meter.stats(ready_at=result.ready_at),
        package=package,
        all_round=result.all_round_verdict(),
        coverage=CoverageStats.of(result.coverage),
        earlier_videos=result.earlier_videos,
        cameras=capture.figures("cameras"),
        tracking=capture.figures("tracking"),
        licence=result.licence,
    )


def _frame_stats(result: TrainingResult) -> FrameStats:
    meter, used = result.meter, result.frames_added
    return FrameStats(
        read=used + meter.held_out_count + meter.dropped_count + meter.near_duplicates,
        used=used,
        held_out=meter.held_out_count,
        dropped=tuple(meter.dropped),
        near_duplicates=meter.near_duplicates,
        not_replayed=used - sum(i >= 0 for i in result.trainer.replay.frame_indices),
    )


def _training_stats(result: TrainingResult, startup_seconds: float) -> TrainingStats:
    trainer = result.trainer
    return TrainingStats(
        wall_seconds=trainer.wall_seconds,
        cpu_seconds=trainer.cpu_seconds,
        step_cpu_seconds=trainer.step_cpu_seconds,
        startup_seconds=startup_seconds,
        steps=trainer.steps,
        rays=trainer.rays,
        rays_per_second=trainer.rays / max(trainer.wall_seconds, 1e-6),
        samples_per_ray=trainer.samples / max(trainer.rays, 1),
        peak_memory_mb=peak_memory_mb(),
    )
