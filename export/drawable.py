"""What the player can draw, checked before it is asked of the graph."""

from typing import Any

import numpy as np

from capture.camera import Camera
from capture.errors import InputError
from preprocess.plausibility import MAX_JOINT_ANGLE_RAD, exceeds_joint_limits
from preprocess.pose import BodyPose

MAX_SAMPLES = 256
MAX_PICTURE_PX = 8192
MAX_MAGNITUDE = 1e8
"""Pixels, metres, radians: whatever is larger, or NaN, is a mistake."""


def resize_camera(camera: Camera, size: int | np.integer | tuple[int, int] | None) -> Camera:
    """The same camera for a picture of another size.

    Args:
        camera: With a size of its own.
        size: Longer side, or width and height, pixels; None for the camera's own.

    Raises:
        InputError: If there would be no pixels.
    """
    if size is None:
        return camera
    sides: Any = np.asarray(size)
    if sides.shape not in ((), (2,)) or sides.dtype.kind not in "iu" or sides.min() < 1:
        raise InputError(
            f"A picture of size {size} was asked for; expected the longer side, or width and "
            "height, in whole pixels from 1 on."
        )
    return camera.resize_longer_side(int(sides)) if sides.ndim == 0 else camera.resize((*sides.tolist(),))


def check_render_inputs(pose: BodyPose, camera: Camera, samples: int) -> None:
    """Whether all of it can be drawn.

    Raises:
        InputError: If it cannot.
    """
    if not 1 <= samples <= MAX_SAMPLES:
        raise InputError(f"{samples} samples were asked for; 1 to {MAX_SAMPLES} can be drawn.")
    _check_array("root_rotation", pose.root_rotation, (3,))
    _check_array("root_translation", pose.root_translation, (3,))
    _check_array("joint_rotations", pose.joint_rotations, (23, 3))
    if exceeds_joint_limits(pose.joint_rotations):
        raise InputError(
            f"joint_rotations turn a joint by more than {np.rad2deg(MAX_JOINT_ANGLE_RAD):.0f}°; "
            "axis-angles in radians were expected. Of degrees give numpy.deg2rad(degrees)."
        )
    _check_array("camera_from_world", camera.camera_from_world, (4, 4))
    if camera.distortion:
        raise InputError(
            "The camera has lens distortion, but the player draws pinhole pictures. "
            "Leave the distortion out of the camera."
        )
    width, height = camera.size_px
    if not (0 < width <= MAX_PICTURE_PX and 0 < height <= MAX_PICTURE_PX):
        raise InputError(
            f"Pictures of {width}x{height} px cannot be drawn; 1 to {MAX_PICTURE_PX} a side can."
        )
    lens = np.array([*camera.focal_px, *camera.center_px])
    if not (np.abs(lens) < MAX_MAGNITUDE).all() or min(camera.focal_px) <= 0.0:
        raise InputError(
            f"The camera's focal lengths are {camera.focal_px} and its centre {camera.center_px}; "
            "finite numbers of pixels were expected, focal lengths above 0."
        )


def _check_array(name: str, array: Any, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape:
        raise InputError(f"{name} has the shape {np.shape(array)}; {shape} was expected.")
    if not (np.abs(array) < MAX_MAGNITUDE).all():
        raise InputError(f"{name} holds NaN, infinity or a number out of all bounds.")
