"""The camera of one picture, by the picture's name, and the apps' files that hold such cameras.

nerfstudio and instant-ngp (transforms.json), Record3D and Polycam: world-from-camera with OpenGL's
camera axes. Which frame a picture is, is found later.
"""

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from preprocess.body.kinematics import rigid_transform

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Camera axes: y up and z back become y down and z forward."""


MAX_IMAGE_SIDE_PX = 100_000
"""Longest side of a picture."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NamedCamera:
    """One picture's camera.

    Attributes:
        name: Of the picture's file, with its folders if it says so and without its ending; None
            where there is only an order.
        camera: Of the picture's own size.
    """

    name: str | None
    camera: Camera


def image_name(stored: str) -> str:
    """A picture's path in a stranger's file, of any system, without its ending."""
    path = PurePosixPath(stored.replace("\\", "/"))
    return str(path.with_suffix("")) if path.name else ""


def camera_from_opengl(
    world_from_camera: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "4 4"]:
    """OpenCV's camera-from-world of a world-from-camera matrix with OpenGL's camera axes."""
    return OPENCV_FROM_OPENGL @ invert_rigid(world_from_camera)


def invert_rigid(transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The inverse of a rotation and shift."""
    return rigid_transform(transform[:3, :3].T, -transform[:3, :3].T @ transform[:3, 3])


def parse_rigid_transform(numbers: Any, where: str) -> Float[np.ndarray, "4 4"]:
    """A 3x4 or 4x4 rigid transform out of a stranger's file.

    Raises:
        InputError: If it is something else.
    """
    try:
        found = np.array(numbers, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as cause:
        raise InputError(f"{where}: a matrix holds something that is no number.") from cause
    if found.shape not in ((3, 4), (4, 4)) or not np.isfinite(found).all():
        raise InputError(f"{where}: expected finite 4x4 matrices, found the shape {found.shape}.")
    transform = np.eye(4)
    transform[:3] = found[:3]
    turn = transform[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0.0:
        raise InputError(f"{where}: a camera's matrix is not rigid (rotation and shift, no scale).")
    return transform


def parse_pinhole_camera(
    numbers: dict[str, Any],
    keys: tuple[str, str, str, str, str, str],
    camera_from_world: Float[np.ndarray, "4 4"],
    distortion: tuple[float, ...],
    where: str,
) -> Camera:
    """A camera from six numbers of a stranger's JSON.

    Args:
        numbers: The JSON object.
        keys: Its keys for fx, fy, cx, cy, width and height.
        camera_from_world: Where it stands.
        distortion: OpenCV's coefficients.
        where: For messages.

    Raises:
        InputError: If one is missing, or no positive number.
    """
    try:
        fx, fy, cx, cy, width, height = (float(numbers[key]) for key in keys)
    except (KeyError, TypeError, ValueError, OverflowError) as cause:
        raise InputError(f"{where}: expected the numbers {', '.join(keys)}; {cause}.") from cause
    sizes = min(width, height) >= 1.0 and max(width, height) <= MAX_IMAGE_SIDE_PX
    if not np.isfinite([fx, fy, cx, cy, width, height]).all() or min(fx, fy) <= 0.0 or not sizes:
        raise InputError(
            f"{where}: focal length and size must be positive pixels, and at most "
            f"{MAX_IMAGE_SIDE_PX}."
        )
    return Camera(
        focal_px=(fx, fy),
        center_px=(cx, cy),
        size_px=(round(width), round(height)),
        camera_from_world=camera_from_world,
        distortion=distortion if any(distortion) else (),
    )


SUPPORTED_CAMERA_MODELS = (
    "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FULL", "perspective",
)  # fmt: skip
"""Camera models of transforms.json that OpenCV's distortion can express."""

MAX_CENTER_OFFSET = 0.1
"""Largest offset of a principal point from the image's center; a fraction of the image's size."""


def read_transforms(
    content: dict[str, Any], path: Path, size_px: tuple[int, int] | None = None
) -> list[NamedCamera]:
    """The cameras of a transforms.json, sorted by their pictures' names.

    ns-process-data turns COLMAP's world by `applied_transform`; that is undone.

    Args:
        content: The JSON.
        path: Of the file, for messages.
        size_px: Width and height of the pictures, if the file does not state them (NeRF's own
            files hold an angle of view only).

    Raises:
        InputError: If it holds something else.
    """
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} holds no `frames`; a transforms.json of nerfstudio was expected.")
    applied = np.eye(4)
    if "applied_transform" in content:
        applied = parse_rigid_transform(content["applied_transform"], f"{path}, applied_transform")
    named = []
    for frame in frames:
        if not isinstance(frame, dict):
            raise InputError(f"{path}: one of the `frames` is no object; is the file damaged?")
        name = _frame_name(frame, path)
        try:
            camera = _transforms_camera({**content, **frame}, applied, path, size_px)
        except (TypeError, ValueError, OverflowError) as cause:
            if isinstance(cause, InputError):
                raise
            raise InputError(f"{path}: a camera's numbers are none ({cause}).") from cause
        named.append(NamedCamera(name=name, camera=camera))
    return sorted(named, key=lambda each: natural_sort_key(Path(each.name or "")))


