"""Result of training, for scores, package and report."""

from dataclasses import dataclass, field

from apps.evaluation.final_scoring import FinalScores
from apps.report.cpu_contention import CpuTime
from apps.report.learning_curve import CurvePoint
from apps.report.report_schema import ForgettingStats
from apps.report.stream_meter import StreamMeter
from apps.run.package_snapshot import PackageSnapshot
from avatar.evaluation.coverage import Coverage
from avatar.evaluation.held_out import HeldOutFrame
from avatar.training.trainer import Trainer


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingResult:
    """A trained avatar and how it was trained.

    Attributes:
        trainer: Holds the avatar.
        held_out: Held-out frames that have arrived.
        curve: Learning curve, up to the final scores.
        meter: Timing and counts of the frame stream.
        coverage: Skin that the training frames show.
        frames_added: Frames of this capture that were trained on.
        interrupted: Whether Ctrl-C ended training.
        cpu_time: CPU time used, and lost to other programs.
        package: Outcome of packaging; None before `TrainingSession.bake`.
        scores: Final scores of the held-out frames; empty before `bake`.
        earlier_videos: Forgetting of earlier videos, if there were any.
    """

    trainer: Trainer
    held_out: list[HeldOutFrame]
    curve: tuple[CurvePoint, ...]
    meter: StreamMeter
    coverage: Coverage
    frames_added: int
    interrupted: bool
    cpu_time: CpuTime
    package: PackageSnapshot | None = None
    scores: FinalScores = field(default_factory=FinalScores)
    earlier_videos: ForgettingStats | None = None

    @property
    def is_trained(self) -> bool:
        """Whether any step was made on any frame."""
        return self.trainer.steps > 0 and self.frames_added > 0
