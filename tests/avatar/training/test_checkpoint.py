"""Checkpoints and kept frames: what is read is what was written, whole or not, and never code."""

import dataclasses
import errno
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar.config import TrainConfig
from avatar.rig import Rig
from avatar.training import checkpoint
from avatar.training.checkpoint import (
    INDEX_SHIFT_PER_VIDEO,
    as_earlier_video,
    load_frames,
    save_frames,
)
from avatar.training.frame_stream import prepare_frame, rebuild_frame
from avatar.training.replay_buffer import ReplayBuffer
from avatar.training.trainer import Trainer
from capture.input_error import InputError

CONFIG = TrainConfig(
    rays=128, sample_step_m=0.03, finest_m=0.05, levels=3, table_size=1 << 12,
    empty_space_points=32, seed=7,
)  # fmt: skip


@pytest.fixture(scope="module")
def frames(rig, clip):
    return [prepare_frame(clip.observations[i], rig) for i in (0, 5, 11)]


def taught(rig, frames) -> Trainer:
    trainer = Trainer(rig, CONFIG)
    for frame in frames:
        trainer.add_frame(frame)
    for _ in range(20):
        trainer.step(rate=1.0, hard_surface_share=0.5)
    trainer.wall_seconds, trainer.cpu_seconds = 12.5, 11.75
    return trainer


@pytest.fixture(scope="module")
def trainer(rig, frames) -> Trainer:
    """After 20 steps; tests leave it as it is."""
    return taught(rig, frames)


@pytest.fixture
def learner(rig, frames) -> Trainer:
    """One like it that a test may teach more."""
    return taught(rig, frames)


@pytest.fixture(scope="module")
def written(trainer, tmp_path_factory) -> tuple[str, bytes]:
    """Name and bytes of its checkpoint."""
    path = checkpoint.save(trainer, tmp_path_factory.mktemp("saved") / "checkpoint")
    return path.name, path.read_bytes()


@pytest.fixture
def saved(written, tmp_path) -> Path:
    """The checkpoint, to be spoilt."""
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    (folder / written[0]).write_bytes(written[1])
    return folder / written[0]


def damaged(path: Path, change) -> Path:
    """Rewrites a checkpoint after a change to its content; returns its folder."""
    state = torch.load(path, weights_only=True)
    change(state)
    torch.save(state, path)
    return path.parent


def numbers(trainer):
    """Everything that training has changed."""
    grid = trainer.avatar.occupancy.density_grid
    moments = [t for state in trainer.optimizer.state_dict()["state"].values() for t in
               (state["exp_avg"], state["exp_avg_sq"], state["step"])]  # fmt: skip
    fields = [*trainer.field.parameters(), *trainer.avatar.field.parameters()]
    return [*fields, grid.density, grid.occupied, *moments]


def test_what_is_read_is_what_was_written_to_the_last_bit(trainer, tmp_path):
    notes = {"video": "a.mp4", "curve": [{"psnr": 31.5}, {"psnr": None}], "held": [9, 19]}
    folder = tmp_path / "run" / "checkpoint"
    path = checkpoint.save(trainer, folder, notes=notes)
    again, read = checkpoint.load(folder)
    assert list(folder.iterdir()) == [path]
    assert read == notes
    assert again.config == trainer.config
    for name in checkpoint.COUNTERS:
        assert getattr(again, name) == getattr(trainer, name) != 0
    for ours, theirs in zip(numbers(again), numbers(trainer), strict=True):
        assert torch.equal(ours, theirs)
    for item in dataclasses.fields(Rig):
        ours, theirs = getattr(again.avatar.rig, item.name), getattr(trainer.avatar.rig, item.name)
        np.testing.assert_array_equal(ours, theirs)
        assert ours.dtype == theirs.dtype


def test_training_goes_on_where_it_stopped(rig, frames, saved):
    again, fresh = checkpoint.load(saved.parent)[0], Trainer(rig, CONFIG)
    losses = []
    for learner in (again, fresh):
        for frame in frames:
            learner.replay.add(frame)
        taken = [learner.step(rate=1.0, hard_surface_share=0.5) for _ in range(5)]
        losses.append(np.mean([float(result.loss.mean()) for result in taken]))
    assert losses[0] < 0.5 * losses[1]
    assert (again.steps, again.rays) == (25, 25 * CONFIG.rays)
    assert again.frames_seen == 3


def test_a_second_checkpoint_and_a_detached_state_are_those_of_their_step(learner, saved, tmp_path):
    learner.step(rate=1.0, hard_surface_share=0.5)
    checkpoint.save(learner, saved.parent)
    assert list(saved.parent.iterdir()) == [saved]  # it replaces the first
    detached = checkpoint.detached_state(learner)
    learner.step(rate=1.0, hard_surface_share=0.5)
    checkpoint.write_state(detached, tmp_path / "later")
    before, after = (checkpoint.load(folder)[0] for folder in (saved.parent, tmp_path / "later"))
    assert before.steps == after.steps == learner.steps - 1 == 21
    assert torch.equal(before.field.table, after.field.table)
    assert not torch.equal(before.field.table, learner.field.table)
    moments = [each.optimizer.state[each.field.table]["exp_avg"] for each in (before, after)]
    assert torch.equal(*moments)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no disk that is always full")
def test_a_disk_that_really_is_full_is_called_so(trainer, kept, saved, monkeypatch):
    before, save = saved.read_bytes(), torch.save

    def on_a_full_disk(state, file):
        with open("/dev/full", "wb") as full:
            save(state, full)

    monkeypatch.setattr(torch, "save", on_a_full_disk)
    for write in (lambda: checkpoint.save(trainer, saved.parent), lambda: save_frames(kept, saved)):
        with pytest.raises(OSError, match="No space") as caught:
            write()
        assert caught.value.errno == errno.ENOSPC
        assert list(saved.parent.iterdir()) == [saved]
        assert saved.read_bytes() == before


