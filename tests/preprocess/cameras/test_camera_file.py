"""Camera files: one or many, scaled or refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.input_error import InputError
from preprocess.cameras.camera_file import assume_static_camera, read_cameras

SIZE = (640, 480)
INTRINSIC = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])


def placed(seed: int) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    transform[:3, 3] = seed
    return transform


@pytest.fixture
def write(tmp_path):
    def write(**changes):
        size = {"height": np.array(480), "width": np.array(640)}
        arrays = {"intrinsic": INTRINSIC, "extrinsic": placed(1), **size, **changes}
        path = tmp_path / "cameras.npz"
        np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
        return path

    return write


def test_one_camera_serves_all_frames(write):
    path = write()
    assert read_cameras(path.parent, SIZE).source == read_cameras(path, SIZE).source
    track = read_cameras(path, SIZE)
    assert not track.is_moving
    assert track.note is None
    np.testing.assert_array_equal(track[99].intrinsic, INTRINSIC)
    np.testing.assert_array_equal(track[99].camera_from_world, placed(1))
    assert track[0].size_px == SIZE


def test_many_cameras_serve_a_frame_each(write):
    extrinsics = np.stack([placed(i) for i in range(5)])
    track = read_cameras(write(extrinsic=extrinsics), SIZE)
    assert track.is_moving
    for row in range(5):
        np.testing.assert_array_equal(track[row].camera_from_world, extrinsics[row])
        np.testing.assert_array_equal(track[row].intrinsic, INTRINSIC)


def test_a_camera_of_another_size_is_scaled_with_a_note(write):
    track = read_cameras(write(), (320, 240))
    np.testing.assert_allclose(track[0].intrinsic[:2], INTRINSIC[:2] / 2)
    assert "640x480" in track.note
    assert "320x240" in track.note


def test_missing_parts_have_a_meaning(write):
    track = read_cameras(write(extrinsic=None, height=None, width=None), SIZE)
    np.testing.assert_array_equal(track[0].camera_from_world, np.eye(4))
    assert track[0].size_px == SIZE
    three_rows = read_cameras(write(extrinsic=placed(2)[:3]), SIZE)
    np.testing.assert_array_equal(three_rows[0].camera_from_world, placed(2))


def test_distortion_comes_along_where_there_is_any(write):
    bent = read_cameras(write(distortion=np.array([[0.1, 0.0, 0.0, 0.0]])), SIZE)
    assert bent[0].distortion == (0.1, 0.0, 0.0, 0.0)
    assert read_cameras(write(distortion=np.zeros(5)), SIZE)[0].distortion == ()


@pytest.mark.parametrize(
    "changes",
    [
        {"width": np.array(480), "height": np.array(640)},
        {"intrinsic": None},
        {"intrinsic": np.eye(4)},
        {"intrinsic": -INTRINSIC},
        {"intrinsic": np.full((3, 3), np.nan)},
        {"extrinsic": 2 * np.eye(4)},
        {"extrinsic": np.diag([1.0, 1.0, -1.0, 1.0])},
        {"intrinsic": np.stack([INTRINSIC] * 2), "extrinsic": np.stack([np.eye(4)] * 3)},
        {"extrinsic": np.stack([np.eye(4)] * 3), "valid": np.ones(2)},
        {"distortion": np.zeros(3)},
        {"width": np.array("wide")},
    ],
)
def test_what_is_no_camera_is_refused(write, changes):
    with pytest.raises(InputError, match=r"cameras\.npz"):
        read_cameras(write(**changes), SIZE)


def test_without_frames_cameras_have_the_size_that_the_file_states(write):
    assert read_cameras(write(), None)[0].size_px == SIZE
    assert read_cameras(write(width=None), None)[0].size_px == SIZE  # twice the principal point


def test_other_formats_are_refused_by_name(tmp_path):
    with pytest.raises(InputError, match=r"COLMAP.*transforms\.json"):
        read_cameras(tmp_path, SIZE)
    with pytest.raises(InputError, match="does not exist"):
        read_cameras(tmp_path / "cameras.npz", SIZE)


def test_without_cameras_the_trackers_matrix_counts_else_a_phones(motion):
    assumed = assume_static_camera(motion, SIZE)
    np.testing.assert_allclose(assumed[3].intrinsic, [[544, 0, 320], [0, 544, 240], [0, 0, 1]])
    assert "544 px" in assumed.note
    tracked = assume_static_camera(replace(motion, intrinsic=INTRINSIC), SIZE)
    np.testing.assert_array_equal(tracked[0].intrinsic, INTRINSIC)
    assert tracked.source == "K of the poses"
    assert tracked.note is None
