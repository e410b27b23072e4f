"""The stream of frames on its way to the trainer: which are held out, and which are redundant."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from avatar.deformation.rig import Rig
from avatar.evaluation.held_out import HeldOutFrame
from avatar.training.keyframe_selection import INITIAL_KEYFRAMES, KeyframeSelector
from avatar.training.training_frame import TrainingFrame, prepare_frame
from preprocess.observation import Observation
from preprocess.observe import DroppedFrame


class RedundantFrame(NamedTuple):
    """A frame that is not trained on, because it resembles the keyframe before it."""

    index: int


SplitItem = Observation | HeldOutFrame | DroppedFrame
"""An item of the stream once held-out frames have been separated from those to train on."""
StreamItem = TrainingFrame | HeldOutFrame | DroppedFrame | RedundantFrame
"""An item of the stream as the trainer receives it."""


def is_held_out(position: int, *, stride: int, total: int | None) -> bool:
    """Whether the frame at a position of the stream is held out: 9, 19, 29, ...

    Args:
        position: Number of frames before it.
        stride: Every `stride`-th frame is held out; 0 for none.
        total: Number of frames of the stream, if known. Of fewer than two strides the last quarter
            is held out, at least one frame.
    """
    if stride == 0:
        return False
    if total is not None and total < 2 * stride:
        return total > 1 and position >= total - max(1, total // 4)
    return position % stride == stride - 1


def separate_held_out(
    observations: Iterable[Observation | DroppedFrame], *, stride: int, total: int | None
) -> Iterator[SplitItem]:
    """Wraps the observations that are held out; the only place that decides which these are.

    Args:
        observations: Observations of the whole stream, in its order.
        stride: Every `stride`-th frame is held out; 0 for none.
        total: Number of frames of the stream, if known.

    Yields:
        One item for each observation.
    """
    for position, item in enumerate(observations):
        if isinstance(item, Observation) and is_held_out(position, stride=stride, total=total):
            yield HeldOutFrame(observation=item)
        else:
            yield item


def prepare_items(
    items: Iterable[SplitItem], rig: Rig, *, initial_keyframes: int = INITIAL_KEYFRAMES
) -> Iterator[StreamItem]:
    """Prepares the observations to train on, and passes over redundant ones.

    Args:
        items: Items of `separate_held_out`, some of which may have been dropped since.
        rig: Rig of the person.
        initial_keyframes: Frames that are trained on before any is called redundant.

    Yields:
        One item for each item.
    """
    selector = KeyframeSelector(rig, initial_keyframes=initial_keyframes)
    for item in items:
        if not isinstance(item, Observation):
            yield item
        elif selector.accepts(item):
            yield prepare_frame(item, rig)
        else:
            yield RedundantFrame(index=item.frame.index)


def prepare_stream(
    observations: Iterable[Observation | DroppedFrame],
    rig: Rig,
    *,
    stride: int,
    total: int | None,
    initial_keyframes: int = INITIAL_KEYFRAMES,
) -> Iterator[StreamItem]:
    """Separates held-out frames and prepares the others (`separate_held_out`, `prepare_items`)."""
    split = separate_held_out(observations, stride=stride, total=total)
    return prepare_items(split, rig, initial_keyframes=initial_keyframes)
