"""Read the cameras of any known program, which is recognised by the content of its files.

COLMAP models, 3.x and 4.x, binary and text, are read by pycolmap.
"""

import json
import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from capture.camera import Camera
from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from preprocess.cameras.named_camera import (
    MAX_METADATA_BYTES,
    NamedCamera,
    find_polycam,
    image_name,
    read_polycam,
    read_r3d,
    read_record3d,
    read_transforms,
)

READABLE_FORMATS = (
    "an .npz (intrinsic, extrinsic, height, width), a COLMAP model (the folder of cameras.bin and "
    "images.bin, or .txt), a transforms.json of nerfstudio or instant-ngp, Record3D's .r3d or its "
    "metadata, Polycam's folder, EasyMocap's intri.yml and extri.yml, or ZJU-MoCap's annots.npy"
)
"""List of the formats, for messages."""


def read_named_cameras(path: Path, size_px: tuple[int, int] | None = None) -> list[NamedCamera]:
    """The cameras of a file or a folder.

    Args:
        path: The file or folder.
        size_px: Width and height of the pictures, for files that do not state them.

    Raises:
        InputError: If nothing there holds cameras.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; expected {READABLE_FORMATS}.")
    if path.is_dir():
        return _in_folder(path, size_px)
    if (
        path.suffix.lower() in (".bin", ".txt")
        and (model := find_colmap_model(path.parent)) is not None
    ):
        return read_colmap_model(model)
    if path.suffix.lower() == ".r3d":
        return read_r3d(path)
    if path.suffix.lower() == ".json" or path.name == "metadata":
        return _in_json(path, size_px)
    raise InputError(f"{path} holds no cameras that are known; expected {READABLE_FORMATS}.")


def _in_folder(folder: Path, size_px: tuple[int, int] | None) -> list[NamedCamera]:
    model = find_colmap_model(folder)
    if model is not None:
        return read_colmap_model(model)
    for name in ("transforms.json", "transforms_train.json", "metadata", "metadata.json"):
        if (folder / name).is_file():
            return _in_json(folder / name, size_px)
    cameras = find_polycam(folder)
    if cameras is not None:
        return read_polycam(cameras)
    raise InputError(f"{folder} holds no cameras that are known; expected {READABLE_FORMATS}.")


def _in_json(path: Path, size_px: tuple[int, int] | None) -> list[NamedCamera]:
    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            raise InputError(
                f"{path} is larger than {MAX_METADATA_BYTES >> 20} MiB; it holds no cameras."
            )
        content = json.loads(path.read_text(encoding="utf-8"))
    except InputError:
        raise
    except (OSError, ValueError, RecursionError) as cause:
        raise InputError(f"{path} is no JSON that can be read ({cause}).") from cause
    if isinstance(content, dict) and "frames" in content:
        return read_transforms(content, path, size_px)
    if isinstance(content, dict) and "poses" in content:
        return read_record3d(content, path)
    raise InputError(f"{path} holds neither `frames` (nerfstudio) nor `poses` (Record3D).")


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
        NamedCamera(name=image_name(image.name), camera=_colmap_camera(image, model, folder))
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


def _colmap_camera(image: Any, model: Any, folder: Path) -> Camera:
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
