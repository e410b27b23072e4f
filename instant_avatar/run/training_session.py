"""A training session: frames in, steps, checkpoints, package, scores."""

import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, replace
from typing import Any, final

from numba import get_num_threads, set_num_threads

from avatar.evaluation.coverage import Coverage, coverage_advice
from avatar.evaluation.held_out import PIXELS_PER_FRAME, HeldOutFrame, add_held_out
from avatar.evaluation.image_metrics import overall_verdict
from avatar.events import (
    Evaluated,
    FrameArrived,
    HeldOutScore,
    Presentable,
    Stepped,
    TrainEvent,
    Warned,
)
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
from capture.input_error import counted
from export.bake.bake_tables import ExportRefused
from export.build import ExportReport, write_draft
from export.package.package_file import update_metrics
from instant_avatar.cli.command_line import BAD_INPUT, INTERRUPTED, CommandExit
from instant_avatar.report.report_schema import CurvePoint, finite_mean, format_percent
from instant_avatar.run.final_scoring import (
    EarlierVideos,
    FinalScores,
    TrainingResult,
    earlier_video_names,
    score_finally,
)
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.session_events import (
    CheckpointSaved,
    Ended,
    Noted,
    PackageWritten,
    Playable,
    Progressed,
    Scored,
    SessionEvent,
    Started,
)
from instant_avatar.run.snapshot_writer import CheckpointWriter, validation_views, write_packages
from instant_avatar.run.stream_meter import StreamMeter
from preprocess.capture_session import ObservationSource
from preprocess.licence_chain import licence_chain
from preprocess.observation import Observation


