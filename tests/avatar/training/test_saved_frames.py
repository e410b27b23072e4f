"""Frames that a finished avatar keeps: the same after a round trip, and bounded."""

import numpy as np
import pytest
import torch

from avatar.training.checkpoint import (
    INDEX_SHIFT_PER_VIDEO,
    as_earlier_video,
    load_frames,
    save_frames,
)
from avatar.training.frame_stream import prepare_frame, rebuild_frame
from avatar.training.replay_buffer import ReplayBuffer
from capture.input_error import InputError


@pytest.fixture(scope="module")
def frames(rig, clip):
    return [prepare_frame(clip.observations[i], rig) for i in (0, 5, 11)]


@pytest.fixture
def kept(frames):
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


def test_replay_returns_the_colors_it_was_given(frames):
    replay = ReplayBuffer(3)
    for frame in frames:
        replay.add(frame)
    for frame, kept in zip(frames, replay.replay_frames(), strict=True):
        assert kept.index == frame.index
        np.testing.assert_array_equal(kept.colors, frame.colors)
    replay = ReplayBuffer(1)
    for frame in frames:  # one after the other in the same slot, of different sizes
        replay.add(frame)
        (kept,) = replay.replay_frames()
        np.testing.assert_array_equal(kept.colors, frame.colors)


def test_what_is_written_is_read(kept, tmp_path):
    save_frames(kept, tmp_path / "frames.tensors")
    again = load_frames(tmp_path / "frames.tensors")
    assert [file.name for file in tmp_path.iterdir()] == ["frames.tensors"]
    for one, other in zip(kept, again, strict=True):
        assert one.index == other.index
        np.testing.assert_array_equal(one.colors, other.colors)
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


def test_a_full_disk_leaves_the_older_file(kept, tmp_path, monkeypatch):
    path = tmp_path / "frames.tensors"
    path.write_bytes(b"older")

    def full(state, file):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space"):
        save_frames(kept, path)
    assert path.read_bytes() == b"older"
    assert [file.name for file in tmp_path.iterdir()] == ["frames.tensors"]
