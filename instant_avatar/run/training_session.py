"""A training session: frames in, steps, checkpoints, package, scores."""

import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, Protocol, final, runtime_checkable

from avatar.evaluation.coverage import Coverage, coverage_advice
from avatar.evaluation.held_out import PIXELS_PER_FRAME, HeldOutFrame, add_held_out
from avatar.evaluation.image_metrics import overall_verdict
from avatar.events import Evaluated, FrameArrived, HeldOutScore, Stepped, TrainEvent, Warned
from avatar.training.frame_stream import (
    SplitItem,
    StreamItem,
    TrainingFrame,
    prepare_items,
    separate_held_out,
)
from avatar.training.train import train
from avatar.training.trainer import Trainer
from capture.inbox import Inbox
from capture.source import RealtimePlayback
from export.bake.fine_tuning import PosedView
from instant_avatar.cli.command_line import BAD_INPUT, INTERRUPTED, CommandExit
from instant_avatar.cli.console import Console, ProgressBar
from instant_avatar.report.report_schema import CurvePoint, finite_mean, format_percent, format_psnr
from instant_avatar.run.final_scoring import (
    EarlierVideos,
    TrainingResult,
    earlier_video_names,
    score_finally,
)
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.snapshot_writer import (
    CheckpointWriter,
    PackageSnapshot,
    prefer_final,
    store_scores,
    validation_views,
    write_package_snapshot,
)
from instant_avatar.run.stream_meter import StreamMeter
from preprocess.body.body_pose import BodyPose
from preprocess.capture_session import Capture
from preprocess.observation import Observation

REVISED_PER_STEP = 2
"""Frames whose poses are replaced between two steps; each solves its correspondences again."""


@runtime_checkable
class TrainingObserver(Protocol):
    """Observer of a training session, such as the live viewer."""

    def on_frame(self, observation: Observation, *, held_out: bool) -> None:
        """A frame in which the person was found, before the trainer has it.

        Called on the reader's thread: it must be quick, and may run no parallel kernel.
        """

    def on_event(self, event: TrainEvent) -> None:
        """Something happened; called on the thread that trains."""

    def between_steps(self, session: "TrainingSession") -> None:
        """Between two steps, on the thread that trains: kernels may run here.

        What it takes counts as training time, except inside `Trainer.paused`.
        """


def notify_observers(
    items: Iterator[SplitItem], coverage: Coverage, observers: Sequence[TrainingObserver]
) -> Iterator[SplitItem]:
    """Pass items on; observers see all observations, coverage those that are not held out."""
    for item in items:
        if isinstance(item, Observation):
            coverage.add(item)
            for observer in observers:
                observer.on_frame(item, held_out=False)
        elif isinstance(item, HeldOutFrame):
            for observer in observers:
                observer.on_frame(item.observation, held_out=True)
        yield item


