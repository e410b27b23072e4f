"""COLMAP models, 3.x and 4.x, binary and text, read by pycolmap."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from capture.camera import Camera
from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from preprocess.cameras.named_camera import NamedCamera, image_name

MODEL_SUBFOLDERS = (".", "sparse/0", "0", "sparse", "colmap/sparse/0", "dense/sparse")
"""Where models lie in a folder, as COLMAP, nerfstudio and others leave them."""

MIN_CAMERA_BYTES = 24 + 3 * 8
"""Bytes of the shortest camera in cameras.bin."""

IMAGE_HEADER_BYTES = 4 + 7 * 8 + 4
"""Bytes before an image's name in images.bin."""

POINT_BYTES = 24
"""Bytes of a point behind an image's name in images.bin."""

OPENCV_DISTORTION = {
    "SIMPLE_PINHOLE": lambda p: (),
    "PINHOLE": lambda p: (),
    "SIMPLE_RADIAL": lambda p: (p[3], 0.0, 0.0, 0.0),
    "RADIAL": lambda p: (p[3], p[4], 0.0, 0.0),
    "OPENCV": lambda p: tuple(p[4:8]),
    "FULL_OPENCV": lambda p: tuple(p[4:12]),
}
"""OpenCV's coefficients in COLMAP's parameters, by the camera's model."""


def find_colmap_model(folder: Path) -> Path | None:
    """The folder in which a COLMAP model lies, if one does."""
    for place in MODEL_SUBFOLDERS:
        for ending in (".bin", ".txt"):
            found = folder / place
            if all((found / f"{part}{ending}").is_file() for part in ("cameras", "images")):
                return found
    return None


def read_colmap_model(folder: Path) -> list[NamedCamera]:
    """The registered pictures of a model, by name; its world and its unit stay COLMAP's.

    Raises:
        InputError: If it cannot be read, is empty, or has a camera that OpenCV does not have.
    """
    import pycolmap  # heavy, and only needed for its own files

    pycolmap.logging.minloglevel = 3  # the message below explains the error instead
    try:
        with TemporaryDirectory() as bare:
            _copy_without_points(folder, Path(bare))
            model = pycolmap.Reconstruction(bare)
        images = sorted(
            (model.image(number) for number in model.reg_image_ids()),
            key=lambda image: natural_sort_key(Path(image.name)),
        )
    except Exception as cause:  # what C++ throws; a damaged count is a bad_alloc
        raise InputError(f"{folder} holds no COLMAP model that can be read ({cause}).") from cause
    if not images:
        raise InputError(f"The COLMAP model in {folder} has no registered picture.")
    return [
        NamedCamera(name=image_name(image.name), camera=_camera(image, model, folder))
        for image in images
    ]


def _copy_without_points(folder: Path, bare: Path) -> None:
    """Copies a model's cameras and pictures, which is all that is wanted, once they are sound.

    Counts that a damaged file claims are believed by COLMAP's reader, which then reads beyond the
    end for minutes and fills the memory.

    Raises:
        ValueError: If counts and sizes do not fit.
    """
    ending = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    for part in ("cameras", "images"):
        shutil.copyfile(folder / f"{part}{ending}", bare / f"{part}{ending}")
    (bare / f"points3D{ending}").write_bytes(bytes(8) if ending == ".bin" else b"")
    if ending == ".txt":
        return
    cameras, images = ((bare / f"{part}.bin").read_bytes() for part in ("cameras", "images"))
    if len(cameras) < 8 + MIN_CAMERA_BYTES * _count(cameras, 0):
        raise ValueError("cameras.bin is cut off")
    place = 8
    for _ in range(_count(images, 0)):
        name_ends = images.find(b"\0", place + IMAGE_HEADER_BYTES)
        if name_ends < 0:
            raise ValueError("images.bin is cut off")
        place = name_ends + 9 + POINT_BYTES * _count(images, name_ends + 1)
        if place > len(images):
            raise ValueError("images.bin is cut off")


def _count(data: bytes, place: int) -> int:
    """COLMAP's 64-bit number of what follows."""
    return int.from_bytes(data[place : place + 8], "little") if place + 8 <= len(data) else 1 << 62


def _camera(image: Any, model: Any, folder: Path) -> Camera:
    lens = model.camera(image.camera_id)
    kind = lens.model_name
    if kind not in OPENCV_DISTORTION:
        raise InputError(
            f"The COLMAP model in {folder} has a camera of the model {kind}; expected one of "
            f"{', '.join(OPENCV_DISTORTION)}. Undistort the pictures first (colmap "
            "image_undistorter)."
        )
    camera_from_world = np.eye(4)
    camera_from_world[:3] = image.cam_from_world().matrix()
    distortion = tuple(float(k) for k in OPENCV_DISTORTION[kind](lens.params))
    return Camera.from_intrinsic(
        lens.calibration_matrix(),
        (int(lens.width), int(lens.height)),
        camera_from_world,
        distortion if any(distortion) else (),
    )
