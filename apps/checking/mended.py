"""A copy of a capture with the named mistakes corrected."""

import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import Rotation, Slerp

from apps.checking.examine import Examined, masks_of
from apps.terminal.places import check_place
from capture.atomic_files import whole_folder
from capture.errors import BadInput
from capture.images import list_images
from capture.opening import open_source
from capture.source import Source
from preprocess.doctor.claim import Claim, step_of
from preprocess.doctor.film import AS_FILMED, WHOLE_WINDOW, FilmView
from preprocess.masks.files import Masks
from preprocess.pose import Motion
from preprocess.pose_file import write_motion

WHOLE = 1e-6
"""Frame numbers this close to whole ones are whole."""
JPEG = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
"""Of a video's pictures, which have lost what compression takes already; colors unsampled."""


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

    Files that stay as they are become hard links where that is possible. Pictures that must be
    rotated or mirrored are written as images; for a crop or an offset, masks, poses and cameras
    are changed instead.

    Raises:
        BadInput: If nothing was found that could be mended.
        OSError: If the disk is full; then nothing is written.
    """
    if examined.diagnosis is None or not examined.diagnosis.cures:
        raise BadInput("No mistake was found that could be mended, so --fix writes nothing.")
    check_new_folder(out)
    source, healed = examined.recording.source, examined.diagnosis.healed
    frames = source.frames_in_file
    with whole_folder(out, listed=False) as part:
        missing = _write_film(source, healed.film, part)
        _write_masks(examined, healed, part)
        claim = _of_film(healed, frames)
        motion = numbered(claim, frames, resampled="frame_rate" in examined.causes)
        if missing and motion.frames is not None:
            kept = np.flatnonzero(~np.isin(motion.frames, list(missing)))
            motion = motion.taken(kept, motion.frames[kept])
        write_motion(part / "poses.npz", motion)
        _write_cameras(claim, part / "cameras.npz")


def _write_film(source: Source, film: FilmView, folder: Path) -> set[int]:
    """The film, rotated and mirrored if it must be; the frames that have no picture then."""
    if not film.reshapes:
        if source.path.is_dir():
            _linked(list_images(source.path), folder / "images")
        else:
            _link(source.path, folder / f"video{source.path.suffix}")
        return set()
    png = source.path.is_dir() and list_images(source.path)[0].suffix.lower() == ".png"
    (folder / "images").mkdir()
    missing = set(range(source.frames_in_file))
    code = b""
    for frame in open_source(source.path).frames():
        picture = film.upright(frame.rgb)[..., ::-1]
        suffix, options = (".png", []) if png else (".jpg", JPEG)
        code = cv2.imencode(suffix, np.ascontiguousarray(picture), options)[1].tobytes()
        (folder / "images" / f"{frame.index:06d}{suffix}").write_bytes(code)
        missing -= set() if "corrupt" in frame.flags else {frame.index}
    for index in range(source.frames_in_file):  # numbers count the files: none may be missing
        place = folder / "images" / f"{index:06d}{'.png' if png else '.jpg'}"
        if not place.exists():
            place.write_bytes(code)
    return missing


def _of_film(claim: Claim, frames: int) -> Claim:
    """Poses and cameras with the film's own frame numbers and its own window.

    Args:
        claim: After all cures.
        frames: How many frames the film has.
    """
    film = claim.film
    left, top, right, bottom = film.window
    corner = np.array([left, top]) * np.array(claim.size_px)
    scale = np.array([right - left, bottom - top])
    intrinsics, extrinsics = claim.intrinsics.copy(), claim.extrinsics
    intrinsics[:, :2, 2] -= corner
    intrinsics[:, :2] /= scale[:, None]
    if film.renumbers:
        numbers = np.array([film.number(frame) for frame in range(frames)])
        intrinsics, extrinsics = (
            each if len(each) == 1 else each[numbers.clip(0, len(each) - 1)]
            for each in (intrinsics, extrinsics)
        )
        places = film.first - claim.places if film.backwards else claim.places - film.first
        claim = replace(claim, places=places)
    return replace(claim, intrinsics=intrinsics, extrinsics=extrinsics, film=AS_FILMED)


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
    if healed.film.renumbers or healed.film.window != WHOLE_WINDOW or healed.alone:
        _write_pictures(_new_masks(examined, masks, healed), folder / "masks")
        return
    stored = not masks.inverted and not healed.inverted
    if stored and masks.path.is_dir():
        _linked(sorted(p for p in masks.path.iterdir() if p.is_file()), folder / "masks")
        return
    suffix = masks.path.suffix.lower()
    if stored and suffix in (".npz", ".npy"):
        _link(masks.path, folder / f"masks{suffix}")
        return
    _write_pictures(_stored_masks(masks, healed), folder / "masks")


def _write_pictures(
    pictures: Iterator[tuple[str, Float32[np.ndarray, "height width"]]], folder: Path
) -> None:
    folder.mkdir()
    for name, alpha in pictures:
        _, code = cv2.imencode(".png", (alpha * 255.0 + 0.5).astype(np.uint8))
        (folder / f"{name}.png").write_bytes(code.tobytes())


def _stored_masks(
    masks: Masks, healed: Claim
) -> Iterator[tuple[str, Float32[np.ndarray, "height width"]]]:
    """Name and content of each mask that can be read, under its own name."""
    for row in range(masks.count):
        try:
            alpha = masks.alpha(row, masks.size_px)
        except BadInput:  # one of many; its frame will be without
            continue
        alpha = np.float32(1.0) - alpha if healed.inverted else alpha
        yield f"{row:06d}" if masks.names is None else masks.names[row], alpha


def _new_masks(
    examined: Examined, masks: Masks, healed: Claim
) -> Iterator[tuple[str, Float32[np.ndarray, "height width"]]]:
    """Name and content of the mask of each of the film's frames; empty where there is none."""
    source, film, evidence = examined.recording.source, healed.film, examined.evidence
    folder = source.path.is_dir() and not film.reshapes
    names = [file.stem for file in list_images(source.path)] if folder else []
    width, height = masks.size_px
    stored = masks_of(examined.recording, masks, masks.size_px)
    for frame in range(source.frames_in_file):
        alpha, number = np.zeros((height, width), dtype=np.float32), film.number(frame)
        try:
            alpha = stored(number)
        except BadInput:  # one of many; its frame will be left out
            pass
        else:
            alpha = np.float32(1.0) - alpha if healed.inverted else alpha
            if healed.alone and evidence is not None:
                alpha = evidence.person_of(healed, number, alpha)
        if film.window != WHOLE_WINDOW:
            affine = np.linalg.inv(film.mask_from_film((width, height)))[:2]
            alpha = np.asarray(cv2.warpAffine(alpha, affine, (width, height)), dtype=np.float32)
        yield names[frame] if frame < len(names) else f"{frame:06d}", alpha


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
