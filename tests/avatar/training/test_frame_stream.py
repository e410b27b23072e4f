"""The stream decides once which frames are held out, and layers in between cannot change it."""

from avatar.evaluation.held_out import HeldOutFrame
from avatar.training.frame_stream import (
    TrainingFrame,
    prepare_items,
    separate_held_out,
)


def indices_of(items, kind):
    """Source indices of the items of one type."""
    return [
        item.observation.frame.index if isinstance(item, HeldOutFrame) else item.index
        for item in items
        if isinstance(item, kind)
    ]


def test_an_item_that_is_dropped_in_between_moves_no_held_out_frame(rig, clip):
    split = separate_held_out(clip.observations[:8], stride=3, total=None)
    kept = (item for position, item in enumerate(split) if position != 1)
    items = list(prepare_items(kept, rig))
    assert indices_of(items, HeldOutFrame) == [2, 5]
    assert 1 not in indices_of(items, TrainingFrame)
