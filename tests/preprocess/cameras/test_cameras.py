"""Tests for cameras of other programs, written byte for byte as those programs do."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import FrameSource
from capture.source_opening import open_source
from capture.video_writer import FFV1, write_video
from preprocess.cameras.camera_file import read_cameras
from preprocess.cameras.camera_formats import NamedCamera, read_named_cameras

SIZE = (640, 480)
COUNT = 5


@pytest.fixture
def cameras(rng) -> list[Camera]:
    """A walk round the origin, not level."""
    found = []
    for step in range(COUNT):
        turn = Rotation.from_euler("xyz", [0.1 * step, 0.5 * step, 0.05])
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = turn.as_matrix()
        camera_from_world[:3, 3] = [0.1, -0.2, 3.0 + 0.1 * step]
        lens = {"focal_px": (500.0, 505.0), "center_px": (318.5, 243.0), "size_px": SIZE}
        found.append(Camera(**lens, camera_from_world=camera_from_world))
    return found


@pytest.fixture
def points(rng) -> np.ndarray:
    """Something to look at."""
    return rng.uniform(-0.6, 0.6, (50, 3))


def opengl_pose(camera: Camera) -> np.ndarray:
    """World-from-camera with y up and z back, as OpenGL, ARKit and NeRF say it."""
    pose = np.linalg.inv(camera.camera_from_world)
    return np.column_stack([pose[:, 0], -pose[:, 1], -pose[:, 2], pose[:, 3]])


def assert_seen_as_opengl(found: list[NamedCamera], cameras: list[Camera], points) -> None:
    """Pixels are those of OpenGL's own arithmetic, without ours: x right, y up, z backwards."""
    for each, camera in zip(found, cameras, strict=True):
        wanted = seen(opengl_pose(camera), camera, points)
        np.testing.assert_allclose(each.camera.project(points), wanted, atol=1e-6)


def seen(pose: np.ndarray, camera: Camera, points: np.ndarray) -> np.ndarray:
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    (fx, fy), (cx, cy) = camera.focal_px, camera.center_px
    return np.stack(
        [cx + fx * local[:, 0] / -local[:, 2], cy - fy * local[:, 1] / -local[:, 2]], axis=1
    )


@pytest.fixture
def colmap(tmp_path, cameras):
    """Writes a COLMAP model; returns its folder and the model."""

    def write(kind="OPENCV", params=(500.0, 505.0, 318.5, 243.0, 0.05, -0.01, 0.001, 0.002)):
        model = pycolmap.Reconstruction()
        lens = pycolmap.Camera(model=kind, width=640, height=480, params=params, camera_id=1)
        model.add_camera_with_trivial_rig(lens)
        for number, camera in enumerate(cameras, 1):
            name = f"frames/frame_{number:05d}.png"
            image = pycolmap.Image(name=name, camera_id=1, image_id=number)
            pose = pycolmap.Rigid3d(camera.camera_from_world[:3])
            model.add_image_with_trivial_frame(image, pose)
        folder = tmp_path / "sparse" / "0"
        folder.mkdir(parents=True)
        return folder, model

    return write


def seen_by_colmap(model, number, points) -> np.ndarray:
    local = model.image(number).cam_from_world() * points
    return np.array([model.camera(1).img_from_cam(point) for point in local])


@pytest.mark.parametrize("version", ["4.x", "3.x"])
@pytest.mark.parametrize("kind", ["binary", "text"])
def test_a_colmap_model_sees_what_colmap_sees(colmap, points, kind, version, tmp_path):
    folder, model = colmap()
    model.write_binary(folder) if kind == "binary" else model.write_text(folder)
    if version == "3.x":
        for part in ("rigs", "frames"):
            (folder / f"{part}.{'bin' if kind == 'binary' else 'txt'}").unlink()
    found = read_named_cameras(tmp_path)
    assert [each.name for each in found] == [f"frames/frame_{n:05d}" for n in range(1, COUNT + 1)]
    for number, each in enumerate(found, 1):
        np.testing.assert_allclose(
            each.camera.project(points), seen_by_colmap(model, number, points), atol=1e-6
        )


