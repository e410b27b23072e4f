"""The walk from a recording to a trained avatar: feeds the trainer, listens, keeps checkpoints."""

import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, final

import torch

from apps.learning.extension import Extension
from apps.learning.learnt import Learnt
from apps.learning.run_folder import RunFolder
from apps.learning.watcher import Watcher, shown
from apps.recording.recording import Recording
from apps.reporting.curve import CurvePoint
from apps.reporting.meter import Meter
from apps.reporting.report import decibels, mean, percent
from apps.terminal.console import Bar, Console
from apps.terminal.whole import whole_file
from avatar import checkpoint
from avatar.advice import advice
from avatar.config import HOLD_EVERY, TrainConfig
from avatar.coverage import Coverage
from avatar.events import Arrived, Evaluated, Score, Stepped, TrainEvent, Warned
from avatar.fit import fitted_scores
from avatar.hold import HeldOut, Ready, keep, prepared, score
from avatar.prepare import PreparedFrame
from avatar.rig import Rig
from avatar.sharpness import verdict_of
from avatar.train import train
from avatar.trainer import Trainer
from capture.inbox import Inbox
from capture.playback import Playback
from preprocess.person_file import write_person

CHECKPOINT_EVERY_S = 5.0
LATE_S = 0.5
"""A playback that lags more than this is spoken of."""


def new_trainer(
    recording: Recording,
    *,
    seconds: float,
    steps: int | None = None,
    seed: int,
    refine_poses: bool,
    hold_every: int = HOLD_EVERY,
    device: torch.device,
) -> Trainer:
    """A trainer that has seen nothing, for this person, this waiting time and this picture size."""
    config = TrainConfig.within(
        seconds,
        steps=steps,
        footprint_m=recording.footprint_m(),
        frames=recording.source.frame_count,
        hold_every=hold_every,
        seed=seed,
    )
    config = replace(config, refine_poses=refine_poses)
    return Trainer(Rig.of(recording.shaped), config, device)


