"""Corrected copy of a capture."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from capture.atomic_files import atomic_folder
from capture.image_folder import list_images, write_png
from capture.input_error import InputError
from capture.source import FrameSource
from capture.source_opening import reopen
from instant_avatar.capture_validation import CaptureValidation
from instant_avatar.cli.shared_options import check_writable
from preprocess.alignment.capture_geometry import (
    FULL_WINDOW,
    CaptureGeometry,
    VideoTransform,
    frame_step,
)
from preprocess.body.body_pose import Motion
from preprocess.masks.mask_sources import StoredMasks
from preprocess.poses.motion_builder import interpolate_rows
from preprocess.poses.pose_file import write_motion

INTEGER_TOLERANCE = 1e-6
"""Deviation from an integer up to which a frame number counts as one."""
JPEG_OPTIONS = [cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111]
"""JPEG options for images of a lossy video: high quality, colors at full resolution."""


def check_new_or_empty(out: Path) -> None:
    """Refuse a folder that has content, or cannot be written to."""
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--fix {out} already exists; choose a new or empty folder.")
    check_writable(out, "--fix")


def write_corrected_capture(check: CaptureValidation, out: Path) -> None:
    """Write a native capture folder with all corrections applied.

    Unchanged images are copied: who edits the copy does not change the original. Images that must
    be rotated or mirrored are written as images; for a crop or an offset, masks, poses and cameras
    are changed instead.
    """
    if not check.causes:
        raise InputError("No correctable mistake was found; --fix wrote nothing.")
    check_new_or_empty(out)
    source, corrected = check.capture.source, check.diagnosis.corrected
    video, frames, missing = corrected.video_transform, source.frames_in_file, set[int]()
    with atomic_folder(out) as part:
        if video.reorients:
            missing = _write_images(source, video, part / "images")
        elif source.path.is_dir():
            (part / "images").mkdir()
            for file in list_images(source.path):
                shutil.copyfile(file, part / "images" / file.name)
        else:
            shutil.copyfile(source.path, part / f"video{source.path.suffix}")
        # without masks, ia-ingest estimates them
        masks = check.capture.masks
        if isinstance(masks, StoredMasks) and video.window == FULL_WINDOW:
            _write_masks(check, masks.in_order_at_worst(), part / "masks")
        geometry = corrected.in_video_frames(frames)
        motion = renumber_motion(geometry, frames, resampled="frame_rate" in check.causes)
        if missing and motion.frames is not None:
            kept = np.flatnonzero(~np.isin(motion.frames, list(missing)))
            motion = motion.select_rows(kept, motion.frames[kept])
        # key points are those of the video as it was
        write_motion(part / "poses.npz", replace(motion, keypoints=None))
        one = len(geometry.extrinsics) == 1
        np.savez(
            part / "cameras.npz",
            intrinsic=geometry.intrinsics[0] if one else geometry.intrinsics,
            extrinsic=geometry.extrinsics[0] if one else geometry.extrinsics,
            width=geometry.size_px[0],
            height=geometry.size_px[1],
            distortion=np.array(geometry.distortion),
        )


def _write_images(source: FrameSource, video: VideoTransform, folder: Path) -> set[int]:
    """Write all images upright; return the frames without one, for which the last is repeated."""
    png = source.path.is_dir() and list_images(source.path)[0].suffix.lower() == ".png"
    suffix, options = (".png", []) if png else (".jpg", JPEG_OPTIONS)
    missing, place = set(range(source.frames_in_file)), folder
    folder.mkdir()
    for frame in reopen(source, None).frames():
        picture = np.ascontiguousarray(video.reorient(frame.rgb)[..., ::-1])
        place = folder / f"{frame.index:06d}{suffix}"
        place.write_bytes(cv2.imencode(suffix, picture, options)[1].tobytes())
        missing -= set() if "corrupt" in frame.flags else {frame.index}
    for index in missing:  # frame numbers count files: none may be missing
        if not (folder / f"{index:06d}{suffix}").exists():
            shutil.copyfile(place, folder / f"{index:06d}{suffix}")
    return missing


def _write_masks(check: CaptureValidation, masks: StoredMasks, folder: Path) -> None:
    source, corrected = check.capture.source, check.diagnosis.corrected
    video, sampled = corrected.video_transform, check.objective.masks
    by_name = source.path.is_dir() and not video.reorients
    names = [file.stem for file in list_images(source.path)] if by_name else []
    size_px = masks.files.size_px
    folder.mkdir()
    for frame in range(source.frames_in_file):
        number = video.first_frame + frame
        try:
            alpha = masks.read(number, size_px)
        except InputError:  # this frame is skipped then
            alpha = np.zeros(size_px[::-1], dtype=np.float32)
        else:
            alpha = np.float32(1.0) - alpha if corrected.masks_inverted else alpha
        if corrected.keeps_person_only and sampled is not None:
            alpha = sampled.keep_person(corrected, number, alpha)
        name = names[frame] if frame < len(names) else f"{frame:06d}"
        write_png(folder / f"{name}.png", (alpha * 255.0 + 0.5).astype(np.uint8))


def renumber_motion(geometry: CaptureGeometry, frames: int, *, resampled: bool) -> Motion:
    """Assign the frame numbers of the video to poses, after all corrections.

    If poses are `resampled` (have another rate than the video), and where rows fall between frames,
    each frame's pose is interpolated spherically between neighboring rows.
    """
    if (
        not resampled
        and np.abs(geometry.row_frames - geometry.row_frames.round()).max() < INTEGER_TOLERANCE
    ):
        numbers = geometry.row_frames.round().astype(np.int64)
        inside = np.flatnonzero((numbers >= 0) & (numbers < frames))
        return geometry.motion.select_rows(inside, numbers[inside])
    return _interpolate_motion(geometry, frames)


def _interpolate_motion(geometry: CaptureGeometry, frames: int) -> Motion:
    order = np.argsort(geometry.row_frames, kind="stable")
    order = order[geometry.motion.valid[order]]
    order = order[np.unique(geometry.row_frames[order], return_index=True)[1]]
    places, motion = geometry.row_frames[order], geometry.motion
    numbers = np.arange(max(0, int(np.ceil(places[0]))), min(frames, int(places[-1]) + 1))
    right = np.searchsorted(places, numbers).clip(1, len(places) - 1)
    near = places[right] - places[right - 1] <= 1.5 * frame_step(places)
    gaps = np.minimum(np.abs(places[right] - numbers), np.abs(places[right - 1] - numbers))
    near |= gaps < INTEGER_TOLERANCE  # this frame's own pose, which may lie beside a gap
    return replace(interpolate_rows(motion, order, places, numbers), valid=near)
