"""The camera of one image, by the image's name, out of numbers that another program wrote.

The frame of the image is found later (`preprocess.frame_association`).
"""

from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from preprocess.body.kinematics import rigid_transform

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


def invert_rigid(transform: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """The inverse of a rotation and shift."""
    return rigid_transform(transform[:3, :3].T, -transform[:3, :3].T @ transform[:3, 3])


def camera_from_opengl(world_from_camera: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
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
    """A camera of numbers that may be anything; each argument as in `Camera`.

    Raises:
        TypeError, ValueError: If they are no camera.
    """
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