@pytest.mark.parametrize(
    ("kind", "params"),
    [
        ("SIMPLE_PINHOLE", (500.0, 320.0, 240.0)),
        ("PINHOLE", (500.0, 505.0, 320.0, 240.0)),
        ("SIMPLE_RADIAL", (500.0, 320.0, 240.0, 0.1)),
        ("RADIAL", (500.0, 320.0, 240.0, 0.1, -0.02)),
        ("FULL_OPENCV", (500.0, 505.0, 320.0, 240.0, 0.1, 0.0, 0.0, 0.0, 0.01, 0.02, 0.0, 0.0)),
    ],
)
def test_every_lens_that_opencv_has_is_colmaps(colmap, points, kind, params):
    folder, model = colmap(kind, params)
    model.write_binary(folder)
    camera = read_named_cameras(folder)[0].camera
    np.testing.assert_allclose(camera.project(points), seen_by_colmap(model, 1, points), atol=1e-6)


def test_a_fisheye_is_refused_with_what_to_do(colmap):
    folder, model = colmap("OPENCV_FISHEYE", (500.0, 505.0, 320.0, 240.0, 0.1, 0.0, 0.0, 0.0))
    model.write_binary(folder)
    with pytest.raises(InputError, match=r"OPENCV_FISHEYE.*undistort"):
        read_named_cameras(folder)


LENS = {"w": 640, "h": 480, "fl_x": 500.0, "cx": 318.5, "cy": 243.0}


def transforms(path: Path, cameras: list[Camera], names: list[str], lens=LENS) -> Path:
    """A transforms.json."""
    frames = [
        {"file_path": name, "transform_matrix": opengl_pose(camera).tolist()}
        for name, camera in zip(names, cameras, strict=True)
    ]
    path.write_text(json.dumps({**lens, "frames": frames}))
    return path


def test_transforms_json_is_seen_as_opengl_sees_it(cameras, points, tmp_path):
    turned = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0.5], [0, 0, 0, 1]])
    there = [
        replace(camera, camera_from_world=camera.camera_from_world @ np.linalg.inv(turned))
        for camera in cameras
    ]
    lens = LENS | {"fl_y": 505.0, "camera_model": "OPENCV", "k1": 0.0}
    lens["applied_transform"] = turned[:3].tolist()
    names = [f"images/frame_{n:05d}" for n in range(1, COUNT + 1)]
    files = [f"{name}.png" for name in reversed(names)]
    transforms(tmp_path / "transforms.json", there[::-1], files, lens)
    for path in (tmp_path, tmp_path / "transforms.json"):
        found = read_named_cameras(path)
        assert [each.name for each in found] == names
        assert_seen_as_opengl(found, cameras, points)


def test_a_frame_may_have_a_lens_of_its_own(cameras, tmp_path):
    frame = {"file_path": "a_1.png", "transform_matrix": opengl_pose(cameras[0]).tolist()}
    frame |= {"fl_x": 300.0, "fl_y": 301.0, "cx": 1.0, "cy": 2.0}
    content = {"w": 640, "h": 480, "camera_angle_x": 2 * np.arctan(0.5), "frames": [frame]}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    assert read_named_cameras(tmp_path)[0].camera.focal_px == (300.0, 301.0)


def test_record3d_is_seen_as_arkit_sees_it(cameras, points, tmp_path):
    poses = [
        [*Rotation.from_matrix(opengl_pose(c)[:3, :3]).as_quat(), *opengl_pose(c)[:3, 3]]
        for c in cameras
    ]
    columns = [500.0, 0, 0, 0, 505.0, 0, 318.5, 243.0, 1.0]
    content = {"poses": poses, "K": columns, "w": 640, "h": 480, "fps": 60, "dw": 192, "dh": 256}
    (tmp_path / "metadata").write_text(json.dumps(content))
    with zipfile.ZipFile(tmp_path / "walk.r3d", "w") as archive:
        archive.writestr("metadata", json.dumps(content))
    for path in (tmp_path, tmp_path / "metadata", tmp_path / "walk.r3d"):
        assert_seen_as_opengl(read_named_cameras(path), cameras, points)


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


