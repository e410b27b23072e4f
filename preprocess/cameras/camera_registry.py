"""Read the cameras of any known program, which is recognised by the content of its files."""

from pathlib import Path

from capture.input_error import InputError
from preprocess.cameras.colmap_model import find_colmap_model, read_colmap_model
from preprocess.cameras.named_camera import NamedCamera
from preprocess.cameras.scanning_apps import find_polycam, read_json_cameras, read_polycam, read_r3d

JSON_NAMES = ("transforms.json", "transforms_train.json", "metadata", "metadata.json")
"""Names of files with cameras, of nerfstudio, NeRF and Record3D, in a folder."""
READABLE_FORMATS = (
    "an .npz (intrinsic, extrinsic, height, width), a COLMAP model (the folder of cameras.bin and "
    "images.bin, or .txt), a transforms.json of nerfstudio or instant-ngp, Record3D's .r3d or its "
    "metadata, Polycam's folder, EasyMocap's intri.yml and extri.yml, or ZJU-MoCap's annots.npy"
)
"""List of the formats, for messages."""


def read_named_cameras(path: Path, size_px: tuple[int, int] | None = None) -> list[NamedCamera]:
    """Read the cameras of a file or a folder.

    `size_px` is the images' width and height, for files that do not state them.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; expected {READABLE_FORMATS}.")
    cameras = None
    if path.is_dir():
        cameras = _read_folder(path, size_px)
    elif is_colmap_model(path):
        cameras = _read_folder(path.parent, size_px)
    elif path.suffix.lower() == ".r3d":
        cameras = read_r3d(path)
    elif path.suffix.lower() == ".json" or path.name == "metadata":
        cameras = read_json_cameras(path, size_px)
    if not cameras:
        raise InputError(f"{path} holds no cameras that are known; expected {READABLE_FORMATS}.")
    return cameras


def is_colmap_model(path: Path) -> bool:
    """Return whether a folder holds a COLMAP model, or a file belongs to one."""
    if path.is_dir():
        return find_colmap_model(path) is not None
    return path.suffix.lower() in (".bin", ".txt") and find_colmap_model(path.parent) is not None


def _read_folder(folder: Path, size_px: tuple[int, int] | None) -> list[NamedCamera] | None:
    model = find_colmap_model(folder)
    if model is not None:
        return read_colmap_model(model)
    file = next((folder / name for name in JSON_NAMES if (folder / name).is_file()), None)
    if file is not None:
        return read_json_cameras(file, size_px)
    polycam = find_polycam(folder)
    return None if polycam is None else read_polycam(polycam)
