"""The camera of one picture, by the picture's name: its frame is found later."""

from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
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
