"""Camera files: one or many, scaled or refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.errors import BadInput
from preprocess.camera_file import default_cameras, read_cameras, upright_cameras

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
        arrays = {
            "intrinsic": INTRINSIC,
            "extrinsic": placed(1),
            "height": np.array(480),
            "width": np.array(640),
            **changes,
        }
        path = tmp_path / "cameras.npz"
        np.savez(path, **{key: value for key, value in arrays.items() if value is not None})
        return path

    return write


def test_one_camera_serves_all_frames(write):
    track = read_cameras(write(), SIZE)
    assert not track.moves
    assert track.note is None
    np.testing.assert_array_equal(track[99].intrinsic, INTRINSIC)
    np.testing.assert_array_equal(track[99].camera_from_world, placed(1))
    assert track[0].size_px == SIZE


def test_many_cameras_serve_a_frame_each(write):
    extrinsics = np.stack([placed(i) for i in range(5)])
    track = read_cameras(write(extrinsic=extrinsics), SIZE)
    assert track.moves
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
    ("changes", "message"),
    [
        ({"width": np.array(480), "height": np.array(640)}, "480x640 px, the video has 640x480"),
        ({"intrinsic": None}, "expected intrinsic"),
        ({"intrinsic": np.eye(4)}, "3x3"),
        ({"intrinsic": -INTRINSIC}, "focal"),
        ({"intrinsic": np.full((3, 3), np.nan)}, "finite"),
        ({"extrinsic": 2 * np.eye(4)}, "rigid"),
        ({"extrinsic": np.diag([1.0, 1.0, -1.0, 1.0])}, "rigid"),
        ({"intrinsic": np.stack([INTRINSIC] * 2), "extrinsic": np.stack([np.eye(4)] * 3)}, "2 in"),
        ({"distortion": np.zeros(3)}, "`distortion`"),
        ({"width": np.array("wide")}, "pixels"),
    ],
)
def test_what_is_no_camera_is_refused(write, changes, message):
    with pytest.raises(BadInput, match=message):
        read_cameras(write(**changes), SIZE)


def test_other_formats_are_refused_by_name(tmp_path):
    with pytest.raises(BadInput, match=r"COLMAP.*transforms\.json"):
        read_cameras(tmp_path, SIZE)
    with pytest.raises(BadInput, match="does not exist"):
        read_cameras(tmp_path / "cameras.npz", SIZE)


def test_without_cameras_the_trackers_matrix_counts_else_a_phones(motion):
    assumed = default_cameras(motion, SIZE)
    np.testing.assert_allclose(assumed[3].intrinsic, [[544, 0, 320], [0, 544, 240], [0, 0, 1]])
    assert "544 px" in assumed.note
    tracked = default_cameras(replace(motion, intrinsic=INTRINSIC), SIZE)
    np.testing.assert_array_equal(tracked[0].intrinsic, INTRINSIC)
    assert tracked.source == "K of the poses"
    assert tracked.note is None


def test_cameras_of_a_turned_video_turn_with_it(tmp_path):
    intrinsic = np.array([[900.0, 0, 630], [0, 910, 350], [0, 0, 1]])
    np.savez(tmp_path / "c.npz", intrinsic=intrinsic, width=1280, height=720)
    lying = read_cameras(tmp_path / "c.npz", (1280, 720)).cameras[0]
    track = upright_cameras(tmp_path / "c.npz", (720, 1280), 3)
    point = np.array([0.2, -0.4, 3.0])
    x, y = lying.project(point)
    np.testing.assert_allclose(track.cameras[0].project(point), [720 - y, x])  # by the clock
    assert "turned with the video" in track.note
    upright = upright_cameras(tmp_path / "c.npz", (1280, 720), 0)
    np.testing.assert_array_equal(upright.cameras[0].intrinsic, lying.intrinsic)
    with pytest.raises(BadInput, match="720x1280"):
        upright_cameras(tmp_path / "c.npz", (720, 1280), 2)


def test_cameras_that_were_made_for_upright_pictures_stay(tmp_path):
    intrinsic = np.array([[900.0, 0, 350], [0, 910, 630], [0, 0, 1]])
    np.savez(tmp_path / "c.npz", intrinsic=intrinsic, width=720, height=1280)
    track = upright_cameras(tmp_path / "c.npz", (720, 1280), 3)
    np.testing.assert_array_equal(track.cameras[0].intrinsic, intrinsic)
    assert track.note is None
