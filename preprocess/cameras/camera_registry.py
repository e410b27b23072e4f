"""Read the cameras of any known program, which is recognised by the content of its files."""

import json
from pathlib import Path

from capture.input_error import InputError
from preprocess.cameras.colmap import find_colmap_model, read_colmap_model
from preprocess.cameras.named_camera import NamedCamera
from preprocess.cameras.nerfstudio import read_transforms
from preprocess.cameras.phone_apps import (
    MAX_METADATA_BYTES,
    find_polycam,
    read_polycam,
    read_r3d,
    read_record3d,
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
