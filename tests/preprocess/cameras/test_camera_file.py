"""Camera files: one or many, scaled or refused; files as their programs write them."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.cameras.camera_file import assume_static_camera, read_cameras
from preprocess.cameras.camera_formats import read_named_cameras

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


POSES = [np.diag([1.0, 1, 1, 1]) + np.outer([0, 0, 1, 0], [0, 0, 0, n]) for n in range(3)]


def written(path: Path, content: dict, names: str = "./train/r_{}") -> Path:
    frames = [
        {"file_path": names.format(n), "transform_matrix": pose.tolist()}
        for n, pose in enumerate(POSES)
    ]
    path.write_text(json.dumps({**content, "frames": frames}))
    return path


def test_an_angle_of_view_alone_is_enough_where_the_pictures_are_known(tmp_path):
    written(tmp_path / "transforms_train.json", {"camera_angle_x": 2 * np.arctan(0.5)})
    for path in (tmp_path, tmp_path / "transforms_train.json"):
        camera = read_cameras(path, (80, 60))[0]
        assert camera.focal_px == pytest.approx((80.0, 80.0))
        assert (camera.center_px, camera.size_px) == ((40.0, 30.0), (80, 60))
    with pytest.raises(InputError, match=r"transforms_train\.json"):
        read_named_cameras(tmp_path)


@pytest.mark.parametrize(("size", "focal"), [((80, 60), 90.0), ((40, 30), 45.0)])
def test_a_principal_point_in_the_middle_tells_the_size_that_is_not_stated(tmp_path, size, focal):
    path = written(tmp_path / "transforms.json", {"fl_x": 90.0, "cx": 40.0, "cy": 30.0})
    camera = read_cameras(path, size)[0]
    assert camera.focal_px == (focal, focal)
    assert camera.center_px == (size[0] / 2, size[1] / 2)


@pytest.mark.parametrize("said", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}])
def test_a_fisheye_is_never_read_as_another_lens(tmp_path, said):
    lens = {"w": 80, "h": 60, "fl_x": 90.0, "k1": 0.1}
    path = written(tmp_path / "transforms.json", {**lens, **said})
    with pytest.raises(InputError, match=r"(?i)fisheye.*Undistort"):
        read_named_cameras(path)
    path = written(tmp_path / "transforms.json", {**lens, "is_fisheye": False})
    assert read_named_cameras(path)[0].camera.distortion[0] == 0.1


def test_images_of_one_name_in_several_folders_are_refused(tmp_path):
    content = {"w": 80, "h": 60, "fl_x": 90.0}
    both = [
        {"file_path": f"images\\{side}\\{n}.png", "transform_matrix": pose.tolist()}
        for side in ("left", "right")
        for n, pose in enumerate(POSES)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({**content, "frames": both}))
    for n in range(3):
        cv2.imwrite(str(tmp_path / f"{n}.png"), np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(InputError, match="pictures of one name"):
        read_cameras(tmp_path / "transforms.json", (80, 60), open_source(tmp_path))


def test_record3d_has_a_focal_length_for_each_frame(tmp_path):
    content = {
        "poses": [[0, 0, 0, 1, 0, 0, 0]] * 3, "K": [50, 0, 0, 0, 50, 0, 40, 30, 1], "w": 80,
        "h": 60, "perFrameIntrinsicCoeffs": [[50 + n, 50 + n, 40, 31] for n in range(3)],
    }  # fmt: skip
    path = tmp_path / "metadata"
    path.write_text(json.dumps(content))
    assert [each.camera.focal_px[0] for each in read_named_cameras(path)] == [50.0, 51.0, 52.0]
    assert read_named_cameras(path)[0].camera.center_px == (40.0, 31.0)
    for broken in ([[1, 2]] * 3, "x", [[0, 0, 0, 0]] * 3, None):
        path.write_text(json.dumps({**content, "perFrameIntrinsicCoeffs": broken}))
        assert {each.camera.focal_px for each in read_named_cameras(path)} == {(50.0, 50.0)}
