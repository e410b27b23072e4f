"""Tests for poses and masks that are still being written while a live source runs."""

import json
import threading
import time

import cv2
import numpy as np
import pytest

from capture.input_error import InputError
from capture.source import Frame, PacingClock
from preprocess.body.body_pose import Motion
from preprocess.live_inputs import LiveMasks, LivePoses
from preprocess.poses.pose_file import read_motion, write_motion


def moving(rows, **changes) -> Motion:
    """Poses that carry their row in x."""
    places = np.zeros((rows, 3))
    places[:, 0] = np.arange(rows)
    parts = {
        "root_rotations": np.zeros((rows, 3)), "root_translations": places,
        "joint_rotations": np.zeros((rows, 23, 3)), "valid": np.ones(rows, dtype=bool),
        "betas": np.zeros(10), "body_model": "body24",
    }  # fmt: skip
    return Motion(**{**parts, **changes})


def frame(index, *, time_s=0.0, name=None):
    rgb = np.zeros((6, 4, 3), np.uint8)
    return Frame(index=index, time_s=time_s, rgb=rgb, due_s=time.perf_counter(), name=name)


def poses(path, *, patience_s=0.1, started_at=0.0):
    return LivePoses(
        path, PacingClock(), default_model="body24", first_within_s=0.2, patience_s=patience_s,
        started_at=started_at,
    )  # fmt: skip


def row(pose):
    return int(pose.root_translation[0])


def later(work, after_s=0.1):
    thread = threading.Timer(after_s, work)
    thread.start()
    return thread


def test_frames_wait_for_a_late_pose(tmp_path):
    path = tmp_path / "poses.npz"
    write_motion(path, moving(2))
    growing = poses(path, patience_s=10.0)
    assert [row(growing.wait_for_pose(frame(index))) for index in (0, 1)] == [0, 1]
    thread = later(lambda: write_motion(path, moving(4)))
    assert row(growing.wait_for_pose(frame(3))) == 3
    assert len(growing.motion) == 4
    thread.join()


def test_degrees_are_refused_and_one_bad_pose_is_skipped(tmp_path):
    path, bent = tmp_path / "poses.npz", np.zeros((3, 23, 3))
    bent[:, 4, 0] = 60.0
    write_motion(path, moving(3, joint_rotations=bent))
    with pytest.raises(InputError, match="degrees given"):
        LivePoses(path, PacingClock(), default_model="body24", first_within_s=3600.0)
    bent[:2] = 0.0
    write_motion(path, moving(3, joint_rotations=bent))
    growing = poses(path)
    assert row(growing.wait_for_pose(frame(1))) == 1
    assert growing.wait_for_pose(frame(2)) == "pose invalid"


def test_a_missing_pose_costs_only_its_frame(tmp_path):
    path = tmp_path / "poses.npz"
    write_motion(path, moving(1))
    growing, began = poses(path), time.perf_counter()
    assert growing.wait_for_pose(frame(1)) == "no pose within 0.1 s"
    assert 0.1 <= time.perf_counter() - began < 2.0
    old = Frame(index=2, time_s=0.0, rgb=frame(0).rgb, due_s=time.perf_counter() - 60.0)
    began = time.perf_counter()
    assert growing.wait_for_pose(old) == "no pose within 0.1 s"
    assert time.perf_counter() - began < 0.1  # it has waited long enough elsewhere


@pytest.mark.parametrize(
    ("keys", "index", "expected"),
    [({"frames": np.array([4, 6])}, 6, 1), ({"frames": np.array([4, 6])}, 5, "no pose"),
     ({"valid": np.array([True, False])}, 1, "pose invalid")],
)  # fmt: skip
def test_frames_do_not_wait_for_impossible_poses(tmp_path, keys, index, expected):
    write_motion(tmp_path / "poses.npz", moving(2, **keys))
    found = poses(tmp_path / "poses.npz", patience_s=3600.0).wait_for_pose(frame(index))
    assert (found if isinstance(found, str) else row(found)) == expected


@pytest.mark.parametrize("epoch", [0.0, 1.7e9])
def test_poses_belong_to_the_frames_of_their_time(tmp_path, epoch):
    """Times count from the first frame or from 1970, as a tracker's clock does."""
    times = epoch + np.array([0.0, 0.1, 0.3])
    write_motion(tmp_path / "poses.npz", moving(3, times_s=times))
    growing = poses(tmp_path / "poses.npz", started_at=epoch)
    assert row(growing.wait_for_pose(frame(7, time_s=0.105))) == 1
    assert growing.wait_for_pose(frame(8, time_s=0.2)) == "no pose"
    assert growing.wait_for_pose(frame(9, time_s=0.4)) == "no pose within 0.1 s"


