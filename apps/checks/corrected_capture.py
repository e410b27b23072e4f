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

from apps.checks.capture_validation import CaptureValidation, mask_lookup
from apps.cli.output_paths import check_writable
from capture.atomic_files import atomic_folder
from capture.image_folder import list_images
from capture.input_error import InputError
from capture.source import FrameSource
from capture.source_opening import open_source
from preprocess.alignment.capture_geometry import (
    FULL_WINDOW,
    IDENTITY_TRANSFORM,
    CaptureGeometry,
    VideoTransform,
    frame_step,
)
from preprocess.body.body_pose import Motion
from preprocess.masks.mask_files import Masks
from preprocess.poses.pose_file import write_motion

INTEGER_TOLERANCE = 1e-6
"""Frame numbers this close to whole ones are whole."""
JPEG_OPTIONS = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
"""Of a video's pictures, which have lost what compression takes already; colors unsampled."""


def check_new_or_empty(out: Path) -> None:
    """Whether a capture can be written there.

    Raises:
        InputError: If something is there already, or nothing can be.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--fix {out} is there already; name a folder that is new or empty.")
    check_writable(out, "--fix")


def write_corrected_capture(check: CaptureValidation, out: Path) -> None:
    """Writes a native capture folder: video or pictures as they are, the rest with the cures.

    Files that stay as they are become hard links where that is possible. Pictures that must be
    rotated or mirrored are written as images; for a crop or an offset, masks, poses and cameras
    are changed instead.

    Raises:
        InputError: If nothing was found that could be mended.
        OSError: If the disk is full; then nothing is written.
    """
    if check.diagnosis is None or not check.diagnosis.corrections:
        raise InputError("No mistake was found that could be mended, so --fix writes nothing.")
    check_new_or_empty(out)
    source, healed = check.recording.source, check.diagnosis.corrected
    frames = source.frames_in_file
    with atomic_folder(out, listed=False) as part:
        missing = _write_film(source, healed.video_transform, part)
        _write_masks(check, healed, part)
        claim = _to_film_frames(healed, frames)
        motion = renumber_motion(claim, frames, resampled="frame_rate" in check.causes)
        if missing and motion.frames is not None:
            kept = np.flatnonzero(~np.isin(motion.frames, list(missing)))
            motion = motion.select_rows(kept, motion.frames[kept])
        write_motion(part / "poses.npz", motion)
        _write_cameras(claim, part / "cameras.npz")


def _write_film(source: FrameSource, film: VideoTransform, folder: Path) -> set[int]:
    """The film, rotated and mirrored if it must be; the frames that have no picture then."""
    if not film.reorients:
        if source.path.is_dir():
            _link_all(list_images(source.path), folder / "images")
        else:
            _link(source.path, folder / f"video{source.path.suffix}")
        return set()
    png = source.path.is_dir() and list_images(source.path)[0].suffix.lower() == ".png"
    (folder / "images").mkdir()
    missing = set(range(source.frames_in_file))
    code = b""
    for frame in open_source(source.path).frames():
        picture = film.reorient(frame.rgb)[..., ::-1]
        suffix, options = (".png", []) if png else (".jpg", JPEG_OPTIONS)
        code = cv2.imencode(suffix, np.ascontiguousarray(picture), options)[1].tobytes()
        (folder / "images" / f"{frame.index:06d}{suffix}").write_bytes(code)
        missing -= set() if "corrupt" in frame.flags else {frame.index}
    for index in range(source.frames_in_file):  # numbers count the files: none may be missing
        place = folder / "images" / f"{index:06d}{'.png' if png else '.jpg'}"
        if not place.exists():
            place.write_bytes(code)
    return missing


def _to_film_frames(hypothesis: CaptureGeometry, frames: int) -> CaptureGeometry:
    """Poses and cameras with the film's own frame numbers and its own window.

    Args:
        claim: After all cures.
        frames: How many frames the film has.
    """
    film = hypothesis.video_transform
    left, top, right, bottom = film.window
    corner = np.array([left, top]) * np.array(hypothesis.size_px)
    scale = np.array([right - left, bottom - top])
    intrinsics, extrinsics = hypothesis.intrinsics.copy(), hypothesis.extrinsics
    intrinsics[:, :2, 2] -= corner
    intrinsics[:, :2] /= scale[:, None]
    if film.renumbers_frames:
        numbers = np.array([film.mask_frame(frame) for frame in range(frames)])
        intrinsics, extrinsics = (
            each if len(each) == 1 else each[numbers.clip(0, len(each) - 1)]
            for each in (intrinsics, extrinsics)
        )
        places = (
            film.first_frame - hypothesis.row_frames
            if film.backwards
            else hypothesis.row_frames - film.first_frame
        )
        hypothesis = replace(hypothesis, row_frames=places)
    return replace(
        hypothesis, intrinsics=intrinsics, extrinsics=extrinsics, video_transform=IDENTITY_TRANSFORM
    )


def renumber_motion(hypothesis: CaptureGeometry, frames: int, *, resampled: bool) -> Motion:
    """The poses with the numbers of the frames they belong to.

    Args:
        claim: After all cures.
        frames: How many frames there are.
        resampled: Whether poses were made at another rate than frames. Then, and where rows fall
            between frames, each frame gets its pose by spherical interpolation between the rows
            around it.
    """
    if (
        not resampled
        and np.abs(hypothesis.row_frames - hypothesis.row_frames.round()).max() < INTEGER_TOLERANCE
    ):
        numbers = hypothesis.row_frames.round().astype(np.int64)
        inside = np.flatnonzero((numbers >= 0) & (numbers < frames))
        return hypothesis.motion.select_rows(inside, numbers[inside])
    return _interpolate_motion(hypothesis, frames)


def _interpolate_motion(hypothesis: CaptureGeometry, frames: int) -> Motion:
    order = np.argsort(hypothesis.row_frames, kind="stable")
    order = order[hypothesis.motion.valid[order]]
    order = order[np.unique(hypothesis.row_frames[order], return_index=True)[1]]
    places, motion = hypothesis.row_frames[order], hypothesis.motion
    numbers = np.arange(max(0, int(np.ceil(places[0]))), min(frames, int(places[-1]) + 1))
    right = np.searchsorted(places, numbers).clip(1, len(places) - 1)
    near = places[right] - places[right - 1] <= 1.5 * frame_step(places)

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
        interpolated=None,
    )


def _write_masks(check: CaptureValidation, corrected: CaptureGeometry, folder: Path) -> None:
    masks = check.recording.masks
    if masks is None:  # in the pictures themselves
        return
    if (
        corrected.video_transform.renumbers_frames
        or corrected.video_transform.window != FULL_WINDOW
        or corrected.keeps_person_only
    ):
        _write_mask_images(_transformed_masks(check, masks, corrected), folder / "masks")
        return
    stored = not masks.inverted and not corrected.masks_inverted
    if stored and masks.path.is_dir():
        _link_all(sorted(p for p in masks.path.iterdir() if p.is_file()), folder / "masks")
        return
    suffix = masks.path.suffix.lower()
    if stored and suffix in (".npz", ".npy"):
        _link(masks.path, folder / f"masks{suffix}")
        return
    _write_mask_images(_stored_masks(masks, corrected), folder / "masks")


def _write_mask_images(
    masks: Iterator[tuple[str, Float32[np.ndarray, "height width"]]], folder: Path
) -> None:
    folder.mkdir()
    for name, alpha in masks:
        _, code = cv2.imencode(".png", (alpha * 255.0 + 0.5).astype(np.uint8))
        (folder / f"{name}.png").write_bytes(code.tobytes())


def _stored_masks(
    masks: Masks, corrected: CaptureGeometry
) -> Iterator[tuple[str, Float32[np.ndarray, "height width"]]]:
    """Name and content of each mask that can be read, under its own name."""
    for row in range(masks.count):
        try:
            alpha = masks.alpha(row, masks.size_px)
        except InputError:  # one of many; its frame will be without
            continue
        alpha = np.float32(1.0) - alpha if corrected.masks_inverted else alpha
        yield f"{row:06d}" if masks.names is None else masks.names[row], alpha


def _transformed_masks(
    check: CaptureValidation, masks: Masks, corrected: CaptureGeometry
) -> Iterator[tuple[str, Float32[np.ndarray, "height width"]]]:
    """Name and content of the mask of each of the film's frames; empty where there is none."""
    source, film, evidence = check.recording.source, corrected.video_transform, check.sampled_masks
    folder = source.path.is_dir() and not film.reorients
    names = [file.stem for file in list_images(source.path)] if folder else []
    width, height = masks.size_px
    stored = mask_lookup(check.recording, masks, masks.size_px)
    for frame in range(source.frames_in_file):
        alpha, number = np.zeros((height, width), dtype=np.float32), film.mask_frame(frame)
        try:
            alpha = stored(number)
        except InputError:  # one of many; its frame will be left out
            pass
        else:
            alpha = np.float32(1.0) - alpha if corrected.masks_inverted else alpha
            if corrected.keeps_person_only and evidence is not None:
                alpha = evidence.keep_person(corrected, number, alpha)
        if film.window != FULL_WINDOW:
            affine = np.linalg.inv(film.mask_from_video((width, height)))[:2]
            alpha = np.asarray(cv2.warpAffine(alpha, affine, (width, height)), dtype=np.float32)
        yield names[frame] if frame < len(names) else f"{frame:06d}", alpha


def _write_cameras(hypothesis: CaptureGeometry, path: Path) -> None:
    one = len(hypothesis.extrinsics) == 1
    np.savez(
        path,
        intrinsic=hypothesis.intrinsics[0] if one else hypothesis.intrinsics,
        extrinsic=hypothesis.extrinsics[0] if one else hypothesis.extrinsics,
        width=hypothesis.size_px[0],
        height=hypothesis.size_px[1],
        distortion=np.array(hypothesis.distortion),
    )


def _link_all(files: Iterable[Path], folder: Path) -> None:
    folder.mkdir()
    for file in files:
        _link(file, folder / file.name)


def _link(file: Path, target: Path) -> None:
    """A hard link where the file system has them, else a copy."""
    try:
        os.link(file.resolve(), target)
    except OSError:
        shutil.copyfile(file, target)
