"""Camera files of other programs, recognised by their content: one reader a format.

A reader returns cameras by the names of their images; `preprocess.frame_association` finds the
frame of each.

COLMAP's models, 3.x and 4.x, binary and text, without points. They are read here, not by pycolmap:
it believes the counts that a damaged file claims, reads beyond the end for minutes and fills the
memory; and a model's cameras need no extra installation. (github.com/colmap/colmap,
doc/format.rst.)

nerfstudio and instant-ngp, Record3D and Polycam: world-from-camera with OpenGL's camera axes, y up,
z back.

A studio's cameras, several that stand still, of which the video's name says which is its own.
EasyMocap: `intri.yml` (K_01, dist_01, …) and `extri.yml` (Rot_01 or, as a rotation vector, R_01;
T_01) in OpenCV's YAML, camera-from-world, metres. ZJU-MoCap: `annots.npy` {cams: {K, D, R, T in
mm}, ims: [{ims: [Camera_B1/000000.jpg, …]}]}. (github.com/zju3dv/EasyMocap,
easymocap/mytools/camera_utils.py; github.com/zju3dv/neuralbody.)
"""

import json
import math
import re
import struct
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, final

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.camera import Camera, Transform
from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from preprocess.body.kinematics import rigid_transform
from preprocess.file_content import explain_damage, read_untrusted_file

CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12,
}  # fmt: skip
"""Number of parameters of COLMAP's camera models, in the order of their numbers."""
DISTORTION_START = {"SIMPLE_RADIAL": 3, "RADIAL": 3, "OPENCV": 4, "FULL_OPENCV": 4}
"""First of OpenCV's distortion coefficients among the parameters, of the models that have some."""
Lens = tuple[str, tuple[int, int], list[float]]
"""A camera model's name, width and height, and its parameters."""
ImageRow = tuple[str, str, list[float]]
"""An image's name, its camera's number, and its camera-from-world: qw qx qy qz tx ty tz."""
INTRINSICS = "intri.yml"
"""EasyMocap's file of camera matrices and distortions."""
EXTRINSICS = "extri.yml"
"""EasyMocap's file of rotations and translations."""
ZJU = "annots.npy"
"""ZJU-MoCap's file of all cameras."""
OPENCV_MATRIX_PATTERN = re.compile(
    r"^(\w+):\s*!!opencv-matrix\s+rows:\s*(\d+)\s+cols:\s*(\d+)\s+dt:\s*\w+\s+data:\s*\[([^\]]*)\]",
    re.MULTILINE,
)
"""A matrix in OpenCV's YAML. OpenCV's own reader writes beyond its memory on damaged files."""
EASYMOCAP_KEYS = (
    ("K", "K"), ("R", "R"), ("R", "Rot"), ("T", "T"), ("D", "D"), ("D", "dist"), ("W", "W"),
    ("H", "H"),
)  # fmt: skip
"""A camera's parts and their prefixes in EasyMocap's files; the last that is there counts."""
StudioCamera = Mapping[str, Float[np.ndarray, "rows columns"]]
"""K, R, T, and perhaps D (distortion), W and H, by these names."""
READABLE_FORMATS = (
    "an .npz (intrinsic, extrinsic, height, width), a COLMAP model (the folder of cameras.bin and "
    "images.bin, or .txt), a transforms.json of nerfstudio or instant-ngp, Record3D's .r3d or its "
    "metadata, Polycam's folder, EasyMocap's intri.yml and extri.yml, or ZJU-MoCap's annots.npy"
)
"""List of the formats, for messages."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: y up and z back become y down and z forward."""
MAX_IMAGE_SIDE_PX = 16_384
"""Longest side of an image."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NamedCamera:
    """One image's camera, of the image's own size.

    `name` is that of the image's file, with its folders if the source has them and without its
    ending; None where there is only an order.
    """

    name: str | None
    camera: Camera


def image_name(stored: str) -> str:
    """An image's path in another program's file, of any system, without its ending."""
    path = PurePosixPath(stored.replace("\\", "/"))
    return str(path.with_suffix("")) if path.name else ""


def invert_rigid(transform: Transform) -> Transform:
    """The inverse of a rotation and shift."""
    return rigid_transform(transform[:3, :3].T, -transform[:3, :3].T @ transform[:3, 3])


def camera_from_opengl(world_from_camera: Transform) -> Transform:
    """OpenCV's camera-from-world of a world-from-camera matrix with OpenGL's camera axes."""
    return OPENCV_FROM_OPENGL @ invert_rigid(world_from_camera)


def checked_rigid(numbers: object) -> Float[np.ndarray, "*batch 4 4"]:
    """One or many 3x4 or 4x4 matrices as rigid transforms; a ValueError if they are none."""
    found = np.array(numbers, dtype=np.float64)
    if found.ndim < 2 or found.shape[-2:] not in ((3, 4), (4, 4)) or not np.isfinite(found).all():
        raise ValueError(f"expected finite 4x4 matrices, found the shape {found.shape}")
    turn = found[..., :3, :3]
    is_rigid = np.abs(turn).max(initial=0.0) < 2.0  # larger numbers might overflow below
    if is_rigid:
        off = np.abs(turn @ np.swapaxes(turn, -1, -2) - np.eye(3)).max(initial=0.0)
        is_rigid = off < 1e-3 and (np.linalg.det(turn) > 0.0).all()
    if not is_rigid:
        raise ValueError("a camera's matrix is not rigid (a rotation and a shift, no scale)")
    return rigid_transform(turn, found[..., :3, 3])


def checked_camera(
    focal_px: object,
    center_px: object,
    size_px: object,
    camera_from_world: object,
    distortion: object = (),
) -> Camera:
    """A camera of numbers that may be anything, as in `Camera`; an error if they are none."""
    focal, center, size, coefficients = (
        np.array(numbers, dtype=np.float64)
        for numbers in (focal_px, center_px, size_px, distortion)
    )
    if not all(np.isfinite(numbers).all() for numbers in (focal, center, size, coefficients)):
        raise ValueError("a camera's numbers are not finite")
    if focal.min() <= 0.0 or size.min() < 1.0 or size.max() > MAX_IMAGE_SIDE_PX:
        raise ValueError(
            f"focal lengths {focal.tolist()} or image size {size.tolist()} are none; expected "
            f"positive pixels, at most {MAX_IMAGE_SIDE_PX} a side"
        )
    return Camera(
        focal_px=(float(focal[0]), float(focal[1])),
        center_px=(float(center[0]), float(center[1])),
        size_px=(round(size[0]), round(size[1])),
        camera_from_world=checked_rigid(camera_from_world),
        distortion=tuple(coefficients.tolist()) if coefficients.any() else (),
    )


def read_named_cameras(path: Path, size_px: tuple[int, int] | None = None) -> list[NamedCamera]:
    """Read the cameras of a file or a folder.

    `size_px` is the images' width and height, for files that do not state them.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; expected {READABLE_FORMATS}.")
    folder = path if path.is_dir() else path.parent
    is_model_file = path.suffix.lower() in (".bin", ".txt") and find_colmap_model(folder)
    cameras = None
    if path.is_dir() or is_model_file:
        cameras = _read_folder(folder, size_px)
    elif path.suffix.lower() == ".r3d":
        cameras = read_r3d(path)
    elif path.suffix.lower() == ".json" or path.name == "metadata":
        cameras = read_json_cameras(path, size_px)
    if not cameras:
        raise InputError(f"{path} holds no cameras that are known; expected {READABLE_FORMATS}.")
    return cameras