@final
class TrainingSession:
    """Training of one avatar on one capture; it ends as soon as `stop` is set."""

    def __init__(
        self,
        trainer: Trainer,
        recording: Capture,
        run: RunFolder,
        console: Console,
        stop: threading.Event,
        notes: dict[str, Any],
        *,
        observers: Sequence[TrainingObserver] = (),
        restore_count: int = 0,
    ) -> None:
        """Prepare the session; `train` starts it.

        `trainer` is new, or from a checkpoint. `notes` are stored with each checkpoint. The trainer
        was trained on `restore_count` frames of this video before; they are read back into its
        replay buffer before the clock starts.
        """
        self.trainer, self._recording, self._run = trainer, recording, run
        self._console, self.stop, self._notes = console, stop, notes
        self._observers, self._restore_count = observers, restore_count
        self.curve: list[CurvePoint] = [
            CurvePoint.from_checkpoint(kept) for kept in notes.get("curve", [])
        ]
        self.held_out: list[HeldOutFrame] = []
        self._revised_poses: dict[int, BodyPose] = {}
        self._checkpoints = CheckpointWriter(run, recording)
        self.meter = StreamMeter(stop, recording.source)
        self.coverage = Coverage(recording.shaped)
        if "coverage" in notes:
            self.coverage.merge_state(notes["coverage"])

    @property
    def stop_requested(self) -> bool:
        """True if the user has asked to stop."""
        return self.stop.is_set()

    def train(self) -> TrainingResult:
        """Train until the budget is used or the user stops; `bake` packages and scores."""
        source = self._recording.source
        self._set_unpaced(self._restore_count > 0)
        grows = source.frame_count is None and not source.live
        self._inbox = inbox = Inbox(
            self._frame_stream(), paced=source.paced, live=source.live, ends_run=grows
        )
        try:
            added = self._restore_frames(inbox, self._restore_count) - self.trainer.frames_seen
            self._set_unpaced(False)
            self._checkpoints.restart_interval()
            with self._console.progress("training", self.trainer.config.seconds) as bar:
                for event in train(self.trainer, inbox, self.held_out):
                    self._handle_event(event, bar)
                    for observer in self._observers:
                        observer.on_event(event)
                        observer.between_steps(self)
                    self._revise_poses()
                    if self.stop.is_set():
                        break
        finally:
            source.close()
            inbox.close()
            self._checkpoints.settle()
        self.meter.inbox_dropped, interrupted = inbox.dropped, self.stop.is_set()
        late = self.meter.lateness_warnings()
        for warning in [*source.warnings, *late, *self._recording.final_notes()]:
            self._console.warning(warning)
        self._console.summarize_warnings()
        if len(self.trainer.replay):
            seen = format_percent(self.coverage.seen_share)
            self._console.info(f"Body coverage: {seen}. {coverage_advice(self.coverage)}")
        return TrainingResult(
            trainer=self.trainer,
            held_out=self.held_out,
            curve=tuple(self.curve),
            meter=self.meter,
            coverage=self.coverage,
            frames_added=added + self.trainer.frames_seen,
            interrupted=interrupted,
        )

    def bake(self, result: TrainingResult) -> TrainingResult:
        """Write the package, then score the held-out frames.

        A paced source has a user waiting at its end, so a quick package comes first and a final
        one with finer detail replaces it after scoring.

        Raises:
            CommandExit: If the avatar was not trained.
        """
        self._check_trained(result)
        views = validation_views(self.held_out, self._recording)
        quick = self._recording.source.paced
        self.trainer.replay.clear_correspondences()  # nothing is learnt from here on
        self._begin_checkpoint(trains_on=False)  # baking changes nothing of it
        try:
            package = self._write_package("writing the package", views, quick=quick)
        finally:
            self._checkpoints.settle()
        self._checkpoints.wait()
        result = self._with_scores(result)
        if quick:
            final = self._write_package("writing the final package, with finer detail", views)
            package = prefer_final(package, final)
        result = replace(result, package=package)
        if result.scores.given and self.curve:
            scores = result.scores.summarize(self.curve[-1], result.all_round_verdict().verdict)
            result = replace(result, package=store_scores(package, scores))
        return result

    def _check_trained(self, result: TrainingResult) -> None:
        if result.is_trained:
            return
        if result.interrupted:
            raise CommandExit("stopped before the first step; no avatar was written.", INTERRUPTED)
        reasons = Counter(drop.reason for drop in self.meter.dropped)
        why = ", ".join(f"{count} x {reason}" for reason, count in reasons.most_common(3))
        raise CommandExit(
            f"no frame of {self._recording.source.path} could be used ({why or 'it has none'}); at "
            "least two usable frames are needed. No avatar was written.",
            BAD_INPUT,
        )

    def _write_package(
        self, label: str, views: Sequence[PosedView], *, quick: bool = False
    ) -> PackageSnapshot:
        with self._console.progress(label, 1.0) as bar:
            return write_package_snapshot(
                self.trainer,
                self._run.package,
                views,
                curve_point=self.curve[-1] if self.curve else None,
                quick=quick,
                progress=bar.set_share,
            )

    def _with_scores(self, result: TrainingResult) -> TrainingResult:
        """Score held-out frames, in the given poses and in poses fitted to them."""
        fits = self.trainer.config.refine_poses and not result.interrupted
        scores = score_finally(self.trainer, self.held_out, self._console, fit_poses=fits)
        last = self.curve[-1].wall_seconds if self.curve else -1.0
        if scores.sampled and self.trainer.wall_seconds > last:
            wall_s, cpu_s = self.trainer.wall_seconds, self.trainer.cpu_seconds
            self._add_curve_point(scores.sampled, wall_s, cpu_s)
        self._begin_checkpoint(trains_on=False)
        self._checkpoints.wait()
        extended = EarlierVideos(self._run, self._notes).measure_forgetting(
            self.trainer, self.held_out, self._console
        )
        return replace(result, scores=scores, curve=tuple(self.curve), earlier_videos=extended)

    def _set_unpaced(self, unpaced: bool) -> None:
        """Deliver frames without delay while a resumed run reads back what it has seen."""
        if isinstance(self._recording.source, RealtimePlayback):
            self._recording.source.catch_up = unpaced

    def _frame_stream(self) -> Iterator[StreamItem]:
        """Prepare frames; runs on the inbox's thread."""
        frames = self.meter.measure_arrival(self._recording.source.frames())
        found = self.meter.count_observations(map(self._recording.observation_builder(), frames))
        rig, every = self.trainer.avatar.rig, self.trainer.config.held_out_stride
        total = self._recording.source.frame_count
        items = separate_held_out(found, stride=every, total=total)
        items = notify_observers(items, self.coverage, self._observers)
        return self.meter.measure_preparation(prepare_items(items, rig))

    def _restore_frames(self, inbox: Inbox[StreamItem], count: int) -> int:
        """Read frames back into the replay buffer; return how many."""
        seen = 0
        if not count:
            return seen
        with self._console.status(f"reading back {count} frames"):
            while seen < count and not (inbox.finished or self.stop.is_set()):
                for item in inbox.take(timeout_s=0.1):
                    if isinstance(item, HeldOutFrame):
                        add_held_out(self.held_out, item)
                        self.meter.mark_arrived(item.observation.frame.index, held_out=True)
                    elif isinstance(item, TrainingFrame):
                        self.trainer.add_frame(item, is_restored=True)
                        seen += 1
        return seen

    def _revise_poses(self) -> None:
        """Bring along the poses of earlier frames that a stream's later frames have improved."""
        found = self._recording.take_revised_poses()
        for place, frame in enumerate(self.held_out):
            pose = found.get(frame.observation.frame.index)
            if pose is not None:
                self.held_out[place] = replace(
                    frame, observation=replace(frame.observation, pose=pose)
                )
        self._revised_poses |= found
        for _ in range(min(REVISED_PER_STEP, len(self._revised_poses))):
            number = next(iter(self._revised_poses))
            self.trainer.revise_pose(number, self._revised_poses.pop(number))

    def _handle_event(self, event: TrainEvent, progress: ProgressBar) -> None:
        match event:
            case FrameArrived(index=index, held_out=held_out):
                self.meter.mark_arrived(index, held_out=held_out)
                progress.update(self.trainer.scheduled_seconds, self._progress_text())
            case Stepped():
                self.meter.inbox_depth.add(float(self._inbox.pending))
                progress.update(self.trainer.scheduled_seconds, self._progress_text())
                if self._checkpoints.is_due():
                    self._begin_checkpoint(trains_on=True)
            case Evaluated():
                point = self._add_curve_point(event.scores, event.wall_seconds, event.cpu_seconds)
                if point.psnr is not None:
                    score = format_psnr(point.psnr, point.verdict, provisional=True)
                    self._console.info(f"{event.wall_seconds:6.1f} s   {score}")
            case Warned(message=message):
                self._console.warning(message)

    def _progress_text(self) -> str:
        trainer, last = self.trainer, self.curve[-1] if self.curve else None
        rays = trainer.rays / max(trainer.wall_seconds, 1e-6)
        elapsed_s, budget_s = trainer.wall_seconds, trainer.config.seconds
        if trainer.config.steps:
            position = f"step {trainer.steps} of {trainer.config.steps}, {elapsed_s:.0f} s"
        elif elapsed_s <= budget_s or self._inbox.finished:
            position = f"{elapsed_s:.0f} of {budget_s:g} s, step {trainer.steps}"
        else:
            position = f"{elapsed_s:.0f} s: the first pass over the video goes on"
        parts = [position]  # terminals cut off the end of a long line
        if last is not None and last.psnr is not None:
            score = format_psnr(last.psnr, last.verdict, digits=1, provisional=True)
            parts.append(f"held-out PSNR {score}")
        parts += [
            f"{format_percent(self.coverage.seen_share)} seen",
            f"{trainer.frames_seen} frames",
            f"{rays / 1000.0:.0f}k rays/s",
            f"{trainer.samples / max(trainer.rays, 1):.1f} samples/ray",
            f"{self._inbox.pending} waiting",
        ]
        if self._recording.source.paced:
            parts.append(f"{1000.0 * self.meter.current_latency_s:.0f} ms behind")
        return " · ".join(parts)

    def _add_curve_point(
        self, scores: tuple[HeldOutScore, ...], wall_s: float, cpu_s: float
    ) -> CurvePoint:
        point = CurvePoint(
            wall_seconds=wall_s,
            cpu_seconds=cpu_s,
            frames_seen=self.trainer.frames_seen,
            psnr=finite_mean([s.psnr for s in scores]),
            psnr_mask=finite_mean([s.psnr_mask for s in scores]),
            verdict=overall_verdict(scores),
            frames=tuple((s.frame, s.psnr) for s in scores),
            video=1 + len(earlier_video_names(self._notes)),
            pixels=PIXELS_PER_FRAME,
        )
        self.curve.append(point)
        return point

    def _begin_checkpoint(self, *, trains_on: bool) -> None:
        curve = [vars(point) for point in self.curve]
        notes = {**self._notes, "curve": curve, "coverage": self.coverage.to_state()}
        self._checkpoints.begin(self.trainer, notes, trains_on=trains_on)
