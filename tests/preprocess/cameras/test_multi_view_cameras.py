"""Tests for studios' cameras, written by OpenCV's own writer as EasyMocap does, and ZJU-MoCap's."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.cameras.camera_file import read_cameras
from preprocess.cameras.camera_formats import (
    find_multi_view_cameras,
    read_multi_view_camera,
)

NAMES, SIZE = ("01", "02", "B3"), (64, 48)
BENDS = np.array([[0.1, -0.02, 0.001, 0.002, 0.003]])


@pytest.fixture
def cameras() -> dict[str, Camera]:
    """Three that look at one place from three sides."""
    found = {}
    for number, name in enumerate(NAMES):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("xyz", [1.6, 0.2, 0.9 * number]).as_matrix()
        pose[:3, 3] = [0.1 * number, -0.2, 3.0]
        found[name] = Camera(
            focal_px=(50.0 + number, 51.0), center_px=(32.5, 23.0), size_px=SIZE,
            camera_from_world=pose, distortion=tuple(BENDS[0]),
        )  # fmt: skip
    return found


@pytest.fixture
def studio(tmp_path, cameras) -> Path:
    """EasyMocap's folder: a folder of pictures for each camera, and two files."""
    intri = cv2.FileStorage(str(tmp_path / "intri.yml"), cv2.FileStorage_WRITE)
    extri = cv2.FileStorage(str(tmp_path / "extri.yml"), cv2.FileStorage_WRITE)
    for file in (intri, extri):
        file.startWriteStruct("names", cv2.FileNode_SEQ)
        for name in NAMES:
            file.write("", name)
        file.endWriteStruct()
    for name, camera in cameras.items():
        intri.write(f"K_{name}", camera.intrinsic)
        intri.write(f"dist_{name}", BENDS)
        turn = camera.camera_from_world[:3, :3]
        extri.write(f"R_{name}", cv2.Rodrigues(turn)[0])
        if name != "02":  # older files have the vector alone
            extri.write(f"Rot_{name}", turn)
        extri.write(f"T_{name}", camera.camera_from_world[:3, 3:])
        (tmp_path / "images" / name).mkdir(parents=True)
        for frame in range(3):
            picture = tmp_path / "images" / name / f"{frame:06d}.jpg"
            cv2.imwrite(str(picture), np.zeros((48, 64, 3), np.uint8))
    intri.release()
    extri.release()
    return tmp_path


def same(found: Camera, wanted: Camera) -> bool:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    return bool(np.allclose(found.project(points), wanted.project(points), atol=1e-9))


@pytest.mark.parametrize("name", NAMES)
def test_a_folder_of_pictures_takes_the_camera_that_it_is_named_like(studio, cameras, name):
    source = open_source(studio / "images" / name)
    for given_as in (studio, studio / "intri.yml", studio / "extri.yml"):
        track = read_cameras(given_as, SIZE, source)
        assert not track.is_moving
        assert track[0].size_px == SIZE
        assert same(track[0], cameras[name])


def test_a_video_of_another_name_is_refused_with_the_camera_names(studio):
    with pytest.raises(InputError, match=r"3 cameras \(01, 02, B3\).*named like none.*Name"):
        read_multi_view_camera(studio, studio / "dance.mp4", SIZE)


def test_one_camera_alone_needs_no_name(studio, cameras):
    for file in ("intri.yml", "extri.yml"):
        text = (studio / file).read_text()
        for name in NAMES[1:]:
            text = text.replace(f"_{name}:", f"_{name}x:")
        (studio / file).write_text(text.replace("K_02x", "k_").replace("K_B3x", "k_"))
    assert same(read_multi_view_camera(studio, None, SIZE), cameras["01"])


def test_zju_mocap_speaks_in_millimetres_and_names_cameras_by_folders(tmp_path, cameras):
    path = tmp_path / "annots.npy"
    content = {
        "cams": {
            "K": [c.intrinsic.tolist() for c in cameras.values()],
            "D": [BENDS.T for _ in cameras],
            "R": [c.camera_from_world[:3, :3] for c in cameras.values()],
            "T": [1000.0 * c.camera_from_world[:3, 3:] for c in cameras.values()],
        },
        "ims": [{"ims": [f"Camera_{name}/000000.jpg" for name in cameras]}],
    }
    np.save(path, np.array(content, dtype=object), allow_pickle=True)
    assert find_multi_view_cameras(tmp_path) == path
    for name, camera in cameras.items():
        assert same(read_multi_view_camera(path, tmp_path / f"Camera_{name}", SIZE), camera)


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("intri.yml", "rows: 3", "rows: 7"),
        ("intri.yml", "51", "x51"),
        ("extri.yml", "T_", "S_"),
        ("extri.yml", "Rot_01: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ ",
         "Rot_01: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 7"),
    ],
)  # fmt: skip
def test_errors_in_a_camera_file_are_reported(studio, file, old, new):
    text = (studio / file).read_text()
    assert old in text
    (studio / file).write_text(text.replace(old, new))
    with pytest.raises(InputError, match="EasyMocap"):
        read_multi_view_camera(studio, studio / "images" / "01", SIZE)