def _read_folder(folder: Path, size_px: tuple[int, int] | None) -> list[NamedCamera] | None:
    model = find_colmap_model(folder)
    if model is not None:
        return read_colmap_model(model)
    for name in ("transforms.json", "transforms_train.json", "metadata", "metadata.json"):
        if (folder / name).is_file():
            return read_json_cameras(folder / name, size_px)
    polycam = find_polycam(folder)
    return None if polycam is None else read_polycam(polycam)


def find_colmap_model(folder: Path) -> Path | None:
    """The folder in which a COLMAP model lies, if there is one."""
    for place in (".", "sparse/0", "0", "sparse", "colmap/sparse/0", "dense/sparse"):
        for ending in (".bin", ".txt"):
            found = folder / place
            if all((found / f"{part}{ending}").is_file() for part in ("cameras", "images")):
                return found
    return None


def read_colmap_model(folder: Path) -> list[NamedCamera]:
    """The registered images of a model, by name; its world and its unit stay COLMAP's.

    An InputError if it cannot be read, is empty, or has a camera that OpenCV does not have.
    """
    with explain_damage(folder, "a COLMAP model"):
        if (folder / "cameras.bin").is_file():
            lenses, images = _read_binary(folder)
        else:
            lenses, images = _read_text(folder)
        if not images:
            raise ValueError("it has no registered image")
        images.sort(key=lambda image: natural_sort_key(Path(image[0])))
        return [_named_camera(name, lenses[lens], pose) for name, lens, pose in images]


