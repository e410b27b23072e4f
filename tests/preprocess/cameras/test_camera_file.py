"""Camera files: one or many, scaled or refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from capture.input_error import InputError
from capture.source import FrameSource
from capture.source_opening import open_source
from preprocess.cameras.camera_file import assume_static_camera, read_cameras
from preprocess.cameras.camera_orientation import read_upright_cameras

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


STORED_PX, TURNS = (128, 72), {1: 0, 3: 2, 6: 3, 8: 1}
LYING = np.array([[90.0, 0, 63.0], [0, 91.0, 35.0], [0, 0, 1]])
"""K of the pictures as they are stored."""


@pytest.fixture(params=[6, 8])
def turned(request, tmp_path) -> FrameSource:
    """Pictures that are stored lying, with EXIF's word that they stand."""
    (tmp_path / "images").mkdir()
    exif = Image.Exif()
    exif[0x0112] = request.param
    for number in range(3):
        lying = Image.new("RGB", STORED_PX)
        lying.save(tmp_path / "images" / f"{number}.jpg", exif=exif)
    source = open_source(tmp_path / "images")
    assert source.size_px == STORED_PX[::-1]
    assert source.quarter_turns == TURNS[request.param]
    return source


def shown_at(x: float, y: float, source: FrameSource) -> list[float]:
    """Where a point of the stored picture is once it was turned."""
    return [STORED_PX[1] - y, x] if source.quarter_turns == 3 else [y, STORED_PX[0] - x]


POINT = np.array([0.2, -0.4, 3.0])


@pytest.mark.parametrize("size", [dict(zip(("width", "height"), STORED_PX, strict=True)), {}])
def test_cameras_of_stored_pictures_turn_with_them(turned, tmp_path, size):
    """Also where only the principal point tells that they lie."""
    np.savez(tmp_path / "c.npz", intrinsic=LYING, extrinsic=np.eye(4), **size)
    track = read_upright_cameras(tmp_path / "c.npz", turned)
    x, y = read_cameras(tmp_path / "c.npz", STORED_PX).cameras[0].project(POINT)
    np.testing.assert_allclose(track.cameras[0].project(POINT), shown_at(x, y, turned))
    assert track.cameras[0].size_px == turned.size_px
    assert "turned with the images" in track.note


@pytest.mark.parametrize("size", [dict(zip(("height", "width"), STORED_PX, strict=True)), {}])
def test_cameras_of_shown_pictures_stay(turned, tmp_path, size):
    standing = np.array([[91.0, 0, 35.0], [0, 90.0, 63.0], [0, 0, 1]])
    np.savez(tmp_path / "c.npz", intrinsic=standing, **size)
    track = read_upright_cameras(tmp_path / "c.npz", turned)
    np.testing.assert_array_equal(track.cameras[0].intrinsic, standing)
    assert track.note is None


def test_a_moving_camera_of_stored_pictures_turns_with_each(turned, tmp_path):
    """As COLMAP and others leave it, who do not turn pictures by their EXIF tags."""
    lenses = {"w": 128, "h": 72, "fl_x": 90.0, "fl_y": 91.0, "cx": 63.0, "cy": 35.0}
    poses = [placed(seed) for seed in range(3)]
    frames = [
        {"file_path": f"images/{number}.jpg", "transform_matrix": pose.tolist()}
        for number, pose in enumerate(poses)
    ]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**lenses, "frames": frames}))
    track, lying = read_upright_cameras(path, turned), read_cameras(path, STORED_PX, turned)
    for upright, stored in zip(track.cameras, lying.cameras, strict=True):
        np.testing.assert_allclose(upright.center_world, stored.center_world, atol=1e-9)
        there = stored.center_world + stored.ray_directions(np.array([100.0, 20.0]))
        np.testing.assert_allclose(upright.project(there), shown_at(100.0, 20.0, turned))


@pytest.mark.parametrize("program", ["colmap", "other"])
def test_of_photographs_upside_down_colmaps_cameras_are_those_of_the_stored(tmp_path, program):
    exif = Image.Exif()
    exif[0x0112] = 3
    (tmp_path / "images").mkdir()
    Image.new("RGB", STORED_PX).save(tmp_path / "images" / "0.jpg", exif=exif)
    source = open_source(tmp_path / "images")
    assert (source.size_px, source.quarter_turns) == (STORED_PX, 2)
    np.savez(tmp_path / "c.npz", intrinsic=LYING, width=128, height=72)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 128 72 90 91 63 35\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 0.jpg\n\n")
    path = tmp_path if program == "colmap" else tmp_path / "c.npz"
    camera = read_upright_cameras(path, source)[0]
    x, y = read_cameras(tmp_path / "c.npz", STORED_PX)[0].project(POINT)
    wanted = [128 - x, 72 - y] if program == "colmap" else [x, y]
    np.testing.assert_allclose(camera.project(POINT), wanted)
