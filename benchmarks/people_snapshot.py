"""PeopleSnapshot's own files in the layout that ia-evaluate reads: undistorted, at half the size.

    python -m benchmarks.people_snapshot PeopleSnapshot/male-3-casual prepared/male-3-casual

Reads the video, camera.pkl, masks.hdf5 and reconstructed_poses.hdf5 of a subject (needs h5py), and
Anim-NeRF's poses/ where they are there, too.
"""

import argparse
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from capture.atomic_files import atomic_folder
from capture.image_folder import write_png
from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.file_content import read_untrusted_file

CAMERA_KEYS = ("camera_f", "camera_c", "camera_k", "width", "height")
"""Keys read of camera.pkl: focal lengths, principal point, OpenCV's distortion, size."""
Lens = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "k"]]
"""Intrinsic matrix and OpenCV's distortion."""


def prepare(place: Path, out: Path) -> None:
    """Write a subject's frames with binary masks, poses and the camera, whole or not at all."""
    camera, lens = read_camera(place / "camera.pkl")
    poses = open_hdf5(place / "reconstructed_poses.hdf5", ("pose", "trans", "betas"))
    masks = open_hdf5(place / "masks.hdf5", ("masks",))["masks"]
    with atomic_folder(out) as part:
        for made in ("images", "masks"):
            (part / made).mkdir()
        np.savez(part / "cameras.npz", **camera)
        rows = {"thetas": poses["pose"][()], "transl": poses["trans"][()]}
        count = min(len(masks), len(rows["thetas"]))
        for frame in open_source(place, frames=slice(0, count)).frames():
            size = frame.size_px[0] // 2, frame.size_px[1] // 2
            mask = np.asarray(masks[frame.index], dtype=np.float32)
            if mask.shape != frame.rgb.shape[:2]:
                raise InputError(
                    f"masks.hdf5 holds masks of {mask.shape[1]}x{mask.shape[0]} px, the video has "
                    f"{frame.size_px[0]}x{frame.size_px[1]}."
                )
            both = (cv2.undistort(each, *lens) for each in (frame.rgb, mask))
            image, mask = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in both)
            name = f"{frame.index:04d}.png"
            write_png(part / "images" / name, image)
            write_png(part / "masks" / name, np.where(mask >= 0.5, 255, 0).astype(np.uint8))
        written = len(list((part / "images").iterdir()))
        rows = {key: row[:written] for key, row in rows.items()}
        np.savez(part / "poses.npz", **rows, betas=poses["betas"][()].reshape(-1))
        if (place / "poses").is_dir():
            shutil.copytree(place / "poses", part / "poses")


def read_camera(path: Path) -> tuple[dict[str, Any], Lens]:
    """Read camera.pkl: contents of cameras.npz, and the matrix and distortion of the lens."""
    stored = read_untrusted_file(path)
    missing = [key for key in CAMERA_KEYS if not isinstance(stored, dict) or key not in stored]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}; expected PeopleSnapshot's camera.")
    arrays = {key: np.asarray(value, dtype=np.float64).ravel() for key, value in stored.items()}
    for key in ("camera_rt", "camera_t"):
        if key in arrays and np.abs(arrays[key]).max(initial=0.0) > 1e-6:
            raise InputError(f"`{key}` in {path} moves the camera; expected zeros.")
    (fx, fy), (cx, cy) = arrays["camera_f"], arrays["camera_c"]
    intrinsic = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    size = {key: int(arrays[key][0]) for key in ("width", "height")}
    return {"intrinsic": intrinsic, "extrinsic": np.eye(4), **size}, (intrinsic, arrays["camera_k"])


def open_hdf5(path: Path, keys: tuple[str, ...]) -> Any:
    """Open an HDF5 file of plain arrays."""
    import h5py

    try:
        file = h5py.File(path, "r")
        missing = [key for key in keys if key not in file]
    except OSError as cause:
        raise InputError(f"{path} is missing, or no HDF5 file that can be read.") from cause
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}; is it PeopleSnapshot's?")
    return file


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("subject", type=Path)
    parser.add_argument("out", type=Path)
    chosen = parser.parse_args()
    prepare(chosen.subject, chosen.out)