def test_polycam_is_seen_as_arkit_sees_it(cameras, points, tmp_path):
    folder = tmp_path / "keyframes" / "corrected_cameras"
    folder.mkdir(parents=True)
    for number, camera in enumerate(cameras):
        matrix = opengl_pose(camera)
        numbers = {f"t_{r}{c}": matrix[r, c] for r in range(3) for c in range(4)}
        numbers |= {"fx": 500.0, "fy": 505.0, "cx": 318.5, "cy": 243.0}
        numbers |= {"width": 640, "height": 480, "blur_score": 100.0}
        (folder / f"{98000 + number}.json").write_text(json.dumps(numbers))
    found = read_named_cameras(tmp_path)
    assert [each.name for each in found] == [str(98000 + n) for n in range(COUNT)]
    assert_seen_as_opengl(found, cameras, points)


@pytest.fixture
def folder(tmp_path) -> FrameSource:
    """A folder of seven pictures."""
    (tmp_path / "images").mkdir()
    for number in range(7):
        picture = np.zeros((24, 32, 3), np.uint8)
        cv2.imwrite(str(tmp_path / "images" / f"shot_{number + 3}.png"), picture)
    return open_source(tmp_path / "images")


@pytest.fixture
def video(tmp_path):
    """A video with this number of frames."""

    def make(frames: int) -> FrameSource:
        path = tmp_path / f"{frames}.mp4"
        write_video(path, [np.zeros((24, 32, 3), np.uint8)] * frames, 30.0, FFV1)
        return open_source(path)

    return make


def test_cameras_find_their_pictures_by_name(cameras, folder, tmp_path):
    names = [f"images/shot_{n}.png" for n in (3, 4, 6, 7, 8)]
    path = transforms(tmp_path / "transforms.json", cameras, names)
    track = read_cameras(path, SIZE, folder)
    assert len(track.cameras) == 7
    assert track.frames_without_camera == {6}
    for frame, camera in zip((0, 1, 3, 4, 5), cameras, strict=True):
        np.testing.assert_allclose(track[frame].camera_from_world, camera.camera_from_world)
    assert "5 have a camera" in (track.note or "")
    assert "1 were interpolated, 1 are left out" in (track.note or "")


def test_a_camera_between_two_stands_and_turns_half_way(cameras, folder, tmp_path):
    two = [cameras[0], cameras[2]]
    path = transforms(tmp_path / "transforms.json", two, ["shot_3.png", "shot_5.png"])
    between = read_cameras(path, SIZE, folder)[1]
    middle = 0.5 * (two[0].center_world + two[1].center_world)
    np.testing.assert_allclose(between.center_world, middle)
    turns = [Rotation.from_matrix(c.camera_from_world[:3, :3]) for c in (*two, between)]
    halves = [(turns[2] * turns[0].inv()).magnitude(), (turns[1] * turns[2].inv()).magnitude()]
    assert halves[0] == pytest.approx(halves[1])
    assert sum(halves) == pytest.approx((turns[1] * turns[0].inv()).magnitude())


def test_numbers_in_names_count_a_videos_frames(cameras, video, tmp_path):
    names = [f"frame_{n:05d}.png" for n in (1, 3, 4, 8, 9)]
    path = transforms(tmp_path / "transforms.json", cameras, names)
    track = read_cameras(path, SIZE, video(10))
    for frame, camera in zip((0, 2, 3, 7, 8), cameras, strict=True):
        np.testing.assert_allclose(track[frame].camera_from_world, camera.camera_from_world)


def test_consecutive_numbers_of_a_few_frames_say_nothing_about_a_longer_video(
    cameras, video, tmp_path
):
    names = [f"frame_{n:05d}.png" for n in range(1, 6)]
    path = transforms(tmp_path / "transforms.json", cameras, names)
    with pytest.raises(InputError, match=r"5 cameras.*40 frames"):
        read_cameras(path, SIZE, video(40))
    assert len(read_cameras(path, SIZE, video(5)).cameras) == 5


