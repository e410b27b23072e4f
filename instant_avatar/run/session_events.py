"""Events of a session: all that console, viewer, report, batch and other readers learn of a run.

for event in session.run():
    match event:
        case Stepped(step=step): ...
        case PackageWritten(result=result): ...
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from avatar.evaluation.coverage import Coverage
from avatar.events import TrainEvent
from avatar.training.trainer import Trainer
from capture.source import Frame
from instant_avatar.run.final_scoring import TrainingResult
from preprocess.body.parametric_body import ShapedBody
from preprocess.tracking.keypoints import PersonKeypoints


@dataclass(frozen=True, kw_only=True)
class Progressed:
    """A stage before or after training has come to `share`, from 0 to 1."""

    stage: str
    share: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracked:
    """A stream's frame was searched for the person; None if it was not found.

    It comes on the thread that reads frames, also before the session starts.
    """

    frame: Frame
    person: PersonKeypoints | None


@dataclass(frozen=True, eq=False, kw_only=True)
class Started:
    """Training begins; readers may look at these between two events, and change nothing."""

    trainer: Trainer
    coverage: Coverage
    shaped: ShapedBody


@dataclass(frozen=True, kw_only=True)
class Noted:
    """A message that asks for nothing."""

    message: str


@dataclass(frozen=True, kw_only=True)
class CheckpointSaved:
    """A checkpoint is on the disk, from which training can continue after `step` steps."""

    step: int


@dataclass(frozen=True, eq=False, kw_only=True)
class Playable:
    """A draft of the package can be played, of which nothing was checked."""

    path: Path


@dataclass(frozen=True, eq=False, kw_only=True)
class PackageWritten:
    """The package is checked; `is_final` once it is fine-tuned."""

    path: Path
    result: TrainingResult
    is_final: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class Scored:
    """The held-out frames have been scored, all or as many as the user has waited for."""

    result: TrainingResult


@dataclass(frozen=True, eq=False, kw_only=True)
class Ended:
    """Nothing more will be written; the last event."""

    result: TrainingResult


SessionEvent = (
    TrainEvent | Progressed | Tracked | Started | Noted
    | CheckpointSaved | Playable | PackageWritten | Scored | Ended
)  # fmt: skip
EventReader = Callable[[SessionEvent], object]
"""Reads every event of a session, on the thread that trains: what it takes is not trained."""
