"""PeopleSnapshot protocol of InstantAvatar: training and test frames, and the paper's scores.

InstantAvatar (Jiang et al. 2023), Tab. 1, follows Anim-NeRF (Chen et al. 2021): train on frames of
one turn for a minute, score whole frames of another turn on white, in poses fitted to them with the
avatar frozen. The data set is available from its authors on request. Subjects are read in the
folders that InstantAvatar's preprocessing writes, or as they are distributed: camera.pkl,
masks.hdf5, reconstructed_poses.hdf5 and a video.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from apps.cli.console import Console
from apps.evaluation.dataset_subject import (
    DatasetSubject,
    SplitFrames,
    require_rows,
    write_image,
    write_splits,
)
from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.file_content import read_untrusted_file

SPLITS = {
    "female-3-casual": ("0:446:4", "446:648:4"),
    "female-4-casual": ("0:336:4", "335:524:4"),
    "male-3-casual": ("0:456:4", "456:676:4"),
    "male-4-casual": ("0:660:6", "660:873:6"),
}
"""Training and test frames of the paper's subjects, START:STOP:STEP counted from 0."""
PAPER = {
    "female-3-casual": {"psnr": 27.90, "ssim": 0.9722, "lpips_alex01": 0.0249},
    "female-4-casual": {"psnr": 28.92, "ssim": 0.9692, "lpips_alex01": 0.0180},
    "male-3-casual": {"psnr": 29.65, "ssim": 0.9730, "lpips_alex01": 0.0192},
    "male-4-casual": {"psnr": 27.97, "ssim": 0.9649, "lpips_alex01": 0.0346},
}
"""InstantAvatar's scores after a minute, at 540 px on white, in fitted poses."""
LONGER_SIDE_PX = 540
"""Longer side of the paper's images: half of the video's."""
TRAIN_POSES, TEST_POSES = Path("poses/anim_nerf_train.npz"), Path("poses/anim_nerf_test.npz")
"""Anim-NeRF's poses, one row per listed frame; the capture's own replace missing ones."""
CAMERA_KEYS = ("camera_f", "camera_c", "camera_k", "width", "height")
"""What is read of camera.pkl: focal lengths, principal point, OpenCV's distortion, size."""
Lens = tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "k"]]
"""Intrinsic matrix and OpenCV's distortion."""


def find_people_snapshot(folder: Path) -> list[DatasetSubject]:
    """Find the paper's subjects in a folder, which may be a subject itself."""
    found = []
    for name in SPLITS:
        for place in (folder / name, folder):
            if place.resolve().name == name and place.is_dir():
                opening = _open_raw if _is_raw(place) else _open_prepared
                found.append(
                    DatasetSubject(
                        name=name,
                        open_splits=partial(opening, name, place),
                        size_px=LONGER_SIDE_PX,
                        paper=PAPER[name],
                    )
                )
                break
    return found


def _is_raw(folder: Path) -> bool:
    """Whether a folder has the layout in which the data set is distributed."""
    return (folder / "camera.pkl").is_file() and not (folder / "images").is_dir()


def _open_prepared(
    name: str, place: Path, _into: Path, _console: Console
) -> tuple[SplitFrames, SplitFrames]:
    """Name the frames of a folder that InstantAvatar's preprocessing wrote."""
    train, test = (
        SplitFrames(folder=place, poses=_existing(place / poses), frames=frames)
        for poses, frames in zip((TRAIN_POSES, TEST_POSES), SPLITS[name], strict=True)
    )
    return train, test


def _open_raw(
    name: str, place: Path, into: Path, console: Console
) -> tuple[SplitFrames, SplitFrames]:
    """Write the protocol's frames of the original files: undistorted, at half the resolution.

    Raises:
        InputError: If a file is missing or damaged, or h5py is not installed.
    """
    splits = {
        split: range(*map(int, frames.split(":")))
        for split, frames in zip(("train", "test"), SPLITS[name], strict=True)
    }
    given = {"train": place / TRAIN_POSES, "test": place / TEST_POSES}
    into = into / name

    def write(part: Path, numbers: Sequence[int]) -> Iterator[int]:
        split = next(split for split, wanted in splits.items() if wanted == numbers)
        return _write_raw_frames(place, part, numbers, _existing(given[split]))

    return write_splits(into, dict(splits), write, console)


