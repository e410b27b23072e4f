"""What a run leaves on disk beside its package: report.json and report.html."""

import shlex
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from apps.learning.learnt import Learnt
from apps.learning.run_folder import RunFolder
from apps.learning.snapshot import Snapshot
from apps.playing.follow import FollowingCamera
from apps.playing.novel import novel_motion
from apps.recording.recording import Recording
from apps.reporting.body_map import BodyMap
from apps.reporting.failure import failure_of
from apps.reporting.page import Pair, report_page
from apps.reporting.pictures import data_uri, eight_bit, moving_data_uri
from apps.reporting.report import (
    CoverageNote,
    FramesNote,
    HeldOutNote,
    MachineNote,
    PackageNote,
    Report,
    TrainingNote,
)
from apps.terminal.console import Console
from avatar.hold import on_white, spread, truth_on_white
from avatar.render import render
from avatar.sharpness import verdict_of
from capture.atomic_files import write_text
from capture.memory import peak_memory_mb
from export.build import ExportReport
from export.player import Player

SHOWN_PAIRS = 6
NOVEL_PX = 320
NOVEL_FPS = 16.0


@dataclass(frozen=True, kw_only=True)
class RunNote:
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
class Delivered:
    """What was written.

    Attributes:
        report: As in report.json.
        refused: Why there is no package, if there is none.
        failure: Why the result is no avatar of the person, if it is none.
    """

    report: Report
    refused: str | None
    failure: str | None


def deliver(
    learnt: Learnt,
    taken: Snapshot,
    recording: Recording,
    run: RunFolder,
    note: RunNote,
    console: Console,
) -> Delivered:
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
    refused, package = taken.refused, None
    if taken.exported is None:
        run.remove(run.package)  # a resumed run's older avatar would contradict
    else:
        for warning in taken.exported.warnings:
            console.warn(warning)
        package = _package_note(taken.exported, run)
    ready_at = None if taken.exported is None else taken.ready_at
    report = _report(learnt, recording, note, package, ready_at)
    failure = failure_of(report)
    write_text(run.report, report.to_json())
    with console.waiting("drawing the report"):
        page = report_page(
            report,
            name=recording.paths.video.name,
            body_map=BodyMap(recording.shaped, learnt.coverage).svg(),
            pairs=pairs(learnt),
            novel=None if package is None else novel(Player.load(run.package)),
            warnings=[*console.warnings, *([] if refused is None else [refused])],
            failure=failure,
            present=[path.name for path in (run.cameras, run.poses) if path.exists()],
            play=None if package is None else play_command(run.package, recording.paths.poses),
        )
    write_text(run.page, page)
    return Delivered(report=report, refused=refused, failure=failure)


def play_command(package: Path, poses: Path) -> str:
    """What plays a package in the poses that it was learnt from, to be pasted into a shell."""
    return shlex.join(["ia-play", str(package), "--poses", str(poses)])


def pairs(learnt: Learnt) -> list[Pair]:
    """Held-out frames beside what the avatar shows, for the page."""
    shown = []
    scores = {score.frame: score for score in learnt.scores}
    for held in spread(learnt.held, SHOWN_PAIRS):
        observation = held.observation
        if observation.frame.index not in scores:
            continue
        picture = render(
            learnt.trainer.avatar, observation.pose, observation.camera, cells=held.cells
        )
        shown.append(
            Pair(
                frame=observation.frame.index,
                psnr=scores[observation.frame.index].psnr,
                verdict=verdict_of([scores[observation.frame.index]]),
                truth=data_uri(eight_bit(truth_on_white(observation))),
                render=data_uri(eight_bit(on_white(picture))),
            )
        )
    return shown


def novel(player: Player) -> str:
    """The avatar in a motion of our own, drawn by the player, as a moving picture."""
    motion = novel_motion(fps=NOVEL_FPS)
    camera = FollowingCamera.of(player, motion, NOVEL_PX)
    poses = [motion[row] for row in range(len(motion))]
    return moving_data_uri([player.render(p, camera.at(p)) for p in poses], fps=NOVEL_FPS)


def _fitted_note(learnt: Learnt) -> HeldOutNote | None:
    """Scores in poses fitted to the frames, if there are any."""
    if not learnt.fitted:
        return None
    return replace(HeldOutNote.of(learnt.fitted, learnt.meter.size_px), poses="fitted")


def _package_note(exported: ExportReport, run: RunFolder) -> PackageNote:
    return PackageNote(
        path=run.package.name,
        bytes=exported.bytes,
        seconds=exported.seconds,
        psnr_to_renderer={"hq": None, "lite": None, **exported.psnr_to_renderer},
    )


def _report(
    learnt: Learnt,
    recording: Recording,
    note: RunNote,
    package: PackageNote | None,
    ready_at: float | None,
) -> Report:
    trainer = learnt.trainer
    held = HeldOutNote.of(learnt.scores, learnt.meter.size_px if learnt.scores else None)
    recipe = asdict(trainer.config) | {
        "camera": recording.cameras.source,
        "body": recording.shaped.body.family,
        "pose_model": recording.motion.model,
        "body_fit": recording.told_of_body(),
        **recording.told_of_masks(),
    }
    return Report(
        command=note.command,
        recipe=recipe,
        machine=MachineNote(
            device=trainer.avatar.field.table.device.type,
            backend=trainer.backend.name,
            threads=note.threads,
        ),
        frames=_frames_note(learnt),
        training=_training_note(learnt, note),
        held_out=held,
        held_out_refined=_fitted_note(learnt),
        curve=learnt.curve,
        stream=learnt.meter.note(ready_at=ready_at),
        package=package,
        coverage=CoverageNote.of(learnt.coverage),
        extended=learnt.extended,
        cameras=recording.solved,
    )


def _frames_note(learnt: Learnt) -> FramesNote:
    meter = learnt.meter
    return FramesNote(
        read=learnt.added + meter.held_out + meter.dropped_count + meter.passed_over,
        used=learnt.added,
        held_out=meter.held_out,
        dropped=tuple(meter.dropped),
        alike=meter.passed_over,
        not_replayed=learnt.added - sum(i >= 0 for i in learnt.trainer.replay.indices),
    )


def _training_note(learnt: Learnt, note: RunNote) -> TrainingNote:
    trainer = learnt.trainer
    return TrainingNote(
        wall_seconds=trainer.wall_seconds,
        cpu_seconds=trainer.cpu_seconds,
        cpu_waited_seconds=learnt.cpu.waited_s,
        startup_seconds=note.startup_seconds,
        steps=trainer.steps,
        rays=trainer.rays,
        rays_per_second=trainer.rays / max(trainer.wall_seconds, 1e-6),
        samples_per_ray=trainer.samples / max(trainer.rays, 1),
        peak_memory_mb=peak_memory_mb(),
    )
