"""Track the person of a recording, fit poses, body and camera, and write them as files."""

import os
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from capture.atomic_files import OutputFileList, atomic_file, atomic_folder
from capture.input_error import InputError
from capture.source import FrameSource
from capture.source_opening import open_source, reopen
from instant_avatar.cli.console import Console
from preprocess.alignment.silhouette_objective import sample_masks
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import SkinPoints
from preprocess.body.parametric_body import load_body_model
from preprocess.cameras.camera_file import assume_camera
from preprocess.capture_inputs import (
    CaptureInputs,
    CapturePaths,
    find_cameras,
    find_own_masks,
)
from preprocess.capture_session import Capture, CaptureFit
from preprocess.fitting.capture_fitting import fit_capture, fitted_motion
from preprocess.masks.mask_files import open_masks
from preprocess.masks.mask_refinement import MaskRefiner
from preprocess.masks.mask_sources import associate_masks
from preprocess.open_capture import ImportedCapture, align_capture, import_capture
from preprocess.plugins import DEFAULT_TRACKER, PersonTracker, make_tracker, segmenter_name
from preprocess.poses.pose_file import as_stored, write_motion
from preprocess.poses.pose_format_registry import read_poses
from preprocess.tracking.first_look import FirstLook, look_at
from preprocess.tracking.keypoints import KeypointTrack
from preprocess.tracking.pose_lift import lift_keypoints
from preprocess.tracking.tracking_grade import TrackingGrade, grade_tracking
from preprocess.tracking.video_tracking import TrackedVideo, VideoTracking

