"""Corrected copy of a capture."""

import shutil
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import Rotation, Slerp

from apps.capture_validation import CaptureValidation, mask_lookup
from apps.cli.shared_options import check_writable
from capture.atomic_files import atomic_folder
from capture.image_folder import list_images, write_png
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
"""Deviation from an integer up to which a frame number counts as one."""
JPEG_OPTIONS = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
"""JPEG options for images of a lossy video: high quality, colors at full resolution."""


def check_new_or_empty(out: Path) -> None:
    """Check that a capture can be written to a folder.

    Raises:
        InputError: If the folder has content, or cannot be written to.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--fix {out} already exists; choose a new or empty folder.")
    check_writable(out, "--fix")


def write_corrected_capture(check: CaptureValidation, out: Path) -> None:
    """Write a native capture folder with all corrections applied.

    Unchanged files are copied: who edits the copy does not change the original. Images that must be
    rotated or mirrored are written as images; for a crop or an offset, masks, poses and cameras are
    changed instead.

    Raises:
        InputError: If no correctable mistake was found.
        OSError: If the disk is full; then nothing is written.
    """
    if check.diagnosis is None or not check.diagnosis.corrections:
        raise InputError("No correctable mistake was found; --fix wrote nothing.")
    check_new_or_empty(out)
    source, healed = check.recording.source, check.diagnosis.corrected
    frames = source.frames_in_file
    with atomic_folder(out) as part:
        missing = _write_film(source, healed.video_transform, part)
        _write_masks(check, healed, part)
        claim = _to_film_frames(healed, frames)
        motion = renumber_motion(claim, frames, resampled="frame_rate" in check.causes)
        motion = replace(motion, keypoints=None)  # of the film as it was
        if missing and motion.frames is not None:
            kept = np.flatnonzero(~np.isin(motion.frames, list(missing)))
            motion = motion.select_rows(kept, motion.frames[kept])
        write_motion(part / "poses.npz", motion)
        _write_cameras(claim, part / "cameras.npz")


def _write_film(source: FrameSource, film: VideoTransform, folder: Path) -> set[int]:
    """Write the video, reoriented if necessary; return the frames without an image."""
    if not film.reorients:
        if source.path.is_dir():
            _copy_all(list_images(source.path), folder / "images")
        else:
            shutil.copyfile(source.path, folder / f"video{source.path.suffix}")
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
    for index in range(source.frames_in_file):  # frame numbers count files: none may be missing
        place = folder / "images" / f"{index:06d}{'.png' if png else '.jpg'}"
        if not place.exists():
            place.write_bytes(code)
    return missing


def _to_film_frames(hypothesis: CaptureGeometry, frames: int) -> CaptureGeometry:
    """Convert poses and cameras to the video's own frame numbers and window.

    Args:
        hypothesis: After all corrections.
        frames: Number of frames of the video.
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
    """Assign frame numbers to poses.

    Args:
        hypothesis: After all corrections.
        frames: Number of frames of the video.
        resampled: Whether poses have another rate than the video. Then, and where rows fall between
            frames, each frame's pose is interpolated spherically between neighboring rows.
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
    if masks is None:  # masks are the images' alpha
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
        _copy_all(sorted(p for p in masks.path.iterdir() if p.is_file()), folder / "masks")
        return
    suffix = masks.path.suffix.lower()
    if stored and suffix in (".npz", ".npy"):
        shutil.copyfile(masks.path, folder / f"masks{suffix}")
        return
    _write_mask_images(_stored_masks(masks, corrected), folder / "masks")


def _write_mask_images(
    masks: Iterator[tuple[str, Float32[np.ndarray, "height width"]]], folder: Path
) -> None:
    folder.mkdir()
    for name, alpha in masks:
        write_png(folder / f"{name}.png", (alpha * 255.0 + 0.5).astype(np.uint8))


def _stored_masks(
    masks: Masks, corrected: CaptureGeometry
) -> Iterator[tuple[str, Float32[np.ndarray, "height width"]]]:
    """Yield name and content of each readable mask, under its own name."""
    for row in range(masks.count):
        try:
            alpha = masks.alpha(row, masks.size_px)
        except InputError:  # this frame has no mask then
            continue
        alpha = np.float32(1.0) - alpha if corrected.masks_inverted else alpha
        yield f"{row:06d}" if masks.names is None else masks.names[row], alpha


def _transformed_masks(
    check: CaptureValidation, masks: Masks, corrected: CaptureGeometry
) -> Iterator[tuple[str, Float32[np.ndarray, "height width"]]]:
    """Yield name and content of the mask of each video frame; empty where there is none."""
    source, film, evidence = check.recording.source, corrected.video_transform, check.sampled_masks
    folder = source.path.is_dir() and not film.reorients
    names = [file.stem for file in list_images(source.path)] if folder else []
    width, height = masks.size_px
    stored = mask_lookup(check.recording, masks, masks.size_px)
    for frame in range(source.frames_in_file):
        alpha, number = np.zeros((height, width), dtype=np.float32), film.mask_frame(frame)
        try:
            alpha = stored(number)
        except InputError:  # this frame is skipped then
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


def _copy_all(files: Iterable[Path], folder: Path) -> None:
    folder.mkdir()
    for file in files:
        shutil.copyfile(file, folder / file.name)