@final
class TrainingSession:
    """Training of one avatar on one capture, as a stream of events.

    Attributes:
        stop: Once it is set, training ends, and later whatever comes after the first package.
        newest_observation: The newest frame in which the person was found.
    """

    def __init__(
        self,
        trainer: Trainer,
        observations: ObservationSource,
        run: RunFolder,
        stop: threading.Event,
        notes: dict[str, Any],
        *,
        restore_count: int = 0,
    ) -> None:
        """Prepare the session; `run` starts it.

        `trainer` is new, or from a checkpoint. `notes` are stored with each checkpoint. The trainer
        was trained on `restore_count` frames of this video before; they are read back into its
        replay buffer before the clock starts.
        """
        self.trainer, self._source, self._run = trainer, observations, run
        self._capture, self._frames = observations.capture, observations.frames
        self.stop, self._notes, self._restore_count = stop, notes, restore_count
        self.curve = [CurvePoint(**kept) for kept in notes.get("curve", [])]
        self.held_out: list[HeldOutFrame] = []
        self.newest_observation: Observation | None = None
        self._checkpoints = CheckpointWriter(run, observations.capture)
        self.meter = StreamMeter(stop, observations.frames)
        self.coverage = Coverage(observations.capture.shaped)
        if "coverage" in notes:
            self.coverage.merge_state(notes["coverage"])
        self.is_interrupted = False
        self._result: TrainingResult | None = None
        self._ready_at: float | None = None
        self._report_progress: Callable[[str, float], object] = lambda *_: None
        self._scores: Future[FinalScores] | None = None
        self._tuned_at: float | None = None

    def run(
        self, report_progress: Callable[[Progressed], object] = lambda _: None
    ) -> Generator[SessionEvent, None, None]:
        """Train until the budget is used or the user stops; write the package; score.

        The package comes first, as it was baked; a fine-tuned one replaces it, and scores of the
        held-out frames follow. Setting `stop` ends training, and what follows the first package.
        `report_progress` receives the progress of stages that yield nothing meanwhile.
        """
        self._report_progress = lambda stage, share: report_progress(
            Progressed(stage=stage, share=share)
        )
        shaped = self._capture.shaped
        yield Started(trainer=self.trainer, coverage=self.coverage, shaped=shaped)
        yield from self._train()
        self._check_trained()
        self.trainer.replay.clear_correspondences()  # nothing is learnt from here on
        with ThreadPoolExecutor(1) as beside:
            yield from self._write_packages(beside)
            EarlierVideos(self._run, self._notes).save_frames(self.trainer)
            yield from self._score(beside)
        yield Ended(result=self.result)

    def save_package(self) -> ExportReport:
        """Write the avatar in its current state, between two steps; raise like `export_avatar`."""
        (exported,) = self._package_stages(fine_tune=False)
        return exported

    def _package_stages(self, **options: Any) -> Iterator[ExportReport]:
        return write_packages(
            self.trainer, self._run.package, validation_views(self.held_out, self._capture),
            curve_point=self.curve[-1] if self.curve else None,
            made_with=self._notes.get("made_with", ()), **options,
        )  # fmt: skip

    @property
    def result(self) -> TrainingResult:
        """What training, packaging and scoring have given so far, after the last step."""
        assert self._result is not None
        return self._result

    def _train(self) -> Iterator[SessionEvent]:
        source = self._frames
        self._source.set_catch_up(self._restore_count > 0)
        inbox = Inbox(
            self._frame_stream(),
            paced=source.paced, live=source.live, ends_run=self.meter.grows,
            all_came=lambda: source.all_came,
        )  # fmt: skip
        try:
            restored = self._restore_frames(inbox, self._restore_count)
            added = restored - self.trainer.frames_seen
            self._source.set_catch_up(False)
            self._checkpoints.restart_interval()
            for event in train(self.trainer, inbox, self.held_out):
                yield from self._handle_event(event, inbox)
                if self.stop.is_set():
                    break
        finally:
            source.close()
            inbox.close()
            self._checkpoints.settle()
        self.meter.inbox_dropped, self.is_interrupted = inbox.dropped, self.stop.is_set()
        for message in [*source.warnings, *self.meter.lateness_warnings()]:
            yield Warned(message=message)
        for message in self._source.notes():
            yield Noted(message=message)
        if len(self.trainer.replay):
            seen = format_percent(self.coverage.seen_share)
            yield Noted(message=f"Body coverage: {seen}. {coverage_advice(self.coverage)}")
        self._result = TrainingResult(
            trainer=self.trainer,
            held_out=self.held_out,
            curve=tuple(self.curve),
            meter=self.meter,
            coverage=self.coverage,
            frames_added=added + self.trainer.frames_seen,
            interrupted=self.is_interrupted,
            ready_at=self._ready_at,
            licence=licence_chain(self._notes.get("made_with", ())),
        )

    def _write_packages(self, beside: Executor) -> Iterator[SessionEvent]:
        """Write the package as baked, then the fine-tuned one, and checkpoints beside the first.

        Held-out frames are scored beside the fine-tuning.
        """

        def check_stop(share: float) -> None:
            if self._is_left_out():
                raise KeyboardInterrupt
            self._report_progress("fine-tuning the package", share)

        self._begin_checkpoint(trains_on=False)  # baking changes nothing of it
        self._report_progress("writing the package", 0.0)
        try:
            for exported in self._package_stages(baked_first=True, progress=check_stop):
                self._checkpoints.settle()
                self._checkpoints.wait()
                is_final = self.result.exported is not None
                ready_at = self.result.ready_at or time.perf_counter()
                self._result = replace(self.result, exported=exported, ready_at=ready_at)
                yield PackageWritten(path=self._run.package, result=self.result, is_final=is_final)
                self._begin_scoring(beside)
        except ExportRefused as error:  # of the fine-tuned one: that as baked stays
            if self.result.exported is None:
                self._result = replace(self.result, refusal=str(error))
                if self._ready_at is not None:
                    self._run.package.unlink()
        finally:
            self._checkpoints.settle()
        self._checkpoints.wait()
        for message in self.result.exported.warnings if self.result.exported else ():
            yield Warned(message=message)

    def _begin_scoring(self, beside: Executor) -> "Future[FinalScores]":
        if self._scores is None:
            self._scores = beside.submit(self._compute_scores, get_num_threads())
        return self._scores

    def _compute_scores(self, threads: int) -> FinalScores:
        """Score held-out frames, in the given poses and in poses fitted to them."""
        set_num_threads(threads)  # each thread has a number of its own
        began = time.perf_counter()

        def report_progress(stage: str, share: float) -> None:
            if self._tuned_at is not None:
                self._report_progress(stage, share)

        def read_clock() -> float:
            now = time.perf_counter()
            tuned_at = max(began, self._tuned_at or now)
            return now - tuned_at + 0.5 * (tuned_at - began)

        return score_finally(
            self.trainer, self.held_out,
            fit_poses=self.trainer.config.refine_poses and not self.is_interrupted,
            report_progress=report_progress, is_left_out=self._is_left_out, clock=read_clock,
        )  # fmt: skip

    def _score(self, beside: Executor) -> Iterator[SessionEvent]:
        """Wait for the scores of held-out frames, and add them to curve, package and result."""
        self._tuned_at = time.perf_counter()
        scores = self._begin_scoring(beside).result()
        last = self.curve[-1].wall_seconds if self.curve else -1.0
        if scores.sampled and self.trainer.wall_seconds > last:
            wall_s, cpu_s = self.trainer.wall_seconds, self.trainer.cpu_seconds
            self._add_curve_point(scores.sampled, wall_s, cpu_s)
        self._begin_checkpoint(trains_on=False)
        self._checkpoints.wait()
        result = replace(
            self.result, scores=scores, curve=tuple(self.curve), interrupted=self.stop.is_set(),
            earlier_videos=EarlierVideos(self._run, self._notes).stats(),
        )  # fmt: skip
        if scores.given and self.curve and result.exported is not None:
            summary = scores.summarize(self.curve[-1], result.all_round_verdict().verdict)
            size = update_metrics(self._run.package, {"held_out": asdict(summary)})
            result = replace(result, exported=replace(result.exported, bytes=size))
        self._result = result
        yield Scored(result=result)

    def _is_left_out(self) -> bool:
        """Whether the user has stopped what follows the first package."""
        return self.stop.is_set() and not self.is_interrupted

    def _check_trained(self) -> None:
        if self.result.is_trained:
            return
        if self.is_interrupted:
            raise CommandExit("stopped before the first step; no avatar was written.", INTERRUPTED)
        reasons = Counter(drop.reason for drop in self.meter.dropped)
        why = ", ".join(f"{count} x {reason}" for reason, count in reasons.most_common(3))
        raise CommandExit(
            f"no frame of {self._frames.path} could be used ({why or 'it has none'}); at "
            "least two usable frames are needed. No avatar was written.",
            BAD_INPUT,
        )

    def _frame_stream(self) -> Iterator[StreamItem]:
        """Prepare frames; runs on the inbox's thread."""
        frames = self.meter.measure_arrival(self._frames.frames())
        found = self.meter.count_observations(map(self._source.join, frames))
        rig, every = self.trainer.avatar.rig, self.trainer.config.held_out_stride
        total = self._frames.frame_count
        items = self._watch(separate_held_out(found, stride=every, total=total))
        return self.meter.measure_preparation(prepare_items(items, rig))

    def _watch(self, items: Iterator[SplitItem]) -> Iterator[SplitItem]:
        """Pass items on; keep the newest observation, and cover what is not held out."""
        for item in items:
            if isinstance(item, Observation):
                self.coverage.add(item)
                self.newest_observation = item
            elif isinstance(item, HeldOutFrame):
                self.newest_observation = item.observation
            yield item

    def _restore_frames(self, inbox: Inbox[StreamItem], count: int) -> int:
        """Read frames back into the replay buffer; return how many."""
        seen = 0
        while seen < count and not (inbox.finished or self.stop.is_set()):
            self._report_progress(f"reading back {counted(count, 'frame')}", seen / count)
            for item in inbox.take(timeout_s=0.1):
                if isinstance(item, HeldOutFrame):
                    add_held_out(self.held_out, item)
                    self.meter.mark_arrived(item.observation.frame.index, held_out=True)
                elif isinstance(item, TrainingFrame):
                    self.trainer.add_frame(item, is_restored=True)
                    seen += 1
        return seen

    def _handle_event(self, event: TrainEvent, inbox: Inbox[StreamItem]) -> Iterator[SessionEvent]:
        """Keep count of an event, and pass it on with what follows from it."""
        match event:
            case FrameArrived(index=index, held_out=held_out):
                self.meter.mark_arrived(index, held_out=held_out)
            case Stepped():
                self.meter.inbox_depth.append(float(inbox.pending))
                if self._checkpoints.is_due():
                    self._begin_checkpoint(trains_on=True)
                for step in self._checkpoints.take_saved():
                    yield CheckpointSaved(step=step)
            case Evaluated():
                self._add_curve_point(event.scores, event.wall_seconds, event.cpu_seconds)
            case Presentable():
                yield from self._write_draft()
        yield event

    def _write_draft(self) -> Iterator[Playable]:
        """Write a package to be played until a checked one replaces it, unless it is empty."""
        view = validation_views(self.held_out, self._capture)[0]
        with self.trainer.paused(), suppress(ExportRefused):
            write_draft(self.trainer.avatar, self._run.package, view)
            self._ready_at = time.perf_counter()
            yield Playable(path=self._run.package)

    def _add_curve_point(
        self, scores: tuple[HeldOutScore, ...], wall_s: float, cpu_s: float
    ) -> None:
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

    def _begin_checkpoint(self, *, trains_on: bool) -> None:
        curve = [vars(point) for point in self.curve]
        notes = {**self._notes, "curve": curve, "coverage": self.coverage.to_state()}
        self._checkpoints.begin(self.trainer, notes, trains_on=trains_on)