def _frame_name(frame: dict[str, Any], path: Path) -> str:
    if not isinstance(frame.get("file_path"), str):
        raise InputError(
            f"{path}: a frame has no `file_path`, which would tell whose camera it is."
        )
    return image_name(frame["file_path"])


def _transforms_camera(
    numbers: dict[str, Any], applied: np.ndarray, path: Path, size_px: tuple[int, int] | None
) -> Camera:
    """One frame's camera; what the frame does not say, the file does."""
    lens = "a fisheye" if numbers.get("is_fisheye") else numbers.get("camera_model", "OPENCV")
    if lens not in SUPPORTED_CAMERA_MODELS:
        raise InputError(
            f"{path}: camera model {lens}; expected one of {', '.join(SUPPORTED_CAMERA_MODELS)}. "
            "Undistort the pictures first (cv2.fisheye.undistortImage, or colmap "
            "image_undistorter)."
        )
    numbers = _with_size(numbers, size_px)
    world = parse_rigid_transform(numbers.get("transform_matrix"), f"{path}, transform_matrix")
    if "fl_x" not in numbers and "camera_angle_x" in numbers:
        numbers = {**numbers, **_from_angles(numbers, path)}
    numbers = {"fl_y": numbers.get("fl_x"), **numbers}
    if "cx" not in numbers and "w" in numbers and "h" in numbers:
        numbers = {**numbers, "cx": numbers["w"] / 2.0, "cy": numbers["h"] / 2.0}
    bends = [float(numbers.get(key) or 0.0) for key in ("k1", "k2", "p1", "p2", "k3")]
    return parse_pinhole_camera(
        numbers,
        ("fl_x", "fl_y", "cx", "cy", "w", "h"),
        camera_from_opengl(invert_rigid(applied) @ world),
        tuple(bends),
        str(path),
    )


def _with_size(numbers: dict[str, Any], size_px: tuple[int, int] | None) -> dict[str, Any]:
    """With w and h, the frames' own unless the principal point is the middle of another size."""
    if {"w", "h"} <= numbers.keys() or size_px is None:
        return numbers
    width, height = size_px
    if {"cx", "cy"} <= numbers.keys():
        cx, cy = float(numbers["cx"]), float(numbers["cy"])
        if abs(cx / width - 0.5) > MAX_CENTER_OFFSET or abs(cy / height - 0.5) > MAX_CENTER_OFFSET:
            width, height = round(2.0 * cx), round(2.0 * cy)
    return {**numbers, "w": width, "h": height}


def _from_angles(numbers: dict[str, Any], path: Path) -> dict[str, float]:
    """Focal lengths of the angles of view (NeRF's own files, and instant-ngp's)."""
    try:
        across = float(numbers["w"]) / 2.0 / np.tan(float(numbers["camera_angle_x"]) / 2.0)
        down = across
        if "camera_angle_y" in numbers:
            down = float(numbers["h"]) / 2.0 / np.tan(float(numbers["camera_angle_y"]) / 2.0)
    except (KeyError, TypeError, ValueError) as cause:
        raise InputError(f"{path}: expected w, h and camera_angle_x, or fl_x ({cause}).") from cause
    return {"fl_x": across, "fl_y": down}


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
