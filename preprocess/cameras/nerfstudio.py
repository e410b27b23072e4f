"""transforms.json of nerfstudio and instant-ngp: world-from-camera with OpenGL's axes."""

from pathlib import Path
from typing import Any

import numpy as np

from capture.camera import Camera
from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from preprocess.cameras.named_camera import (
    NamedCamera,
    camera_from_opengl,
    image_name,
    invert_rigid,
    parse_pinhole_camera,
    parse_rigid_transform,
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
        name = _name(frame, path)
        try:
            camera = _camera({**content, **frame}, applied, path, size_px)
        except (TypeError, ValueError, OverflowError) as cause:
            if isinstance(cause, InputError):
                raise
            raise InputError(f"{path}: a camera's numbers are none ({cause}).") from cause
        named.append(NamedCamera(name=name, camera=camera))
    return sorted(named, key=lambda each: natural_sort_key(Path(each.name or "")))


def _name(frame: dict[str, Any], path: Path) -> str:
    if not isinstance(frame.get("file_path"), str):
        raise InputError(
            f"{path}: a frame has no `file_path`, which would tell whose camera it is."
        )
    return image_name(frame["file_path"])


def _camera(
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
