"""Tests for what transforms.json and others look like when it departs from the documentation."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.cameras.camera_file import read_cameras
from preprocess.cameras.camera_formats import read_named_cameras

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
