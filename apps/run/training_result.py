"""What training leaves in memory, for scores, report and package."""

from dataclasses import dataclass

from apps.report.cpu_contention import CpuTime
from apps.report.learning_curve import CurvePoint
from apps.report.report_schema import ForgettingStats
from apps.report.stream_meter import StreamMeter
from avatar.evaluation.coverage import Coverage
from avatar.evaluation.held_out import HeldOutFrame
from avatar.events import HeldOutScore
from avatar.training.trainer import Trainer


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingResult:
    """What training leaves in memory.

    Attributes:
        trainer: With the avatar as it is now.
        held: Held-out frames that have arrived.
        curve: Scores on the way, and at the end.
        meter: What it saw of the stream.
        coverage: What of the person the frames show that it was trained on.
        added: Frames that were put into the trainer's memory in this run.
        interrupted: Whether Ctrl-C ended it.
        scores: Of each held-out frame, at the end, in the given poses; empty until they are made.
        fitted: The same in poses fitted to them, if poses are refined.
        cpu: What the machine gave, and what the run waited for.
        extended: What an earlier video lost, if there was one.
    """

    trainer: Trainer
    held_out: list[HeldOutFrame]
    curve: tuple[CurvePoint, ...]
    meter: StreamMeter
    coverage: Coverage
    frames_added: int
    interrupted: bool
    cpu_time: CpuTime
    scores: tuple[HeldOutScore, ...] = ()
    fitted_pose_scores: tuple[HeldOutScore, ...] = ()
    earlier_videos: ForgettingStats | None = None

    @property
    def is_trained(self) -> bool:
        """Whether there is anything to show."""
        return self.trainer.steps > 0 and self.frames_added > 0