def _named_camera(name: str, lens: Lens, pose: list[float]) -> NamedCamera:
    kind, size_px, numbers = lens
    if kind not in CAMERA_MODELS or "FISHEYE" in kind:
        raise ValueError(
            f"camera model {kind}; undistort the images first (colmap image_undistorter)"
        )
    one_focal = kind.startswith("SIMPLE") or kind == "RADIAL"
    focal, center = numbers[: 1 if one_focal else 2], numbers[1:3] if one_focal else numbers[2:4]
    distortion = numbers[DISTORTION_START.get(kind, len(numbers)) :]
    distortion += [0.0] * (4 - len(distortion))
    rotation = Rotation.from_quat([*pose[1:4], pose[0]]).as_matrix()
    view = np.column_stack([rotation, pose[4:7]])
    camera = checked_camera((focal[0], focal[-1]), center, size_px, view, distortion)
    return NamedCamera(name=image_name(name), camera=camera)


def _read_text(folder: Path) -> tuple[dict[str, Lens], list[ImageRow]]:
    lenses: dict[str, Lens] = {}
    for line in filter(None, _content_lines(folder / "cameras.txt")):
        number, kind, width, height, *numbers = line.split()
        lenses[number] = (kind, (int(width), int(height)), [float(each) for each in numbers])
    images: list[ImageRow] = []
    lines = _content_lines(folder / "images.txt")
    for line in filter(None, lines):
        _, *pose, lens, name = line.split(maxsplit=9)
        images.append((name, lens, [float(each) for each in pose]))
        next(lines, None)  # the points that it sees
    return lenses, images


