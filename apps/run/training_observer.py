"""What looks on while an avatar is learnt: it hears of everything, and is let in between steps."""

from collections.abc import Iterator, Sequence
from typing import Protocol, runtime_checkable

from apps.report.learning_curve import CurvePoint
from avatar.evaluation.coverage import Coverage
from avatar.evaluation.held_out import HeldOutFrame
from avatar.events import TrainEvent
from avatar.training.frame_stream import SplitItem
from avatar.training.trainer import Trainer
from preprocess.observation import Observation


@runtime_checkable
class ObservableSession(Protocol):
    """A lesson, as those see it who look on.

    Attributes:
        trainer: With the avatar as it is now.
        held: Held-out frames that have arrived.
        curve: Scores so far.
        coverage: What of the person has been seen so far.
    """

    trainer: Trainer
    held_out: list[HeldOutFrame]
    curve: list[CurvePoint]
    coverage: Coverage

    @property
    def stop_requested(self) -> bool:
        """Whether the user has asked to stop."""
        ...


@runtime_checkable
class TrainingObserver(Protocol):
    """Observer of a training session, such as the live viewer."""

    def on_frame(self, observation: Observation, *, held_out: bool) -> None:
        """A frame in which the person was found, before the trainer has it.

        Called on the reader's thread: it must be quick, and may run no parallel kernel.
        """

    def on_event(self, event: TrainEvent) -> None:
        """Something happened; called on the thread that trains."""

    def between_steps(self, session: ObservableSession) -> None:
        """Between two steps, on the thread that trains: kernels may run here.

        What it takes counts as training time, except inside `Trainer.held_up`.
        """


def notify_observers(
    items: Iterator[SplitItem], coverage: Coverage, observers: Sequence[TrainingObserver]
) -> Iterator[SplitItem]:
    """Passes items on; observers see every observation, coverage those that are trained on.

    Args:
        items: Observations, of which the held-out ones are wrapped.
        coverage: Adds the observations that are not held out.
        observers: Receive all observations.
    """
    for item in items:
        if isinstance(item, Observation):
            coverage.add(item)
            for observer in observers:
                observer.on_frame(item, held_out=False)
        elif isinstance(item, HeldOutFrame):
            for observer in observers:
                observer.on_frame(item.observation, held_out=True)
        yield item