def test_a_folder_without_a_checkpoint_says_so(tmp_path):
    with pytest.raises(FileNotFoundError, match="checkpoint"):
        checkpoint.load(tmp_path / "checkpoint")


@pytest.mark.parametrize(
    "content", [0.0, 0.001, 0.3, 0.7, 0.999, b"a letter", b"\x80\x02", bytes(9)]
)
def test_a_file_that_was_cut_off_or_is_something_else_is_refused_by_name(saved, content):
    whole = saved.read_bytes()
    is_share = isinstance(content, float)
    saved.write_bytes(whole[: int(content * len(whole))] if is_share else content)
    with pytest.raises(InputError, match=str(saved)):
        checkpoint.load(saved.parent)


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, mark: Path):
        self.mark = mark

    def __reduce__(self):
        return os.mkdir, (str(self.mark),)


@pytest.mark.parametrize("write", [torch.save, lambda trap, path: path.write_bytes(trap)])
def test_code_in_a_checkpoint_is_refused_and_not_executed(saved, tmp_path, write):
    mark = tmp_path / "executed"
    trap = Trap(mark)
    write(trap if write is torch.save else pickle.dumps(trap, protocol=2), saved)
    with pytest.raises(InputError, match=rf"{saved} holds something other than numbers"):
        checkpoint.load(saved.parent)
    assert not mark.exists()
    pickle.loads(pickle.dumps(trap))  # the trap works
    assert mark.exists()


def test_a_checkpoint_of_another_format_says_which(saved):
    folder = damaged(saved, lambda state: state.update(format=checkpoint.CHECKPOINT_FORMAT + 1))
    with pytest.raises(
        InputError, match=rf"format {checkpoint.CHECKPOINT_FORMAT + 1}.*--overwrite"
    ):
        checkpoint.load(folder)


@pytest.mark.parametrize(
    ("key", "change"),
    [("format", "missing"), ("config", "missing"), ("rig", "missing"), ("field", "missing"),
     ("optimizer", "missing"), ("density", "missing"), ("occupied", "missing"),
     ("counts", "missing"), ("format", "nothing"), ("rig", "nothing"), ("optimizer", "nothing"),
     ("config", "too little"), ("field", "too little"), ("density", "too little")],
)  # fmt: skip
def test_a_checkpoint_that_lacks_something_is_refused_by_name(saved, key, change):
    def lose(state):
        if change == "missing":
            del state[key]
        elif change == "nothing":
            state[key] = None
        else:
            state[key] = {} if isinstance(state[key], dict) else []

    with pytest.raises(InputError, match=str(saved)):
        checkpoint.load(damaged(saved, lose))


@pytest.fixture
def kept(frames):
    """Two of them, of which one took over the slot of the third."""
    replay = ReplayBuffer(2)
    for frame in frames:
        replay.add(frame)
    return replay.replay_frames()


def test_a_frame_is_rebuilt_from_its_colors_alone(frames, rig):
    for frame in frames:
        again = rebuild_frame(frame.index, frame.pose, frame.view, frame.colors, rig)
        np.testing.assert_array_equal(again.pixels.flat_indices(), frame.pixels.flat_indices())
        np.testing.assert_array_equal(again.directions(), frame.directions())
        np.testing.assert_array_equal(again.colors, frame.colors)
        np.testing.assert_array_equal(again.origin, frame.origin)
        assert again.head is None
        head = frame.head.view, frame.head.colors
        again = rebuild_frame(0, frame.pose, frame.view, frame.colors, rig, head=head)
        for part, other in zip(again.head.runs, frame.head.runs, strict=True):
            np.testing.assert_array_equal(part, other)
        np.testing.assert_array_equal(
            again.correspondences.packed_cells, frame.correspondences.packed_cells
        )


def test_kept_frames_are_read_as_they_were_given_and_written(frames, kept, tmp_path):
    save_frames(kept, tmp_path / "frames.tensors")
    again = load_frames(tmp_path / "frames.tensors")
    assert [file.name for file in tmp_path.iterdir()] == ["frames.tensors"]
    for one, other in zip(kept, again, strict=True):
        (given,) = (frame for frame in frames if frame.index == one.index == other.index)
        np.testing.assert_array_equal(one.colors, given.colors)
        np.testing.assert_array_equal(other.colors, given.colors)
        np.testing.assert_array_equal(one.view.near_person_bits, other.view.near_person_bits)
        for part, other_part in zip(one.head, other.head, strict=True):
            part, other_part = (getattr(p, "near_person_bits", p) for p in (part, other_part))
            np.testing.assert_array_equal(part, other_part)
        assert one.head[0].camera.center_px == other.head[0].camera.center_px
        for name in ("focal_px", "center_px", "size_px", "distortion"):
            assert getattr(one.view.camera, name) == getattr(other.view.camera, name)
        np.testing.assert_array_equal(one.pose.joint_rotations, other.pose.joint_rotations)


def test_frames_of_an_earlier_video_have_numbers_of_their_own(kept):
    earlier = as_earlier_video(as_earlier_video(kept))
    assert all(frame.index < 0 for frame in earlier)
    assert [frame.index + 2 * INDEX_SHIFT_PER_VIDEO for frame in earlier] == [
        frame.index for frame in kept
    ]


def test_without_a_file_there_are_no_frames_and_a_damaged_one_is_refused(kept, tmp_path):
    path = tmp_path / "frames.tensors"
    assert load_frames(path) == []
    save_frames(kept, path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(InputError, match="cannot be read"):
        load_frames(path)