def _write_raw_frames(
    place: Path, part: Path, numbers: Sequence[int], given: Path | None
) -> Iterator[int]:
    """Write frames with binary masks, poses and the camera; yield their numbers.

    Args:
        place: Folder of the original files.
        part: Folder to write to.
        numbers: Frames, evenly spaced.
        given: Poses of these frames; None for those in reconstructed_poses.hdf5.
    """
    camera, lens = _read_camera(place / "camera.pkl")
    np.savez(part / "cameras.npz", **camera)
    if given is None:
        path = place / "reconstructed_poses.hdf5"
        with _open_hdf5(path, ("pose", "trans", "betas")) as stored:
            poses = {key: stored[key][()] for key in ("pose", "trans", "betas")}
        require_rows(len(poses["pose"]), numbers, path, "poses")
        rows = {"thetas": poses["pose"][numbers], "transl": poses["trans"][numbers]}
        np.savez(part / "poses.npz", **rows, betas=poses["betas"].reshape(-1))
    else:
        (part / "poses.npz").write_bytes(given.read_bytes())
    with _open_hdf5(place / "masks.hdf5", ("masks",)) as file:
        require_rows(len(file["masks"]), numbers, place / "masks.hdf5", "masks")
        yield from _write_images(place, part, numbers, file["masks"], lens)


def _write_images(
    place: Path, part: Path, numbers: Sequence[int], masks: Any, lens: Lens
) -> Iterator[int]:
    """Write undistorted frames and masks of half the size; yield their numbers."""
    wanted = slice(numbers[0], numbers[-1] + 1, numbers[1] - numbers[0])
    for frame in open_source(place, frames=wanted).frames():
        size = frame.size_px[0] // 2, frame.size_px[1] // 2
        mask = np.asarray(masks[frame.index], dtype=np.float32)
        if mask.shape != frame.rgb.shape[:2]:
            raise InputError(
                f"{place / 'masks.hdf5'} holds masks of {mask.shape[1]}x{mask.shape[0]} px, the "
                f"video has {frame.size_px[0]}x{frame.size_px[1]}."
            )
        picture, mask = (cv2.undistort(each, *lens) for each in (frame.rgb, mask))
        picture, mask = (cv2.resize(e, size, interpolation=cv2.INTER_AREA) for e in (picture, mask))
        name = f"{frame.index:04d}.png"
        write_image(part / "images" / name, picture)
        write_image(part / "masks" / name, np.where(mask >= 0.5, 255, 0).astype(np.uint8))
        yield frame.index


def _read_camera(path: Path) -> tuple[dict[str, Any], Lens]:
    """Read camera.pkl: contents of cameras.npz, and the matrix and distortion of the lens.

    Raises:
        InputError: If it lacks something, or moves the camera.
    """
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


def _open_hdf5(path: Path, keys: tuple[str, ...]) -> Any:
    """Open an HDF5 file of plain arrays.

    Raises:
        InputError: If it is missing, damaged or lacks a key, or h5py is not installed.
    """
    try:
        import h5py
    except ImportError as cause:
        raise InputError(
            f"{path} needs h5py: pip install 'instant-avatar-stream[datasets]'."
        ) from cause
    try:
        file = h5py.File(path, "r")
        missing = [key for key in keys if key not in file]
    except OSError as cause:
        raise InputError(f"{path} is missing, or no HDF5 file that can be read.") from cause
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}; is it PeopleSnapshot's?")
    return file


def _existing(path: Path) -> Path | None:
    return path if path.is_file() else None
