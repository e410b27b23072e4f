"""Frames that a finished avatar keeps: the same after a round trip, and bounded."""

import dataclasses

import numpy as np
import pytest
import torch

from avatar.hold import HeldOut
from avatar.kept_frames import CLIP, HELD_OUT, KeptFrames, number_in_video, videos_ago
from avatar.prepare import prepare, restored
from avatar.replay import Replay
from capture.errors import BadInput

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def frames(rig, clip):
    return [prepare(clip.observations[i], rig) for i in (0, 5, 11)]


@pytest.fixture
def kept(frames, clip):
    replay = Replay(2, CPU)
    for frame in frames:
        replay.add(frame)
    return KeptFrames.of(replay, [HeldOut(observation=o) for o in clip.observations[3:5]])


def test_a_frame_is_made_ready_again_from_its_colours_alone(frames, rig):
    for frame in frames:
        again = restored(frame.index, frame.pose, frame.sight, frame.colors, rig)
        assert again.near == frame.near
        np.testing.assert_array_equal(again.directions, frame.directions)
        np.testing.assert_array_equal(again.origin, frame.origin)
        np.testing.assert_array_equal(again.cells.index, frame.cells.index)


def test_replay_gives_back_the_colours_that_it_was_given(frames):
    replay = Replay(3, CPU)
    for frame in frames:
        replay.add(frame)
    for frame, kept in zip(frames, replay.key_frames(), strict=True):
        assert kept.index == frame.index
        np.testing.assert_array_equal(kept.colors, frame.colors)
    replay = Replay(1, CPU)
    for frame in frames:  # one after the other in the same slot, of different sizes
        replay.add(frame)
        (kept,) = replay.key_frames()
        np.testing.assert_array_equal(kept.colors, frame.colors)


def test_what_is_written_is_read(kept, tmp_path):
    kept.save(tmp_path / "frames.tensors")
    again = KeptFrames.load(tmp_path / "frames.tensors")
    assert [file.name for file in tmp_path.iterdir()] == ["frames.tensors"]
    for one, other in zip(kept.key_frames, again.key_frames, strict=True):
        assert one.index == other.index
        np.testing.assert_array_equal(one.colors, other.colors)
        np.testing.assert_array_equal(one.sight.near, other.sight.near)
        for name in ("focal_px", "center_px", "size_px", "distortion"):
            assert getattr(one.sight.camera, name) == getattr(other.sight.camera, name)
        np.testing.assert_array_equal(one.pose.joint_rotations, other.pose.joint_rotations)
    for one, other in zip(kept.held, again.held, strict=True):
        assert one.observation.frame.index == other.observation.frame.index
        np.testing.assert_array_equal(one.observation.frame.rgb, other.observation.frame.rgb)
        np.testing.assert_allclose(one.observation.alpha, other.observation.alpha, atol=1e-5)


def test_frames_of_an_earlier_video_have_numbers_of_their_own(kept):
    earlier = kept.earlier().earlier()
    assert [frame.index + 2 * CLIP for frame in earlier.key_frames] == [
        frame.index for frame in kept.key_frames
    ]
    indices = [h.observation.frame.index for h in earlier.held]
    assert all(index < 0 for index in indices)
    assert [number_in_video(index) for index in indices] == [3, 4]
    assert [videos_ago(index) for index in indices] == [2, 2]
    assert [videos_ago(h.observation.frame.index) for h in kept.held] == [0, 0]


def test_few_held_out_frames_are_kept_of_many(clip):
    held = [HeldOut(observation=o) for o in clip.observations]
    kept = KeptFrames.of(Replay(1, CPU), held)
    assert len(kept.held) == HELD_OUT < len(held)
    assert kept.held[0] is held[0]
    assert kept.held[-1] is held[-1]


def test_a_frame_that_nobody_can_make_ready_again_is_not_kept(frames):
    replay = Replay(2, CPU)
    replay.add(dataclasses.replace(frames[0], sight=None))
    assert replay.key_frames() == []


def test_without_a_file_there_are_no_frames_and_a_damaged_one_is_refused(kept, tmp_path):
    path = tmp_path / "frames.tensors"
    assert KeptFrames.load(path) == KeptFrames([], [])
    kept.save(path)
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(BadInput, match="cannot be read"):
        KeptFrames.load(path)


def test_a_full_disk_leaves_the_older_file(kept, tmp_path, monkeypatch):
    path = tmp_path / "frames.tensors"
    path.write_bytes(b"older")

    def full(state, file):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space"):
        kept.save(path)
    assert path.read_bytes() == b"older"
    assert [file.name for file in tmp_path.iterdir()] == ["frames.tensors"]