def _content_lines(path: Path) -> Iterator[str]:
    """Lines of a file but for its comments; a line of points may be empty."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            yield line.strip()


def _read_binary(folder: Path) -> tuple[dict[str, Lens], list[ImageRow]]:
    file, kinds = _BinaryReader(folder / "cameras.bin"), list(CAMERA_MODELS)
    lenses: dict[str, Lens] = {}
    for _ in range(file.take("Q")[0]):
        number, kind, width, height = file.take("IiQQ")
        if not 0 <= kind < len(kinds):
            raise ValueError(f"camera model {kind}; undistort the images first")
        numbers = file.take(f"{CAMERA_MODELS[kinds[kind]]}d")
        lenses[str(number)] = (kinds[kind], (width, height), list(numbers))
    file, images = _BinaryReader(folder / "images.bin"), list[ImageRow]()
    for _ in range(file.take("Q")[0]):
        _, *pose, lens = file.take("I7dI")
        images.append((file.take_text(), str(lens), pose))
        file.skip(24 * file.take("Q")[0])  # observed points
    return lenses, images


@final
class _BinaryReader:
    """Reads numbers and texts of a file, one after the other; never beyond its end."""

    def __init__(self, path: Path) -> None:
        self._data, self._place, self._name = path.read_bytes(), 0, path.name

    def take(self, layout: str) -> tuple[Any, ...]:
        """The numbers of a `struct` layout, little-endian and without gaps."""
        start = self._place
        self.skip(struct.calcsize(f"<{layout}"))
        return struct.unpack_from(f"<{layout}", self._data, start)

    def take_text(self) -> str:
        """The text up to the next zero byte."""
        start, self._place = self._place, self._data.index(b"\0", self._place) + 1
        return self._data[start : self._place - 1].decode()

    def skip(self, count: int) -> None:
        """Pass over some bytes."""
        self._place += count
        if self._place > len(self._data):
            raise ValueError(f"{self._name} is cut off")


def read_json_cameras(path: Path, size_px: tuple[int, int] | None) -> list[NamedCamera]:
    """The cameras of a transforms.json, or of Record3D's metadata; an InputError if it is neither.

    `size_px` is the images' width and height, if the file does not state them.
    """
    with explain_damage(path, "JSON of nerfstudio (`frames`) or Record3D (`poses`)"):
        content = json.loads(path.read_text(encoding="utf-8"))
        if "frames" in content:
            return _read_transforms(content, size_px)
        return _read_record3d(content)


def read_r3d(path: Path) -> list[NamedCamera]:
    """The cameras of a whole .r3d recording."""
    with explain_damage(path, "a Record3D recording"), zipfile.ZipFile(path) as archive:
        return _read_record3d(json.loads(archive.read("metadata")))


def _read_transforms(content: dict[str, Any], size_px: tuple[int, int] | None) -> list[NamedCamera]:
    """Cameras of a transforms.json, sorted by their images' names.

    ns-process-data turns COLMAP's world by `applied_transform`; that is undone.
    """
    applied = checked_rigid(content.get("applied_transform", np.eye(4)))
    named = [
        NamedCamera(
            name=image_name(frame["file_path"]),
            camera=_transforms_camera({**content, **frame}, applied, size_px),
        )
        for frame in content["frames"]
    ]
    return sorted(named, key=lambda each: natural_sort_key(Path(each.name or "")))


def _transforms_camera(
    numbers: dict[str, Any], applied: Transform, size_px: tuple[int, int] | None
) -> Camera:
    """One frame's camera; what the frame does not say, the file does."""
    lens = "a fisheye" if numbers.get("is_fisheye") else numbers.get("camera_model", "OPENCV")
    if lens not in (
        "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FULL",
        "perspective"
    ):  # fmt: skip
        raise ValueError(
            f"camera model {lens}; undistort the images first (cv2.fisheye.undistortImage, or "
            "colmap image_undistorter)"
        )
    width, height = _image_size(numbers, size_px)
    fx, fy = numbers.get("fl_x"), numbers.get("fl_y", numbers.get("fl_x"))
    if fx is None:  # NeRF's own files, and instant-ngp's, state the angles of view
        fx = width / 2.0 / math.tan(numbers["camera_angle_x"] / 2.0)
        angle_y = numbers.get("camera_angle_y")
        fy = fx if angle_y is None else height / 2.0 / math.tan(angle_y / 2.0)
    center = numbers.get("cx", width / 2.0), numbers.get("cy", height / 2.0)
    distortion = [float(numbers.get(key) or 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    world = checked_rigid(numbers["transform_matrix"])
    view = camera_from_opengl(invert_rigid(applied) @ world)
    return checked_camera((fx, fy), center, (width, height), view, distortion)


def _image_size(numbers: dict[str, Any], size_px: tuple[int, int] | None) -> tuple[float, float]:
    """The stated size; else the frames', unless the principal point is the middle of another."""
    if {"w", "h"} <= numbers.keys():
        return float(numbers["w"]), float(numbers["h"])
    if "cx" in numbers and "cy" in numbers:
        doubled = 2.0 * float(numbers["cx"]), 2.0 * float(numbers["cy"])
        if size_px is None:
            return doubled
        shares = np.array(doubled) / 2.0 / size_px
        if (np.abs(shares - 0.5) > 0.1).any():
            return doubled
    if size_px is None:
        raise ValueError("it states no w and h")
    return float(size_px[0]), float(size_px[1])


def _read_record3d(content: dict[str, Any]) -> list[NamedCamera]:
    """`poses` (N, 7) = qx qy qz qw tx ty tz; K by columns, or for each frame, as focus breathes."""
    poses = np.array(content["poses"], dtype=np.float64)
    if poses.ndim != 2 or poses.shape[1] != 7:
        raise ValueError(f"`poses` have the shape {poses.shape}; expected (N, 7)")
    k = np.array(content["K"], dtype=np.float64).reshape(3, 3).T
    lenses = np.tile([k[0, 0], k[1, 1], k[0, 2], k[1, 2]], (len(poses), 1))
    own = content.get("perFrameIntrinsicCoeffs", [])
    if np.shape(own) == lenses.shape and np.min(own) > 0.0:
        lenses = np.array(own, dtype=np.float64)
    named = []
    for pose, lens in zip(poses, lenses, strict=True):
        world = rigid_transform(Rotation.from_quat(pose[:4]).as_matrix(), pose[4:])
        size_px = (content["w"], content["h"])
        camera = checked_camera(lens[:2], lens[2:], size_px, camera_from_opengl(world))
        named.append(NamedCamera(name=None, camera=camera))
    return named


def find_polycam(folder: Path) -> Path | None:
    """The folder of cameras in Polycam's raw data: the optimised ones, if there are any."""
    for name in (
        "keyframes/corrected_cameras", "keyframes/cameras", "corrected_cameras", "cameras", ".",
    ):  # fmt: skip
        place = folder / name
        files = sorted(place.glob("*.json")) if place.is_dir() else []
        if files and "t_00" in files[0].read_text(encoding="utf-8", errors="replace")[:4096]:
            return place
    return None


def read_polycam(folder: Path) -> list[NamedCamera]:
    """A file for each image: t_00 … t_23 (world-from-camera), fx, fy, cx, cy, width, height."""
    named = []
    for path in sorted(folder.glob("*.json"), key=natural_sort_key):
        with explain_damage(path, "a camera of Polycam"):
            numbers = json.loads(path.read_text(encoding="utf-8"))
            rows = [[numbers[f"t_{row}{column}"] for column in range(4)] for row in range(3)]
            world = checked_rigid(rows)
            focal, center, size_px = (
                [numbers[key] for key in keys]
                for keys in (("fx", "fy"), ("cx", "cy"), ("width", "height"))
            )
            camera = checked_camera(focal, center, size_px, camera_from_opengl(world))
        named.append(NamedCamera(name=path.stem, camera=camera))
    return named


def find_multi_view_cameras(path: Path) -> Path | None:
    """The folder or file of a studio's cameras, if there is one."""
    if path.name in (INTRINSICS, EXTRINSICS):
        path = path.parent
    if path.is_dir() and (path / INTRINSICS).is_file() and (path / EXTRINSICS).is_file():
        return path
    found = path / ZJU if path.is_dir() else path
    return found if found.name == ZJU and found.is_file() else None


def read_multi_view_camera(
    rig: Path, video: Path | None, size_px: tuple[int, int] | None
) -> Camera:
    """The camera of a video, or of a folder of images, that is named like it.

    Without a video one camera is expected in the `rig` (of `find_multi_view_cameras`). Where files
    state no size, it is that of the frames, or twice the principal point.
    """
    with explain_damage(rig, "cameras of EasyMocap or ZJU-MoCap"):
        cameras = _read_zju(rig) if rig.name == ZJU else _read_easymocap(rig)
        if not cameras:
            raise ValueError("it holds no K_01, Rot_01 and T_01")
        name = next(iter(cameras)) if len(cameras) == 1 else _camera_named_like(video, cameras)
        if name is None:
            listed = ", ".join(list(cameras)[:12]) + (" …" if len(cameras) > 12 else "")
            raise InputError(
                f"{rig} holds {len(cameras)} cameras ({listed}), and {video} is named like none of "
                "them. Name the video, or the folder of its images, like its camera."
            )
        return _camera_of(cameras[name], size_px)


def _camera_named_like(video: Path | None, cameras: Mapping[str, StudioCamera]) -> str | None:
    if video is None:
        return None
    whole = video.resolve()
    folders = [folder.name for folder in whole.parents[:3]]
    return next((name for name in (whole.stem, whole.name, *folders) if name in cameras), None)


def _camera_of(numbers: StudioCamera, size_px: tuple[int, int] | None) -> Camera:
    k = numbers["K"].reshape(3, 3)
    distortion = numbers["D"].reshape(-1)[:5] if "D" in numbers else np.zeros(0)
    if len(distortion) not in (0, 4, 5):
        raise ValueError("its distortion is not OpenCV's (4 or 5 numbers)")
    width, height = size_px or (2.0 * k[0, 2], 2.0 * k[1, 2])
    if "W" in numbers and "H" in numbers:
        width, height = numbers["W"].item(), numbers["H"].item()
    view = np.column_stack([numbers["R"].reshape(3, 3), numbers["T"].reshape(3)])
    return checked_camera((k[0, 0], k[1, 1]), k[:2, 2], (width, height), view, distortion)


def _read_easymocap(folder: Path) -> dict[str, StudioCamera]:
    matrices: dict[str, np.ndarray] = {}
    for path in (folder / INTRINSICS, folder / EXTRINSICS):
        text = path.read_text(encoding="utf-8", errors="replace")
        for name, rows, columns, data in OPENCV_MATRIX_PATTERN.findall(text):
            numbers = [float(number) for number in data.split(",")]
            matrices[name] = np.array(numbers).reshape(int(rows), int(columns))
        for name, number in re.findall(r"^([HW]_\w+):\s*([0-9.]+)\s*$", text, re.MULTILINE):
            matrices[name] = np.array([[float(number)]])
    cameras: dict[str, StudioCamera] = {}
    for name in (key.removeprefix("K_") for key in matrices if key.startswith("K_")):
        camera = {
            part: matrices[f"{prefix}_{name}"]
            for part, prefix in EASYMOCAP_KEYS
            if f"{prefix}_{name}" in matrices
        }
        if {"R", "T"} <= camera.keys():
            if camera["R"].size == 3:
                camera["R"] = Rotation.from_rotvec(camera["R"].reshape(3)).as_matrix()
            cameras[name] = camera
    return cameras


def _read_zju(path: Path) -> dict[str, StudioCamera]:
    """All cameras of an annots.npy, named like the folders of their images."""
    content = read_untrusted_file(path)
    cams = content["cams"]
    cameras: dict[str, StudioCamera] = {}
    for row, image in enumerate(content["ims"][0]["ims"]):
        camera = {key: np.array(cams[key][row], dtype=np.float64, ndmin=2) for key in "KDRT"}
        camera["T"] /= 1000.0  # from millimetres
        cameras[PurePosixPath(str(image)).parent.name] = camera
    return cameras
