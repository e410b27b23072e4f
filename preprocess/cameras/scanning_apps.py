"""Cameras that apps and trainers write: nerfstudio and instant-ngp, Record3D, and Polycam.

All are world-from-camera with OpenGL's camera axes: y up, z back.
"""

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.image_folder import natural_sort_key
from preprocess.body.kinematics import rigid_transform
from preprocess.cameras.named_camera import (
    NamedCamera,
    camera_from_opengl,
    checked_camera,
    checked_rigid,
    image_name,
    invert_rigid,
)
from preprocess.file_content import explain_damage

SUPPORTED_CAMERA_MODELS = (
    "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FULL", "perspective",
)  # fmt: skip
"""Camera models of transforms.json that OpenCV's distortion can express."""
MAX_CENTER_OFFSET = 0.1
"""Largest offset of a principal point from the image's center; a fraction of the image's size."""
POLYCAM_SUBFOLDERS = (
    "keyframes/corrected_cameras", "keyframes/cameras", "corrected_cameras", "cameras", ".",
)  # fmt: skip
"""Folders of Polycam's cameras, the optimised ones first."""
POLYCAM_KEYS = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
"""Polycam's keys of the upper three rows of world-from-camera."""


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
    numbers: dict[str, Any], applied: Float[np.ndarray, "4 4"], size_px: tuple[int, int] | None
) -> Camera:
    """One frame's camera; what the frame does not say, the file does."""
    lens = "a fisheye" if numbers.get("is_fisheye") else numbers.get("camera_model", "OPENCV")
    if lens not in SUPPORTED_CAMERA_MODELS:
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
        if (np.abs(shares - 0.5) > MAX_CENTER_OFFSET).any():
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
    for place in (folder / name for name in POLYCAM_SUBFOLDERS):
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
            world = checked_rigid(np.reshape([numbers[key] for key in POLYCAM_KEYS], (3, 4)))
            focal, center, size_px = (
                [numbers[key] for key in keys]
                for keys in (("fx", "fy"), ("cx", "cy"), ("width", "height"))
            )
            camera = checked_camera(focal, center, size_px, camera_from_opengl(world))
        named.append(NamedCamera(name=path.stem, camera=camera))
    return named