def test_an_angle_of_view_alone_is_enough_where_the_pictures_are_known(cameras, tmp_path):
    angle = {"camera_angle_x": 2 * np.arctan(0.5)}
    transforms(tmp_path / "transforms_train.json", cameras[:1], ["./train/r_0"], angle)
    for path in (tmp_path, tmp_path / "transforms_train.json"):
        camera = read_cameras(path, (80, 60))[0]
        assert camera.focal_px == pytest.approx((80.0, 80.0))
        assert (camera.center_px, camera.size_px) == ((40.0, 30.0), (80, 60))
    with pytest.raises(InputError, match=r"transforms_train\.json"):
        read_named_cameras(tmp_path)


@pytest.mark.parametrize(("size", "focal"), [((80, 60), 90.0), ((40, 30), 45.0)])
def test_a_principal_point_in_the_middle_tells_the_size_that_is_not_stated(
    cameras, tmp_path, size, focal
):
    lens = {"fl_x": 90.0, "cx": 40.0, "cy": 30.0}
    path = transforms(tmp_path / "transforms.json", cameras[:1], ["0.png"], lens)
    camera = read_cameras(path, size)[0]
    assert camera.focal_px == (focal, focal)
    assert camera.center_px == (size[0] / 2, size[1] / 2)


@pytest.mark.parametrize("said", [{"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}])
def test_a_fisheye_is_never_read_as_another_lens(cameras, tmp_path, said):
    lens = LENS | {"k1": 0.1}
    path = transforms(tmp_path / "transforms.json", cameras[:1], ["0.png"], lens | said)
    with pytest.raises(InputError, match=r"(?i)fisheye.*Undistort"):
        read_named_cameras(path)
    path = transforms(path, cameras[:1], ["0.png"], lens | {"is_fisheye": False})
    assert read_named_cameras(path)[0].camera.distortion[0] == 0.1


def test_images_of_one_name_in_several_folders_are_refused(cameras, folder, tmp_path):
    names = [f"images\\{side}\\shot_{n}.png" for side in ("left", "right") for n in (3, 4)]
    path = transforms(tmp_path / "transforms.json", cameras[:4], names)
    with pytest.raises(InputError, match="pictures of one name"):
        read_cameras(path, SIZE, folder)


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"frames": []}',
        '{"frames": [{"file_path": "a", "transform_matrix": [[1]]}], "w": 1}',
        '{"frames": [{"transform_matrix": 3}]}',
        '{"poses": [[0, 0, 0, 0, 1, 1, 1]], "K": [1,0,0,0,1,0,0,0,1], "w": 4, "h": 4}',
        '{"poses": "x", "K": 1, "w": 4, "h": 4}',
    ],
)
def test_strange_json_is_refused_by_name(content, tmp_path):
    (tmp_path / "transforms.json").write_text(content)
    with pytest.raises(InputError, match=r"transforms\.json"):
        read_named_cameras(tmp_path / "transforms.json")


def test_counts_that_a_damaged_colmap_model_claims_are_not_believed(colmap):
    folder, model = colmap()
    model.write_binary(folder)
    huge = (1 << 60).to_bytes(8, "little")
    for part in ("points3D", "frames", "rigs"):  # are not read at all
        (folder / f"{part}.bin").write_bytes(huge)
    assert len(read_named_cameras(folder)) == COUNT
    whole = (folder / "images.bin").read_bytes()
    name_ends = whole.find(b"\0", 8 + 64)
    for damaged in (huge + whole[8:], whole[: name_ends + 1] + huge + whole[name_ends + 9 :]):
        (folder / "images.bin").write_bytes(damaged)
        with pytest.raises(InputError, match="COLMAP"):
            read_named_cameras(folder)
    (folder / "images.bin").write_bytes(whole)
    (folder / "cameras.bin").write_bytes(huge)
    with pytest.raises(InputError, match="COLMAP"):
        read_named_cameras(folder)
