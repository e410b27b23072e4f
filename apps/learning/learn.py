"""The walk from a recording to a trained avatar: feeds the trainer, listens, keeps checkpoints."""

import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, final

import torch

from apps.learning.extension import Extension, earlier_videos
from apps.learning.learnt import Learnt
from apps.learning.remaining import after_learning_s, how_far
from apps.learning.run_folder import RunFolder
from apps.learning.watcher import Watcher, shown
from apps.recording.recording import Recording
from apps.reporting.cpu_wait import CpuTime, CpuWait
from apps.reporting.curve import CurvePoint
from apps.reporting.meter import Meter
from apps.reporting.report import decibels, mean, percent
from apps.terminal.console import Bar, Console, duration
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
from capture.atomic_files import whole_file
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
            self._saved_at, waited = time.perf_counter(), CpuWait(self.trainer)
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
        self.meter.inbox_dropped, cpu = inbox.dropped, waited.read()
        interrupted = self._stop.is_set()
        late = [*self._how_late(), *filter(None, [cpu.warning()])]
        for warning in [*source.warnings, *late, *self._recording.told_at_the_end()]:
            self._console.warn(warning)
        self._console.count_the_rest()
        if len(self.trainer.replay):
            seen = percent(self.coverage.seen)
            self._console.say(f"{seen} of the person was seen. {advice(self.coverage)}")
            self._console.say(f"The package and the scores take {self._after(cpu)} more.")
        return Learnt(
            trainer=self.trainer,
            held=self.held,
            curve=tuple(self.curve),
            meter=self.meter,
            coverage=self.coverage,
            added=added + self.trainer.frames_seen,
            interrupted=interrupted,
            cpu=cpu,
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
                bar.move(self.trainer.scheduled_seconds, self._progress())
            case Stepped():
                self.meter.depth.add(float(self._inbox.waiting))
                bar.move(self.trainer.scheduled_seconds, self._progress())
                if time.perf_counter() - self._saved_at > CHECKPOINT_EVERY_S:
                    self._save()
            case Evaluated():
                point = self._mark(event.scores, event.wall_seconds, event.cpu_seconds)
                if point.psnr is not None:
                    so_far = decibels(point.psnr, point.verdict, learning=True)
                    self._console.say(f"{event.wall_seconds:6.1f} s   {so_far}")
            case Warned(message=message):
                self._console.warn(message)

    def _after(self, cpu: CpuTime) -> str:
        """How long the run takes from now on, about."""
        config, size = self.trainer.config, self.meter.size_px or (0, 0)
        rest = after_learning_s(
            len(self.held), max(size), fitted=config.refine_poses, slowed=1.0 / max(cpu.share, 0.05)
        )
        return f"about {duration(rest)}"

    def _how_far(self) -> str:
        trainer, total = self.trainer, self._recording.source.frame_count
        return how_far(
            wall_s=trainer.wall_seconds,
            given_s=trainer.config.seconds,
            step=trainer.steps,
            steps=trainer.config.steps,
            reading=None if self._inbox.finished else (self.meter.read, total),
        )

    def _progress(self) -> str:
        trainer, last = self.trainer, self.curve[-1] if self.curve else None
        rays = trainer.rays / max(trainer.wall_seconds, 1e-6)
        parts = [self._how_far()]  # what matters most comes first: terminals cut the rest off
        if last is not None and last.psnr is not None:
            parts.append(f"held out {decibels(last.psnr, last.verdict, digits=1, learning=True)}")
        parts += [
            f"{percent(self.coverage.seen)} seen",
            f"{trainer.frames_seen} frames",
            f"{rays / 1000.0:.0f}k rays/s",
            f"{trainer.samples / max(trainer.rays, 1):.1f} samples/ray",
            f"{self._inbox.waiting} waiting",
        ]
        if self._recording.source.paced:
            parts.append(f"{1000.0 * self.meter.behind_s:.0f} ms behind")
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
            video=1 + len(earlier_videos(self._notes)),
        )
        self.curve.append(point)
        return point

    def _final_scores(self) -> tuple[Score, ...]:
        if not self.held:
            return ()
        scores = tuple(self._counted(self.held))
        last = self.curve[-1].wall_seconds if self.curve else -1.0
        if self.trainer.wall_seconds > last:
            self._mark(scores, self.trainer.wall_seconds, self.trainer.cpu_seconds)
        return scores

    def _counted(self, held: Sequence[HeldOut]) -> Iterator[Score]:
        with self._console.bar(f"scoring {len(held)} held-out frames", float(len(held))) as bar:
            for done, frame in enumerate(held, start=1):
                yield score(self.trainer.avatar, frame)
                bar.count(done)

    def _fitted_scores(self) -> tuple[Score, ...]:
        if not (self.held and self.trainer.config.refine_poses):
            return ()
        with self._console.bar("fitting poses to the held-out frames", 1.0) as bar:
            return fitted_scores(self.trainer, self.held, progress=bar.share)

    def _save(self) -> None:
        curve = [vars(point) for point in self.curve]
        notes = {**self._notes, "curve": curve, "coverage": self.coverage.as_notes()}
        checkpoint.save(self.trainer, self._run.checkpoint, notes=notes)
        if not self._person_kept:
            with whole_file(self._run.person) as path:
                write_person(path, self._recording.shaped)
            self._person_kept = True
        self._saved_at = time.perf_counter()