MAX_PRINTED_STRETCHES = 8
"""Doubtful stretches that are printed; reports hold all of them."""
MAX_FRAMES = 600
"""Most frames that are tracked unless --frames says which; of longer videos every nth."""
FEW_FRAMES = 120
"""Number of a film's frames below which none is left out, and that are left at least."""
FitFunction = Callable[[Capture, Console], CaptureFit | None]
"""Fits body and poses of a capture, and shows the stage on the console."""
SAME_PERSON = 0.15
"""Mean distance of one person's key points, found twice in a frame, in the person's size."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonTracking:
    """The tracked person of a recording.

    Attributes:
        imported: The recording with the poses, and with the masks that are learnt from.
        interrupted: Whether tracking was stopped before the last frame.
    """

    imported: ImportedCapture
    grade: TrackingGrade
    interrupted: bool

    def capture(self) -> Capture:
        """The recording, aligned as it is."""
        return align_capture(self.imported, skip_checks=True)


def fit_in_process(capture: Capture, console: Console) -> CaptureFit | None:
    """Fit body and poses of a capture to what was seen of the person."""
    with console.status("fitting body and poses"):
        return fit_capture(capture)


def limit_frames(
    inputs: CaptureInputs, source: FrameSource, *, for_learning: bool = False
) -> CaptureInputs:
    """Choose every nth frame of a long recording, unless the user chose some.

    `for_learning` also leaves out frames of a video between which a person hardly moves.
    """
    count = source.frame_count or 0
    step = max(1, -(-count // MAX_FRAMES))
    if for_learning and source.duration_s and not source.path.is_dir():
        enough = max(FEW_FRAMES, 14.0 * source.duration_s)  # frames between them are nearly alike
        step = max(step, int(count / enough))
    if inputs.frames is not None or step == 1:
        return inputs
    return replace(inputs, frames=slice(None, None, step))


def track_person(
    inputs: CaptureInputs,
    poses: Path,
    console: Console,
    *,
    stop: threading.Event | None = None,
    resume: bool = False,
    for_learning: bool = False,
    fit: FitFunction = fit_in_process,
) -> PersonTracking:
    """Track the person, and write poses, and masks to the folder masks/ beside them.

    Masks that were given, or lie beside the video, are used instead of tracked ones (see
    `masks_to_use`); so are cameras. Setting `stop` ends tracking early; what was found until then
    is written. With `resume`, `poses` and its masks hold the first frames, after which to go on.
    `for_learning` leaves out frames that an avatar does not need (see `limit_frames`).

    Raises:
        KeyboardInterrupt: If it was stopped before the person was found.
    """
    inputs, source = _open_video(inputs, console, look=not resume, for_learning=for_learning)
    folder = poses.parent / "masks"
    given, names_segmenter = masks_to_use(inputs, folder), segmenter_name(inputs.masks) is not None
    own_masks = given is None and (names_segmenter or not source.has_alpha)
    if given is not None and inputs.masks is None:
        console.info(f"Using the masks in {given}, which lie beside the video.")
    _check_parts(source, inputs, given)
    with atomic_folder(folder) if own_masks else nullcontext() as part:
        before = _earlier_frames(source, poses, part) if resume else None
        tracked = _run_networks(source, inputs, part, console, stop, before)
        for warning in source.warnings:
            console.warning(warning)
        if tracked.interrupted:  # the frames after it have no masks
            chosen = source.selection
            until = slice(chosen.start, max(tracked.frame_times_s) + 1, chosen.step)
            inputs = replace(inputs, frames=until)
            source = reopen(source, inputs.frames)
        there = tracked_inputs(replace(inputs, height_m=None), poses, part)
        capture = fit_tracked_video(
            source, tracked, there, given, fit=lambda capture: fit(capture, console)
        )
        grade = _grade(capture, tracked.frame_times_s)
        capture = replace(capture, motion=_without(capture.motion, grade.left_out))
        with atomic_file(poses) as unfinished:
            write_motion(unfinished, capture.motion)
    learnt = folder if own_masks and not names_segmenter else None
    there = tracked_inputs(inputs, poses, learnt)
    imported = _import_poses(source, capture.motion, there, given)
    return PersonTracking(imported=imported, grade=grade, interrupted=tracked.interrupted)


def _open_video(
    inputs: CaptureInputs, console: Console, *, look: bool, for_learning: bool
) -> tuple[CaptureInputs, FrameSource]:
    """Open the frames that are to be tracked; with `look` print what a few of them show."""
    source = open_source(inputs.video, frames=inputs.frames, rotate=inputs.rotate)
    inputs, step = limit_frames(inputs, source, for_learning=for_learning), source.selection.step
    source = reopen(source, inputs.frames)
    if source.selection.step != step:
        console.info(
            f"One in {source.selection.step} frames is used, {source.frame_count} in all (all: "
            "--frames ::1)."
        )
    if look:
        print_first_look(look_at(source), inputs, console, tracks=True)
    return inputs, source


def print_first_look(
    seen: FirstLook, inputs: CaptureInputs, console: Console, *, tracks: bool
) -> None:
    """Print what a few frames show; of fewer than seven frames there is nothing to print.

    Where poses are given instead of tracked, only if the networks find a person at all.
    """
    if not seen.frames or not (tracks or seen.found):
        return
    console.info(seen.describe())
    has_cameras = inputs.cameras not in (None, "static")
    for advice in seen.advice(tracks=tracks, has_cameras=has_cameras):
        console.warning(advice)


def tracked_inputs(inputs: CaptureInputs, poses: Path, masks: Path | None) -> CaptureInputs:
    """The inputs with tracked poses; `masks` is the folder of tracked masks, if they are used."""
    inputs = replace(inputs, poses=poses, person=None)
    return inputs if masks is None else replace(inputs, masks=masks, invert_masks=False)


def _import_poses(
    source: FrameSource, motion: Motion, inputs: CaptureInputs, masks_beside: Path | None
) -> ImportedCapture:
    """The recording with poses as a file would hold them."""
    assert inputs.poses is not None
    cameras = find_cameras(inputs.video, inputs.cameras)
    paths = CapturePaths(
        video=inputs.video, poses=inputs.poses, masks=masks_beside, cameras=cameras
    )
    body, motion = load_body_model(inputs.body), as_stored(motion, inputs.poses)
    return import_capture(inputs, paths, source, body, motion)


def _check_parts(source: FrameSource, inputs: CaptureInputs, masks: Path | None) -> None:
    """Open body, camera and masks that the user named, before minutes of tracking."""
    load_body_model(inputs.body)
    assume_camera(inputs.video, inputs.cameras, source)
    if masks is not None:
        associate_masks(open_masks(masks, invert=False), source)


def masks_to_use(inputs: CaptureInputs, written: Path) -> Path | None:
    """Masks that the user named, or that lie beside the video; None if they are to be tracked.

    Older tracked masks in the folder `written` are replaced, not used.
    """
    if segmenter_name(inputs.masks) is not None:
        return None
    found = inputs.masks or find_own_masks(inputs.video)
    if inputs.masks is not None or found is None:
        return found
    is_own = next(OutputFileList(found).foreign_files(), None) is None
    return None if is_own and os.path.realpath(found) == os.path.realpath(written) else found


def _run_networks(
    source: FrameSource,
    inputs: CaptureInputs,
    mask_folder: Path | None,
    console: Console,
    stop: threading.Event | None,
    before: TrackedVideo | None,
) -> TrackedVideo:
    """Find key points and masks in each frame, or in each after those that were tracked before."""
    name, person = inputs.tracker or DEFAULT_TRACKER, person_number(inputs.person)
    tracker, total, chosen = make_tracker(name, person), source.frame_count, source.selection
    if before is not None and _finds_again(tracker, source, before.keypoints):
        after = int(before.keypoints.frames[-1]) + chosen.step
        source = reopen(source, slice(after, chosen.stop, chosen.step))
    elif before is not None:  # someone else, from here on
        tracker, before = make_tracker(name, person), None
    tracking = VideoTracking(source, tracker, MaskRefiner(source.size_px), mask_folder, before)
    with (
        console.progress("tracking the person", float(total or 1)) as bar,
        closing(tracking.run()) as counts,
    ):
        while not (stop is not None and stop.is_set()) and (done := next(counts, None)) is not None:
            bar.set_count(done)
    try:
        return tracking.result()
    except InputError:
        if stop is not None and stop.is_set():  # too early to tell
            raise KeyboardInterrupt from None
        raise


def _earlier_frames(
    source: FrameSource, poses: Path, mask_folder: Path | None
) -> TrackedVideo | None:
    """Read what was tracked up to the last frame with the person, and copy its masks.

    None if it is of another size, or masks are missing.
    """
    keypoints = read_poses(poses).keypoints
    if keypoints is None or keypoints.times_s is None or keypoints.size_px != source.size_px:
        return None
    last = int(keypoints.frames[-1])
    times = {number: at for number, at in _even_frame_times(source).items() if number <= last}
    names = [f"{number:06d}.png" for number in times] if mask_folder is not None else []
    stored = poses.parent / "masks"
    if not all((stored / name).is_file() for name in names):
        return None
    for name in names:
        assert mask_folder is not None
        shutil.copyfile(stored / name, mask_folder / name)
    times |= dict(zip(keypoints.frames.tolist(), keypoints.times_s.tolist(), strict=True))
    return TrackedVideo(keypoints=keypoints, frame_times_s=times, interrupted=True)


def _finds_again(tracker: PersonTracker, source: FrameSource, keypoints: KeypointTrack) -> bool:
    """True if a new tracker takes up the same person in the last frame that was tracked."""
    last = int(keypoints.frames[-1])
    frame = next(iter(reopen(source, slice(last, last + 1)).frames()), None)
    found = None if frame is None else tracker(frame.rgb)
    if found is None:
        return False
    apart = np.linalg.norm(found.image_px - keypoints.image_px[-1], axis=1).mean()
    return bool(apart < SAME_PERSON * np.ptp(keypoints.image_px[-1], axis=0).max())


def fit_tracked_video(
    source: FrameSource,
    tracked: TrackedVideo,
    inputs: CaptureInputs,
    masks_beside: Path | None = None,
    *,
    fit: Callable[[Capture], CaptureFit | None] = fit_capture,
) -> Capture:
    """The recording with poses lifted from the key points and fitted to them and to the masks.

    `inputs` name the poses' file, which is not read, and the masks, unless they lie beside the
    video.
    """
    camera = assume_camera(inputs.video, inputs.cameras, source)
    lifted = lift_keypoints(tracked.keypoints, load_body_model(inputs.body).with_shape(), camera)
    imported = _import_poses(
        source,
        replace(lifted, space="camera", program=inputs.tracker or DEFAULT_TRACKER),
        inputs,
        masks_beside,
    )
    capture = align_capture(imported, skip_checks=True)
    fitted = fit(capture)
    if fitted is None:
        return capture
    return replace(
        capture,
        motion=fitted_motion(capture, fitted),
        cameras=capture.cameras.scale_focal(fitted.focal_factor),
        shaped=fitted.shape(capture.shaped),
    )


def _without(motion: Motion, frames: Sequence[int]) -> Motion:
    if motion.frames is None:
        return motion
    return replace(motion, valid=motion.valid & ~np.isin(motion.frames, list(frames)))


def person_number(person: str | None) -> int | None:
    """The number in --person, by which persons of a video without poses are named."""
    if person is not None and not person.isdecimal():
        raise InputError(
            f"--person is {person!r}, but the video comes without poses: expected a number counted "
            "from left to right, from 1."
        )
    return None if person is None else int(person)


def grade_capture(capture: Capture) -> TrackingGrade | None:
    """Grade poses that hold the key points that they were made of, by given masks; else None."""
    if capture.motion.keypoints is None or not capture.masks.is_given:
        return None
    return _grade(capture, _even_frame_times(capture.source))


def _grade(capture: Capture, frame_times_s: Mapping[int, float]) -> TrackingGrade:
    """Grade tracked poses; `frame_times_s` are the times of frames looked at, by their numbers."""
    source, keypoints = capture.source, capture.motion.keypoints
    assert keypoints is not None
    skin = SkinPoints.of(capture.shaped)
    sampled = sample_masks(source, capture.masks, capture.cameras, skin, count=60, track=keypoints)
    scores = sampled.frame_scores(capture.geometry())
    return grade_tracking(
        capture.motion,
        keypoints,
        capture.shaped,
        capture.cameras[0],
        frame_times_s,
        {each.index: float(score) for each, score in zip(sampled.samples, scores, strict=True)},
    )


def _even_frame_times(source: FrameSource) -> dict[int, float]:
    """Times of the wanted frames of a recording with an even rate, by their numbers."""
    count, chosen = source.frame_count or 0, source.selection
    step_s = (source.duration_s or 0.0) / max(1, chosen.span(source.frames_in_file))
    numbers = [chosen.start + chosen.step * place for place in range(count)]
    return {number: number * step_s for number in numbers}


def print_doubts(grade: TrackingGrade, console: Console) -> None:
    """Print the doubtful stretches."""
    for each in grade.stretches[:MAX_PRINTED_STRETCHES]:
        console.info(f"  doubtful: {each.describe()}")
    if len(grade.stretches) > MAX_PRINTED_STRETCHES:
        console.info(f"  … and {len(grade.stretches) - MAX_PRINTED_STRETCHES} more")