def test_a_half_written_file_is_read_at_the_next_poll(tmp_path):
    path = tmp_path / "poses.npz"
    write_motion(path, moving(3))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    thread = later(lambda: path.write_bytes(whole))
    growing = LivePoses(path, PacingClock(), default_model="body24", first_within_s=10.0)
    thread.join()
    assert row(growing.wait_for_pose(frame(2))) == 2
    path.write_bytes(whole[:100])  # the tracker has begun again
    assert row(growing.wait_for_pose(frame(1))) == 1


def test_a_missing_first_pose_is_explained(tmp_path):
    with pytest.raises(InputError, match="There are no poses"):
        poses(tmp_path / "none.npz")
    write_motion(tmp_path / "lost.npz", moving(2, valid=np.zeros(2, dtype=bool)))
    with pytest.raises(InputError, match="first valid pose was expected"):
        poses(tmp_path / "lost.npz")
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"bad\.npz is no readable"):
        poses(tmp_path / "bad.npz")


def test_lines_of_json_hold_the_same_poses(tmp_path):
    lines = [
        {"frame": 3 * i, "global_orient": [0.1, 0.2, i], "body_pose": [0.01 * i] * 69,
         "transl": [i, 0.0, 2.0], "model": "smpl"} for i in range(3)
    ]  # fmt: skip
    path = tmp_path / "poses.jsonl"
    path.write_text("\n".join(map(json.dumps, lines)) + '\n{"frame": 9, "global_or')
    motion = read_motion(path)
    assert motion.body_model == "smpl"
    assert motion.frames.tolist() == [0, 3, 6]
    np.testing.assert_allclose(motion.root_translations[:, 0], [0, 1, 2])
    np.testing.assert_allclose(motion.root_rotations[:, 2], [0, 1, 2])
    np.testing.assert_allclose(motion.joint_rotations[2], 0.02)
    assert row(poses(path).wait_for_pose(frame(6))) == 2


@pytest.mark.parametrize("text", ["", "[1, 2]\n", '{"transl": [0, 0, 0]}\n', "no json\n"])
def test_lines_that_hold_no_poses_are_refused(tmp_path, text):
    (tmp_path / "poses.jsonl").write_text(text)
    with pytest.raises(InputError, match=r"poses\.jsonl"):
        read_motion(tmp_path / "poses.jsonl")


def write_mask(folder, name, *, inverted=False, shape=(6, 4)):
    mask = np.zeros(shape, np.uint8)
    mask[2:4, 1:3] = 200
    data = cv2.imencode(".png", 255 - mask if inverted else mask)[1].tobytes()
    (folder / f"{name}.png").write_bytes(data)
    return data


def masks(folder, *, invert=None, patience_s=0.1):
    return LiveMasks(folder, PacingClock(), invert=invert, patience_s=patience_s)


def test_a_mask_belongs_to_a_frame_by_name_or_number(tmp_path):
    write_mask(tmp_path, "shot_17")
    growing = masks(tmp_path)
    by_name = growing.wait_for_mask(frame(3, name="shot_17"), (4, 6))
    by_number = growing.wait_for_mask(frame(17), (4, 6))
    np.testing.assert_array_equal(by_name, by_number)
    assert by_name[2, 1] == pytest.approx(200 / 255)
    assert by_name[0, 0] == 0.0
    with pytest.raises(InputError, match=r"no mask within 0\.1 s"):
        growing.wait_for_mask(frame(17, name="shot_18"), (4, 6))


def test_frames_wait_for_a_half_written_mask(tmp_path):
    whole = write_mask(tmp_path, "0")
    (tmp_path / "0.png").write_bytes(whole[:40])
    thread = later(lambda: write_mask(tmp_path, "0"))
    assert masks(tmp_path, patience_s=10.0).wait_for_mask(frame(0, name="0"), (4, 6)).max() > 0.7
    thread.join()


def test_live_polarity_is_that_of_most_masks_so_far(tmp_path):
    """An inverted mask is refused at once, even if it came first."""
    for number, inverted in enumerate([True, False, False, False, True]):
        write_mask(tmp_path, str(number), inverted=inverted)
    growing = masks(tmp_path, patience_s=60.0)
    assert growing.wait_for_mask(frame(0, name="0"), (4, 6))[0, 0] == 0.0
    with pytest.raises(InputError, match=r"1\.png is inverted unlike most"):  # one against one
        growing.wait_for_mask(frame(1, name="1"), (4, 6))
    for number in (2, 3):
        assert growing.wait_for_mask(frame(number, name=str(number)), (4, 6))[0, 0] == 0.0
    with pytest.raises(InputError, match=r"4\.png is inverted unlike most"):
        growing.wait_for_mask(frame(4, name="4"), (4, 6))
    said = masks(tmp_path, invert=True)
    assert (
        said.wait_for_mask(frame(1, name="1"), (4, 6))[0, 0] == 1.0
    )  # as was said, whatever it shows


def test_a_mask_of_another_shape_is_refused(tmp_path):
    write_mask(tmp_path, "0", shape=(4, 6))
    with pytest.raises(InputError, match="6x4 px, its image 4x6"):
        masks(tmp_path).wait_for_mask(frame(0, name="0"), (4, 6))
