"""The console's reader of a session: a progress line, scores as they are made, and messages."""

from contextlib import ExitStack
from typing import final

from avatar.events import Evaluated, FrameArrived, FrameLeftOut, Stepped, Warned
from capture.input_error import counted
from instant_avatar.cli.console import Console, ProgressBar
from instant_avatar.report.report_schema import format_percent, format_psnr
from instant_avatar.run.session_events import (
    Ended,
    Noted,
    PackageWritten,
    Progressed,
    Scored,
    SessionEvent,
)
from instant_avatar.run.training_session import TrainingSession


@final
class ConsoleReader:
    """Shows a session's events on a console."""

    def __init__(self, session: TrainingSession, console: Console, cleanup: ExitStack) -> None:
        """Show nothing yet; `cleanup` removes the progress line."""
        self._session, self._console = session, console
        self._line = cleanup.enter_context(ExitStack())
        self._bar: ProgressBar | None = None
        self._stage = ""

    def __call__(self, event: SessionEvent) -> None:
        """Show an event."""
        trainer = self._session.trainer
        match event:
            case FrameArrived() | FrameLeftOut() | Stepped():
                share = trainer.scheduled_seconds / trainer.config.seconds
                self._show_stage("training").update(share, self._training_text())
            case Evaluated(wall_seconds=seconds) if (point := self._session.curve[-1]).psnr:
                score = format_psnr(point.psnr, point.verdict, provisional=True)
                self._console.info(f"{seconds:6.1f} s   {score}")
            case Progressed(stage=stage, share=share):
                self._show_stage(stage).set_share(share)
            case PackageWritten() | Scored() | Ended():
                self._line.close()  # other readers have it now
                self._stage = ""
                if isinstance(event, Ended):
                    self._console.summarize_warnings()
            case Noted(message=message):
                self._console.note(message)
            case Warned(message=message):
                self._console.warning(message)

    def _show_stage(self, stage: str) -> ProgressBar:
        """Return the bar of a stage, which replaces that of another one."""
        if stage != self._stage or self._bar is None:
            self._line.close()
            self._stage = stage
            self._bar = self._line.enter_context(self._console.progress(stage, 1.0))
        return self._bar

    def _training_text(self) -> str:
        """Return time, quality and coverage; terminals cut off the end of a long line."""
        session, trainer = self._session, self._session.trainer
        elapsed_s, budget_s = trainer.wall_seconds, trainer.config.seconds
        if trainer.config.steps:
            left = trainer.steps <= trainer.config.steps  # streams make more, after a short film
            total = f" of {trainer.config.steps}" if left else ""
            position = f"step {trainer.steps}{total}, {elapsed_s:.0f} s"
        elif session.meter.grows:
            position = f"{elapsed_s:.0f} s"
        elif elapsed_s <= budget_s:
            position = f"{elapsed_s:.0f} of {round(budget_s, 1):g} s"
        else:
            position = f"{elapsed_s:.0f} s: the first pass over the video goes on"
        parts = [position]
        if session.curve and (last := session.curve[-1]).psnr is not None:
            score = format_psnr(last.psnr, last.verdict, digits=1, provisional=True)
            parts.append(f"held-out PSNR {score}")
        parts += [
            f"{format_percent(session.coverage.seen_share)} seen",
            counted(trainer.frames_seen, "frame"),
        ]
        if session.meter.is_paced:
            parts.append(f"{1000.0 * session.meter.current_latency_s:.0f} ms behind")
        return " · ".join(parts)
