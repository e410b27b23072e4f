"""A capture written anew with the doctor's cures applied."""

import os
import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from apps.checking.examine import Examined
from apps.terminal.places import check_place
from capture.atomic_files import whole_folder
from capture.errors import BadInput
from capture.images import list_images
from preprocess.doctor.claim import Claim, step_of
from preprocess.pose import Motion
from preprocess.pose_file import write_motion

WHOLE = 1e-6
"""Frame numbers this close to whole ones are whole."""


def check_new_folder(out: Path) -> None:
    """Whether a capture can be written there.

    Raises:
        BadInput: If something is there already, or nothing can be.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise BadInput(f"--fix {out} is there already; name a folder that is new or empty.")
    check_place(out, "--fix")


def write_mended(examined: Examined, out: Path) -> None:
    """Writes a native capture folder: video or pictures as they are, the rest with the cures.

    Files that stay as they are become hard links where that is possible.

    Raises:
        BadInput: If nothing was found that could be mended.
        OSError: If the disk is full; then nothing is written.
    """
    if examined.diagnosis is None or not examined.diagnosis.cures:
        raise BadInput("No mistake was found that could be mended, so --fix writes nothing.")
    check_new_folder(out)
    recording, healed = examined.recording, examined.diagnosis.healed
    with whole_folder(out, listed=False) as part:
        if recording.source.path.is_dir():
            _linked(list_images(recording.source.path), part / "images")
        else:
            _link(recording.source.path, part / f"video{recording.source.path.suffix}")
        _write_masks(examined, healed, part)
        frames, resampled = recording.source.frames_in_file, "frame_rate" in examined.causes
        write_motion(part / "poses.npz", numbered(healed, frames, resampled=resampled))
        _write_cameras(healed, part / "cameras.npz")


def numbered(claim: Claim, frames: int, *, resampled: bool) -> Motion:
    """The poses with the numbers of the frames they belong to.

    Args:
        claim: After all cures.
        frames: How many frames there are.
        resampled: Whether poses were made at another rate than frames. Then, and where rows fall
            between frames, each frame gets its pose by spherical interpolation between the rows
            around it.
    """
    if not resampled and np.abs(claim.places - claim.places.round()).max() < WHOLE:
        numbers = claim.places.round().astype(np.int64)
        inside = np.flatnonzero((numbers >= 0) & (numbers < frames))
        return claim.motion.taken(inside, numbers[inside])
    return _between(claim, frames)


def _between(claim: Claim, frames: int) -> Motion:
    order = np.argsort(claim.places, kind="stable")
    order = order[claim.motion.valid[order]]
    order = order[np.unique(claim.places[order], return_index=True)[1]]
    places, motion = claim.places[order], claim.motion
    numbers = np.arange(max(0, int(np.ceil(places[0]))), min(frames, int(places[-1]) + 1))
    right = np.searchsorted(places, numbers).clip(1, len(places) - 1)
    near = places[right] - places[right - 1] <= 1.5 * step_of(places)

    def turned(vectors: np.ndarray) -> np.ndarray:
        return Slerp(places, Rotation.from_rotvec(vectors[order]))(numbers).as_rotvec()

    joints = [turned(motion.joint_rotations[:, joint]) for joint in range(23)]
    moved = motion.root_translations[order]
    return replace(
        motion,
        root_rotations=turned(motion.root_rotations),
        root_translations=np.column_stack(
            [np.interp(numbers, places, moved[:, axis]) for axis in range(3)]
        ),
        joint_rotations=np.stack(joints, axis=1),
        valid=near,
        frames=numbers,
        times_s=None,
        camera_from_world=None,
        bridged=None,
    )


def _write_masks(examined: Examined, healed: Claim, folder: Path) -> None:
    masks = examined.recording.masks
    if masks is None:  # in the pictures themselves
        return
    stored = not masks.inverted and not healed.inverted
    if stored and masks.path.is_dir():
        _linked(sorted(p for p in masks.path.iterdir() if p.is_file()), folder / "masks")
        return
    suffix = masks.path.suffix.lower()
    if stored and suffix in (".npz", ".npy"):
        _link(masks.path, folder / f"masks{suffix}")
        return
    (folder / "masks").mkdir()
    for row in range(masks.count):
        try:
            alpha = masks.alpha(row, masks.size_px)
        except BadInput:  # one of many; its frame will be without
            continue
        alpha = np.float32(1.0) - alpha if healed.inverted else alpha
        _, code = cv2.imencode(".png", (alpha * 255.0 + 0.5).astype(np.uint8))
        name = f"{row:06d}" if masks.names is None else masks.names[row]
        (folder / "masks" / f"{name}.png").write_bytes(code.tobytes())


def _write_cameras(claim: Claim, path: Path) -> None:
    one = len(claim.extrinsics) == 1
    np.savez(
        path,
        intrinsic=claim.intrinsics[0] if one else claim.intrinsics,
        extrinsic=claim.extrinsics[0] if one else claim.extrinsics,
        width=claim.size_px[0],
        height=claim.size_px[1],
        distortion=np.array(claim.distortion),
    )


def _linked(files: Iterable[Path], folder: Path) -> None:
    folder.mkdir()
    for file in files:
        _link(file, folder / file.name)


def _link(file: Path, target: Path) -> None:
    """A hard link where the file system has them, else a copy."""
    try:
        os.link(file.resolve(), target)
    except OSError:
        shutil.copyfile(file, target)