@final
class Lesson:
    """One recording taught to one trainer.

    Attributes:
        trainer: With the avatar as it is now.
        held: Held-out frames that have arrived.
        curve: Scores so far.
        coverage: What of the person has been seen so far.
        meter: What it saw of the stream.
    """

    def __init__(
        self,
        trainer: Trainer,
        recording: Recording,
        run: RunFolder,
        console: Console,
        stop: threading.Event,
        notes: dict[str, Any],
        *,
        watchers: Sequence[Watcher] = (),
    ) -> None:
        """Nothing happens yet.

        Args:
            trainer: New, or from a checkpoint.
            recording: Its frames are read anew.
            run: Where checkpoints go.
            console: Where progress is shown.
            stop: Ends training as soon as it is set.
            notes: Kept with each checkpoint.
            watchers: Who looks on.
        """
        self.trainer, self._recording, self._run = trainer, recording, run
        self._console, self._stop, self._notes = console, stop, notes
        self._watchers = watchers
        self.curve: list[CurvePoint] = [CurvePoint.again(kept) for kept in notes.get("curve", [])]
        self.held: list[HeldOut] = []
        self._saved_at, self._person_kept = time.perf_counter(), False
        self.meter = Meter(stop, recording.source)
        self.coverage = Coverage(recording.shaped)
        if "coverage" in notes:
            self.coverage.recall(notes["coverage"])

    @property
    def stopping(self) -> bool:
        """Whether somebody wants it to end."""
        return self._stop.is_set()

    def learn(self, *, recall: int = 0) -> Learnt:
        """Trains until the time is up or somebody stops it. Scores come later (`scored`).

        What was learnt since the last checkpoint is not written yet (`saving`).

        Args:
            recall: Frames that the trainer has learnt from before: they are put back into its
                memory before the clock starts.

        Raises:
            OSError: If a checkpoint cannot be written; the one before stays.
        """
        source = self._recording.source
        self._rush(recall > 0)
        self._inbox = inbox = Inbox(self._frames(), paced=source.paced, live=source.live)
        try:
            added = self._recall(inbox, recall) - self.trainer.frames_seen
            self._rush(False)
            self._saved_at = time.perf_counter()
            with self._console.bar("learning", self.trainer.config.seconds) as bar:
                for event in train(self.trainer, inbox, self.held):
                    self._listen(event, bar)
                    for watcher in self._watchers:
                        watcher.heard(event)
                        watcher.tend(self)
                    if self._stop.is_set():
                        break
        finally:
            source.close()
            inbox.close()
        self.meter.inbox_dropped = inbox.dropped
        interrupted = self._stop.is_set()
        for warning in [*source.warnings, *self._how_late(), *self._recording.told_at_the_end()]:
            self._console.warn(warning)
        self._console.count_the_rest()
        if len(self.trainer.replay):
            seen = percent(self.coverage.seen)
            self._console.say(f"{seen} of the person was seen. {advice(self.coverage)}")
        return Learnt(
            trainer=self.trainer,
            held=self.held,
            curve=tuple(self.curve),
            meter=self.meter,
            coverage=self.coverage,
            added=added + self.trainer.frames_seen,
            interrupted=interrupted,
        )

    @contextmanager
    def saving(self) -> Iterator[None]:
        """Writes a checkpoint beside what happens in this block, which changes nothing learnt.

        Raises:
            OSError: If it cannot be written; the one before stays.
        """
        with ThreadPoolExecutor(1) as beside:
            saved = beside.submit(self._save)
            yield
        saved.result()

    def scored(self, learnt: Learnt) -> Learnt:
        """The same with every held-out frame scored, in given poses and in fitted ones.

        It takes a while, and the package need not wait for it.
        """
        scores = self._final_scores()
        self._save()
        extended = Extension(self._run, self._notes).finish(self.trainer, self.held, self._console)
        return replace(
            learnt,
            scores=scores,
            fitted=() if learnt.interrupted else self._fitted_scores(),
            curve=tuple(self.curve),
            extended=extended,
        )

    def _rush(self, rushed: bool) -> None:
        """What a run has seen before is not played again at its own speed."""
        if isinstance(self._recording.source, Playback):
            self._recording.source.rushed = rushed

    def _frames(self) -> Iterator[Ready]:
        """Frames as they become ready; runs on the inbox's thread."""
        frames = self.meter.frames(self._recording.source.frames())
        found = self.meter.watched(map(self._recording.observer(), frames))
        rig, every = self.trainer.avatar.rig, self.trainer.config.hold_every
        total = self._recording.source.frame_count
        observations = shown(found, self.coverage, self._watchers, every=every, total=total)
        return self.meter.timed(prepared(observations, rig, every=every, total=total))

    def _recall(self, inbox: Inbox[Ready], count: int) -> int:
        """Puts frames back into the memory of a trainer that has learnt from them before."""
        seen = 0
        if not count:
            return seen
        with self._console.waiting(f"reading back {count} frames"):
            while seen < count and not (inbox.finished or self._stop.is_set()):
                for item in inbox.take(wait_s=0.1):
                    if isinstance(item, HeldOut):
                        keep(self.held, item)
                        self.meter.arrived(item.observation.frame.index, held_out=True)
                    elif isinstance(item, PreparedFrame):
                        self.trainer.add(item, again=True)
                        seen += 1
        return seen

    def _listen(self, event: TrainEvent, bar: Bar) -> None:
        match event:
            case Arrived(index=index, held_out=held_out):
                self.meter.arrived(index, held_out=held_out)
            case Stepped():
                self.meter.depth.add(float(self._inbox.waiting))
                bar.move(self.trainer.scheduled_seconds, self._progress(event))
                if time.perf_counter() - self._saved_at > CHECKPOINT_EVERY_S:
                    self._save()
            case Evaluated():
                point = self._mark(event.scores, event.wall_seconds, event.cpu_seconds)
                if point.psnr is not None:
                    so_far = decibels(point.psnr, point.verdict)
                    self._console.say(f"{event.wall_seconds:6.1f} s   {so_far}")
            case Warned(message=message):
                self._console.warn(message)

    def _progress(self, event: Stepped) -> str:
        config = self.trainer.config
        last = self.curve[-1] if self.curve else None
        rays = self.trainer.rays / max(event.wall_seconds, 1e-6)
        parts = [
            f"{event.wall_seconds:.0f}" + ("" if config.steps else f"/{config.seconds:.0f}") + " s",
            f"{event.frames_seen} frames",
            f"step {event.step}" + (f"/{config.steps}" if config.steps else ""),
            f"{rays / 1000.0:.0f}k rays/s",
            f"{event.samples_per_ray:.1f} samples/ray",
            f"{self._inbox.waiting} waiting",
            f"{percent(self.coverage.seen)} seen",
        ]
        if self._recording.source.paced:
            parts.append(f"{1000.0 * self.meter.behind_s:.0f} ms behind")
        if last is not None and last.psnr is not None:
            parts.append(f"held out {decibels(last.psnr, last.verdict, digits=1)}")
        return " · ".join(parts)

    def _how_late(self) -> Iterator[str]:
        """What a user should know about a stream that could not be kept up with."""
        source, late = self._recording.source, self.meter.lateness_s
        if source.dropped + self._inbox.dropped:
            yield (
                f"{source.dropped + self._inbox.dropped} frames gave way to later ones, because "
                "preparing a frame takes longer than filming it. A smaller --size is faster."
            )
        if source.paced and not source.live and late.percentile(95.0) > LATE_S:
            yield (
                f"The playback fell behind by up to {late.largest:.1f} s (half of the frames by "
                f"{late.percentile(50.0):.1f} s or more): frames are not prepared as fast as they "
                "come. No frame was lost. A smaller --size, or every other frame (--frames ::2), "
                "is faster."
            )

    def _mark(self, scores: tuple[Score, ...], wall_s: float, cpu_s: float) -> CurvePoint:
        point = CurvePoint(
            wall_seconds=wall_s,
            cpu_seconds=cpu_s,
            frames_seen=self.trainer.frames_seen,
            psnr=mean([s.psnr for s in scores]),
            psnr_mask=mean([s.psnr_mask for s in scores]),
            verdict=verdict_of(scores),
            frames=tuple((s.frame, s.psnr) for s in scores),
        )
        self.curve.append(point)
        return point

    def _final_scores(self) -> tuple[Score, ...]:
        if not self.held:
            return ()
        with self._console.waiting(f"scoring {len(self.held)} held-out frames"):
            scores = tuple(score(self.trainer.avatar, held) for held in self.held)
        last = self.curve[-1].wall_seconds if self.curve else -1.0
        if self.trainer.wall_seconds > last:
            self._mark(scores, self.trainer.wall_seconds, self.trainer.cpu_seconds)
        return scores

    def _fitted_scores(self) -> tuple[Score, ...]:
        if not (self.held and self.trainer.config.refine_poses):
            return ()
        with self._console.waiting("fitting poses to the held-out frames"):
            return fitted_scores(self.trainer, self.held)

    def _save(self) -> None:
        curve = [vars(point) for point in self.curve]
        notes = {**self._notes, "curve": curve, "coverage": self.coverage.as_notes()}
        checkpoint.save(self.trainer, self._run.checkpoint, notes=notes)
        if not self._person_kept:
            with whole_file(self._run.person) as path:
                write_person(path, self._recording.shaped)
            self._person_kept = True
        self._saved_at = time.perf_counter()
