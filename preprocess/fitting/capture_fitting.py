"""Aligns an opened capture to its masks: body, poses and focal length at once.

The fit would change exact poses, too, by its own noise. How much of its changes is made follows
from how much larger they are than that noise (Wiener's factor), without a step: nothing of those of
exact poses, nearly all of those of a tracker's.

Outlines do not show how far limbs turn about themselves; the built-in tracker's key points tell it
in part, by depth. Both estimates of a pose err independently, so each counts by the inverse of its
error's variance. The given poses' error is estimated by how far outlines turned them, the key
points' by the rest of the disagreement between the two, joint by joint.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from capture.input_error import InputError
from capture.source import Frame, FrameSource
from capture.source_opening import reopen
from preprocess.alignment.capture_geometry import CaptureGeometry, rescale_motion
from preprocess.alignment.silhouette_objective import spaced_indices
from preprocess.body.body_pose import Motion
from preprocess.body.proportion_space import SIGMA_BETA, ProportionSpace
from preprocess.capture_session import Capture, CaptureFit, Provenance
from preprocess.fitting.clip_fitting import (
    POSES_ALONE,
    TRACKED_WEIGHTS,
    USUAL_WEIGHTS,
    ClipFitter,
    ClipFrame,
    EvidenceWeights,
    FitParameters,
)
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.fitting.outlines import OUTLINE_PERSON_PX, OutlineDistances
from preprocess.fitting.silhouettes import read_silhouettes
from preprocess.observation import associate_cameras
from preprocess.tracking.keypoints import MIN_PRESENCE, KeypointTrack, PersonKeypoints
from preprocess.tracking.video_tracking import MIN_FRAMES

KEY_FRAMES = 50
"""Frames, evenly spread, to whose masks given poses are fitted at first."""
MORE_MASKS = 100
"""Fewest frames with key points (`_count_keypoint_frames`) from which given poses are fitted to as
many masks, too: reading a mask takes 20 core-ms."""
TRACKED_KEY_FRAMES = 300
"""Most frames, evenly spread, whose masks are fitted together with key points."""
POSE_ITERATIONS = 1
"""Iterations over poses alone after those, with `TRACKED_POSE_WEIGHTS`."""
TRACKED_POSE_WEIGHTS = EvidenceWeights(outline_rows=480.0, keypoints=0.6)
"""Weights while poses alone are fitted: with these, proportions would follow the clothes."""
NOISE_DEG_PER_CM = 1.5
"""Rotation by which the fit changes exact poses, degrees for each cm by which outlines still differ
after it (1.4, 1.4 and 1.55 on three exact captures; a tracker's, real and simulated: 5 to 8)."""
LEAST_ERROR_RAD = math.radians(5.0)
"""Least error of a joint by key points that is assumed: the mean is 3.5 degrees in films of studio
motions, 10 to 14 in real ones."""
HEAD_JOINTS = (12, 15)
"""Neck and head."""


def apply_fit(capture: Capture, fit: CaptureFit, *, height_m: float | None = None) -> Capture:
    """The capture with the changes of a fit, and a note about them.

    A static camera shows only the ratio of size and distance: the person keeps its size. A stated
    height stays, and the person of a finished avatar does not change at all.
    """
    notes = (fit.describe(),) if fit.share else ()
    made = Provenance("fit", "outlines of the masks", notes, fit.share, fit.as_json())
    if not fit.share:
        return capture.with_part(made, fits=(*capture.fits, fit))
    geometry = capture.geometry()
    motion, cameras = fit.correct_motion(geometry), capture.cameras.scale_focal(fit.focal_factor)
    shaped = fit.shape(capture.shaped) if fit.fits_body else capture.shaped
    if height_m is None and not cameras.is_moving:
        a, b = (each.joints - each.joints[0] for each in (capture.shaped, shaped))
        height_m = shaped.height_m * float((a * b).sum() / (b * b).sum())  # least squares
    if height_m is not None and fit.fits_body:
        sized = shaped.scaled_to(height_m)
        there = CaptureGeometry.of(motion, cameras, capture.source)
        motion, shaped = rescale_motion(there, shaped, sized), sized
    return capture.with_part(
        made, motion=motion, shaped=shaped, cameras=cameras, fits=(*capture.fits, fit)
    )


def fit_capture(capture: Capture, *, fit_body: bool = True) -> CaptureFit | None:
    """Fit a capture to the masks of some frames, and to its key points if its poses have some.

    Poses with key points are a first guess made of these alone, and are always changed. Without
    `fit_body` proportions stay, as those of an avatar's person.

    Returns None if there are no masks that could be fitted, or if the poses were tracked here:
    then they were fitted before.
    """
    tracked = capture.motion.keypoints is not None
    if fit_body and capture.motion.is_fitted:
        return None
    fitter = make_fitter(capture, TRACKED_KEY_FRAMES if tracked else KEY_FRAMES)
    if fitter is None:
        return None
    everything = FitParameters(proportions=fit_body, focal=not capture.cameras.is_moving)
    pixel_cm = 100.0 * capture.pixel_footprint_m() * _reduction(capture, fitter)
    share, keypoint_share = 1.0, 0.0
    if tracked:
        settling = _fit_tracked(fitter, everything)
    else:
        settling = _iterate_until_settled(fitter, everything)
        share = share_beyond_noise(fitter.corrections, settling[-1] * pixel_cm)
        error_rad = math.sqrt(share) * _expected_error_rad(fitter)
        count = min(_count_keypoint_frames(error_rad), capture.source.frame_count or 1)
        further = _with_more_masks(capture, fitter, count) if count >= MORE_MASKS else None
        if further is not None:
            fitter = further
            settling += _iterate_until_settled(fitter, everything)
            error_rad = math.sqrt(share) * _expected_error_rad(fitter)
        keypoint_share = _take_keypoints(capture, fitter, error_rad)
    before, after = settling[0], settling[-1]
    return CaptureFit(
        coefficients=share * fitter.coefficients,
        focal_factor=float(np.exp(share * fitter.log_focal)),
        corrections=share * _interpolate_corrections(capture, fitter),
        error_before_cm=before * pixel_cm,
        error_after_cm=after * pixel_cm,
        share=share,
        keypoint_share=keypoint_share,
        fits_body=fit_body,
    )


def _take_keypoints(capture: Capture, fitter: ClipFitter, error_rad: float) -> float:
    """Fit given poses once more, near them and those by key points; return the latter's weight.

    The given poses are expected to err by `error_rad`. The weight, the joints' mean, is 0 if the
    person is not found, or if key points would count by less than a twentieth.
    """
    count = _count_keypoint_frames(error_rad)
    if count < MIN_FRAMES:
        return 0.0
    track = _find_keypoints(capture, fitter, _choose_frames(fitter.frames, count))
    if len(track) < MIN_FRAMES:
        return 0.0
    rows = np.flatnonzero(np.isin(fitter.numbers, track.frames)).tolist()
    beside = ClipFitter(
        fitter.given.rows(rows),
        fitter.model.space,
        [fitter.frames[row] for row in rows],
        track=track,
        weights=TRACKED_WEIGHTS,
    )
    beside.take_person(fitter)
    beside.poses = fitter.poses.rows(rows)
    beside.iterate_stages(POSES_ALONE, keypoint_count=4, outline_count=3)
    steps = beside.poses.steps_from(fitter.poses.rows(rows), beside.camera_rotations)
    weights = weigh_joints(steps, error_rad)
    each_weight = np.repeat(np.append(weights, weights[0]), 3)  # the root's place as it turns
    each_step = [np.interp(fitter.numbers, beside.numbers, each) for each in steps.T]
    turns, further = fitter.camera_rotations, np.column_stack(each_step)
    stated = fitter.as_stated(fitter.poses.moved(further, turns))
    fitter.expect(fitter.given.moved(each_weight * stated.steps_from(fitter.given, turns), turns))
    fitter.poses = fitter.poses.moved(each_weight * further, turns)
    fitter.iterate_stages(POSES_ALONE, 0, 3)
    return float(weights[1:22].mean())


def _expected_error_rad(fitter: ClipFitter) -> float:
    """Error that outlines leave in given poses, mean over the joints, by how far they turned."""
    joints = fitter.corrections[:, 3:66].reshape(-1, 21, 3)  # without hands' inner ones and root
    # 0.9 to 1.3 in films of studio motions, 1.7 to 2.3 in real ones
    return 1.2 * float(np.linalg.norm(joints, axis=2).mean())


def _count_keypoint_frames(error_rad: float) -> int:
    """Number of frames in which key points are found: the further given poses err, the more."""
    ratio = (error_rad / LEAST_ERROR_RAD) ** 2
    # 60 frames (30 core-ms each) if both are expected to count alike
    return min(round(60 * ratio), TRACKED_KEY_FRAMES)


def _with_more_masks(capture: Capture, fitter: ClipFitter, count: int) -> ClipFitter | None:
    """A fit to the masks of more frames, from where that of fewer ended; None without enough."""
    further = make_fitter(capture, count)
    if further is not None:
        further.take_person(fitter)
        steps = [np.interp(further.numbers, fitter.numbers, each) for each in fitter.corrections.T]
        further.poses = further.given.moved(np.column_stack(steps), further.camera_rotations)
    return further


def weigh_joints(
    steps: Float[np.ndarray, "frames 75"], given_error_rad: float
) -> Float[np.ndarray, "24"]:
    """Weight of each joint by key points, from given poses that err so far to these by `steps`."""
    least = np.full(24, LEAST_ERROR_RAD)
    # points are 2 cm off; a face's lie within 8 cm of the axis about which it turns
    least[list(HEAD_JOINTS)] = math.radians(14.0)
    apart2 = (steps[:, :72].reshape(-1, 24, 3) ** 2).sum(axis=2).mean(axis=0)
    return given_error_rad**2 / np.maximum(apart2, given_error_rad**2 + least**2)


def share_beyond_noise(corrections: Float[np.ndarray, "frames 75"], error_cm: float) -> float:
    """Share of corrections of poses that is more than the fit's noise: 1 - noise² / change².

    Corrections are root and joint rotations, radians, and root positions; `error_cm` is the
    distance of outlines of body and masks that the fit leaves.
    """
    squares = (corrections[:, :72].reshape(-1, 24, 3) ** 2).sum(axis=2).mean(axis=0)
    change_deg = float(np.degrees(np.sqrt(squares[0] + squares[1:].mean())))  # a root moves all
    return max(0.0, 1.0 - (NOISE_DEG_PER_CM * error_cm / max(change_deg, 1e-9)) ** 2)


def _fit_tracked(fitter: ClipFitter, everything: FitParameters) -> list[float]:
    """Fits to key points, then with outlines, then poses alone to outlines that count more.

    Returns the error before each iteration with outlines.
    """
    errors = fitter.iterate_stages(everything, keypoint_count=3, outline_count=3)
    fitter.weights = TRACKED_POSE_WEIGHTS
    poses = everything._replace(proportions=False, focal=False)
    return errors + fitter.iterate_stages(poses, 0, POSE_ITERATIONS)


def _iterate_until_settled(fitter: ClipFitter, fitted: FitParameters) -> list[float]:
    """Iterates 4 to 12 times, until the error decreases by less than 1 %; the error before each."""
    errors: list[float] = []
    for number in range(12):
        errors.append(fitter.iterate(fitted))
        if number >= 3 and errors[-1] > 0.99 * errors[-2]:
            break
    return errors


def make_fitter(capture: Capture, mask_count: int = TRACKED_KEY_FRAMES) -> ClipFitter | None:
    """The problem of a capture's spread masks and key points; None without enough of them."""
    track = capture.motion.keypoints
    geometry, space = capture.geometry(), ProportionSpace.around(capture.shaped)
    samples = {
        sample.index: sample
        for sample in read_silhouettes(capture, mask_count)
        if geometry.row_for_frame(sample.index) is not None
    }
    others = _spread_frames(capture.source) if track is None else track.frames.tolist()
    numbers = {*samples, *others}
    sizes = [each.alpha.shape[::-1] for each in samples.values()]
    size_px = sizes[0] if sizes else _reduced_size_px(capture)
    camera_row = associate_cameras(capture.cameras, capture.source)
    rows, frames = list[int](), list[ClipFrame]()
    for number in sorted(numbers - capture.cameras.frames_without_camera):
        row = geometry.row_for_frame(number)
        if row is not None:
            camera, sample = geometry.camera_at(camera_row(number), size_px), samples.get(number)
            mask = picture = None
            if sample is not None:
                mask, picture = OutlineDistances.of(sample.alpha, camera), sample.picture
            rows.append(row)
            frames.append(
                ClipFrame(number=float(number), camera=camera, mask=mask, picture=picture)
            )
    if len(frames) < MIN_FRAMES or (track is None and len(samples) < MIN_FRAMES):
        return None
    weights = TRACKED_WEIGHTS if track is not None and samples else USUAL_WEIGHTS
    given = ClipPoses.of(capture.motion, rows)
    return ClipFitter(given, space, frames, track=track, weights=weights)


def _spread_frames(source: FrameSource) -> range:
    """Numbers of at most 150 frames, evenly spread: between masks, poses follow their neighbors."""
    chosen, count = source.selection, source.frame_count or 1
    stride = chosen.step * -(-count // 150)
    return range(chosen.start, chosen.start + count * chosen.step, stride)


def _reduced_size_px(capture: Capture) -> tuple[int, int]:
    """Size at which a person, by its key points, is as tall as in reduced masks."""
    track, (width, height) = capture.motion.keypoints, capture.source.size_px
    if track is None or not len(track):
        return width, height
    tall = float(np.median(np.ptp(track.image_px[..., 1], axis=1))) * height / track.size_px[1]
    scale = min(1.0, OUTLINE_PERSON_PX / max(tall, 1.0))
    return max(8, round(scale * width)), max(8, round(scale * height))


def fitted_motion(capture: Capture, fit: CaptureFit) -> Motion:
    """Tracked poses after their fit, as a pose file holds them: with proportions, and a static K.

    The fit is of poses made of key points, for the mean body.
    """
    moved = fit.correct_motion(capture.geometry())
    betas = SIGMA_BETA * fit.coefficients[: capture.shaped.body.shape_directions.shape[-1]]
    cameras = capture.cameras.scale_focal(fit.focal_factor)
    intrinsic = None if cameras.is_moving else cameras[0].intrinsic
    return replace(moved, betas=betas, proportions=fit.coefficients, intrinsic=intrinsic)


def _reduction(capture: Capture, fitter: ClipFitter) -> float:
    """Size of a pixel of the reduced masks, in pixels that training sees."""
    longer = max(capture.source.size_px)
    return min(capture.size_px, longer) / max(fitter.frames[0].camera.size_px)


def _interpolate_corrections(capture: Capture, fitter: ClipFitter) -> Float[np.ndarray, "poses 75"]:
    """A correction for each row of the motion, linear in time between the fitted frames."""
    rows = np.nan_to_num(capture.geometry().row_frames)
    return np.column_stack([np.interp(rows, fitter.numbers, c) for c in fitter.corrections.T])


def _choose_frames(frames: Sequence[ClipFrame], count: int) -> list[ClipFrame]:
    """Choose `count` frames, evenly spread, those with outlines first."""
    outlined = [frame for frame in frames if frame.mask is not None]
    others = [frame for frame in frames if frame.mask is None]
    chosen = [outlined[n] for n in spaced_indices(len(outlined), count)]
    chosen += [others[n] for n in spaced_indices(len(others), count - len(chosen))]
    return sorted(chosen, key=lambda frame: frame.number)


def _find_keypoints(
    capture: Capture, fitter: ClipFitter, frames: Sequence[ClipFrame]
) -> KeypointTrack:
    """Key points of the person in some of a fit's frames, where the fitted poses put the body."""
    from preprocess.tracking.blazepose import PosedPersonFinder  # loads onnxruntime

    places = dict(zip(fitter.numbers.astype(int).tolist(), range(len(fitter.frames)), strict=True))
    wanted = [int(frame.number) for frame in frames]
    find = PosedPersonFinder(fitter.model.space.shape(fitter.coefficients))
    source, camera_row = capture.source, associate_cameras(capture.cameras, capture.source)
    zoom = float(np.exp(fitter.log_focal))
    persons = dict[int, PersonKeypoints]()
    times_s = dict[int, float]()
    size_px, step = source.size_px, int(np.gcd.reduce(np.diff(wanted)))
    pictures: Iterable[Frame] = [each.picture for each in frames if each.picture is not None]
    if len(pictures) < len(frames):
        pictures = reopen(source, slice(wanted[0], wanted[-1] + 1, step)).frames()
    for frame in pictures:
        if frame.index not in wanted or "corrupt" in frame.flags:
            continue
        size_px = frame.size_px
        camera = capture.cameras[camera_row(frame.index)].scale_focal(zoom).resize(size_px)
        try:
            person, _ = find(frame.rgb, fitter.poses[places[frame.index]], camera)
        except InputError:  # the body is outside the image
            continue
        if person.presence >= MIN_PRESENCE:
            persons[frame.index], times_s[frame.index] = person, frame.time_s
    return KeypointTrack.of(list(persons), list(persons.values()), size_px, list(times_s.values()))
