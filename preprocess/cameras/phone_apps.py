"""Cameras of phone apps: Record3D and Polycam, in metres, with OpenGL's camera axes (ARKit's)."""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from preprocess.body.kinematics import rigid_transform
from preprocess.cameras.named_camera import (
    MAX_IMAGE_SIDE_PX,
    NamedCamera,
    camera_from_opengl,
    parse_pinhole_camera,
    parse_rigid_transform,
)

POLYCAM_SUBFOLDERS = (
    "keyframes/corrected_cameras",
    "keyframes/cameras",
    "corrected_cameras",
    "cameras",
)
"""Folders of Polycam's cameras, best first."""

POLYCAM_KEYS = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))
"""Polycam's keys of the upper three rows of world-from-camera."""

MAX_METADATA_BYTES = 1 << 28
"""Largest metadata file that is read."""


def read_record3d(content: dict[str, Any], path: Path) -> list[NamedCamera]:
    """The metadata of a Record3D recording: `poses` (N, 7) = qx qy qz qw tx ty tz, K by columns.

    Raises:
        InputError: If it holds something else.
    """
    try:
        poses = np.array(content["poses"], dtype=np.float64)
        width, height = int(content["w"]), int(content["h"])
        intrinsics = np.array(content["K"], dtype=np.float64).reshape(3, 3).T
    except (KeyError, TypeError, ValueError, OverflowError) as cause:
        raise InputError(f"{path}: expected poses, K, w and h of Record3D ({cause}).") from cause
    well = poses.ndim == 2 and poses.shape[1] == 7 and np.isfinite(poses).all() and len(poses)
    if not well or not (np.linalg.norm(poses[:, :4], axis=1) > 1e-6).all():
        raise InputError(f"{path}: `poses` have the shape {poses.shape}; expected (N, 7) numbers.")
    if (
        not np.isfinite(intrinsics).all()
        or intrinsics[0, 0] <= 0.0
        or not 1 <= width <= MAX_IMAGE_SIDE_PX
    ):
        raise InputError(f"{path}: K, w and h describe no camera.")
    if not 1 <= height <= MAX_IMAGE_SIDE_PX:
        raise InputError(f"{path}: h is {height}; expected a height in pixels.")
    own = _per_frame_intrinsics(content, intrinsics, len(poses))
    found = []
    for row, pose in enumerate(poses):
        world_from_camera = rigid_transform(Rotation.from_quat(pose[:4]).as_matrix(), pose[4:])
        camera = Camera.from_intrinsic(
            own[row], (width, height), camera_from_opengl(world_from_camera)
        )
        found.append(NamedCamera(name=None, camera=camera))
    return found


def _per_frame_intrinsics(
    content: dict[str, Any], common: Float[np.ndarray, "3 3"], count: int
) -> Float[np.ndarray, "frames 3 3"]:
    """K of each frame, whose focus breathes: `perFrameIntrinsicCoeffs` (N, 4) = fx fy cx cy."""
    every = np.tile(common, (count, 1, 1))
    try:
        told = np.array(content.get("perFrameIntrinsicCoeffs"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return every
    if told.shape != (count, 4) or not np.isfinite(told).all() or (told[:, :2] <= 0.0).any():
        return every
    every[:, [0, 1, 0, 1], [0, 1, 2, 2]] = told
    return every


def read_r3d(path: Path) -> list[NamedCamera]:
    """The cameras of a whole .r3d recording.

    Raises:
        InputError: If it is none.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.getinfo("metadata").file_size > MAX_METADATA_BYTES:
                raise InputError(
                    f"{path}: its metadata are larger than {MAX_METADATA_BYTES >> 20} MiB."
                )
            content = json.loads(archive.read("metadata"))
    except (zipfile.BadZipFile, KeyError, ValueError, RuntimeError, OSError) as cause:
        if isinstance(cause, InputError):
            raise
        raise InputError(f"{path} is no Record3D recording ({cause}).") from cause
    if not isinstance(content, dict):
        raise InputError(f"{path} is no Record3D recording.")
    return read_record3d(content, path)


def find_polycam(folder: Path) -> Path | None:
    """The folder of cameras in Polycam's raw data: the optimised ones, if there are any."""
    for place in (*POLYCAM_SUBFOLDERS, "."):
        files = sorted((folder / place).glob("*.json")) if (folder / place).is_dir() else []
        if files and "t_00" in files[0].read_text(encoding="utf-8", errors="replace")[:4096]:
            return folder / place
    return None


def read_polycam(folder: Path) -> list[NamedCamera]:
    """A file for each picture: t_00 … t_23 (world-from-camera), fx, fy, cx, cy, width, height.

    Raises:
        InputError: If one holds something else.
    """
    found = []
    for path in sorted(folder.glob("*.json"), key=natural_sort_key):
        try:
            numbers = json.loads(path.read_text(encoding="utf-8"))
            matrix = np.array([float(numbers[key]) for key in POLYCAM_KEYS]).reshape(3, 4)
        except (OSError, ValueError, TypeError, KeyError, OverflowError) as cause:
            raise InputError(f"{path} is no camera of Polycam ({cause}).") from cause
        world = parse_rigid_transform(matrix, str(path))
        camera = parse_pinhole_camera(
            numbers, ("fx", "fy", "cx", "cy", "width", "height"), camera_from_opengl(world), (),
            str(path),
        )  # fmt: skip
        found.append(NamedCamera(name=path.stem, camera=camera))
    return found
