"""Aligns an opened capture to its masks: body, poses and focal length at once.

The fit would change exact poses, too, by its own noise. How much of its changes is made follows
from how much larger they are than that noise (Wiener's factor), without a step: nothing of those of
exact poses, nearly all of those of a tracker's.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from capture.source import FrameSource
from preprocess.alignment.capture_geometry import CaptureGeometry, rescale_motion
from preprocess.body.body_pose import Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import SIGMA_BETA, ProportionSpace
from preprocess.capture_session import Capture, Provenance
from preprocess.fitting.capture_fit import CaptureFit
from preprocess.fitting.clip_fitting import (
    TRACKED_WEIGHTS,
    USUAL_WEIGHTS,
    ClipFitter,
    ClipFrame,
    EvidenceWeights,
    FitParameters,
)
from preprocess.fitting.keypoint_poses import blend_poses, weigh_keypoint_poses
from preprocess.fitting.outlines import OUTLINE_PERSON_PX, OutlineDistances
from preprocess.fitting.silhouettes import read_silhouettes
from preprocess.observation import associate_cameras

KEY_FRAMES = 50
"""Frames, evenly spread, whose masks are fitted."""
CHAIN_FRAMES = 150
"""Frames, evenly spread, whose given poses are fitted: those without a mask follow their neighbors
and are human; poses between them follow."""
MIN_ITERATIONS = 4
"""Fewest Gauss-Newton iterations."""
MAX_ITERATIONS = 12
"""Most Gauss-Newton iterations."""
TRACKED_KEY_FRAMES = 300
"""Frames, evenly spread, whose masks are fitted together with key points."""
KEYPOINT_ITERATIONS = 5
"""Iterations with key points alone, after which the body is near its outline."""
TRACKED_ITERATIONS = 3
"""Iterations with outlines after that."""
POSE_ITERATIONS = 2
"""Iterations over poses alone after those, with `TRACKED_POSE_WEIGHTS`."""
TRACKED_POSE_WEIGHTS = EvidenceWeights(outline_rows=480.0, keypoints=0.6)
"""Weights while poses alone are fitted: with these, proportions would follow the clothes."""
BLENDED_ITERATIONS = 3
"""Iterations over poses alone, once key points count beside given poses."""
MIN_ERROR_DECREASE = 0.01
"""Relative decrease of the error below which the iterations end."""
NOISE_DEG_PER_CM = 1.5
"""Rotation by which the fit changes exact poses, degrees for each cm by which outlines still differ
after it (1.4, 1.4 and 1.55 on three exact captures; a tracker's, real and simulated: 5 to 8)."""
MIN_FRAMES = 4
"""Fewest frames with a usable mask for which an alignment is attempted."""


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
    motion, cameras = fit.correct_motion(geometry), fit.scale_focal_lengths(capture.cameras)
    shaped = fit.shape(capture.shaped) if fit.fits_body else capture.shaped
    if height_m is None and not cameras.is_moving:
        height_m = shaped.height_m * _size_ratio(capture.shaped, shaped)
    if height_m is not None and fit.fits_body:
        sized = shaped.scaled_to(height_m)
        there = CaptureGeometry.of(motion, cameras, capture.source)
        motion, shaped = rescale_motion(there, shaped, sized), sized
    return capture.with_part(
        made, motion=motion, shaped=shaped, cameras=cameras, fits=(*capture.fits, fit)
    )


def _size_ratio(one: ShapedBody, other: ShapedBody) -> float:
    """Size of one person relative to another, by least squares over their joints."""
    a, b = one.joints - one.joints[0], other.joints - other.joints[0]
    return float((a * b).sum() / (b * b).sum())


def fit_capture(capture: Capture, *, fit_body: bool = True) -> CaptureFit | None:
    """Fit a capture to the masks of a few frames, and to its key points if its poses have some.

    Poses with key points are a first guess made of these alone, and are always changed. Without
    `fit_body` proportions stay, as those of an avatar's person.

    Returns None if there are no masks that could be fitted, or if the poses were tracked here:
    then they were fitted before.
    """
    tracked = capture.motion.keypoints is not None
    if fit_body and capture.motion.is_fitted:
        return None
    fitter = make_fitter(capture)
    if fitter is None:
        return None
    everything = FitParameters(proportions=fit_body, focal=not capture.cameras.is_moving)
    if tracked:
        settling = _fit_tracked(fitter, everything)
    else:
        settling = _iterate_until_settled(fitter, everything)
    before, after = settling[0], settling[-1]
    pixel_cm = 100.0 * capture.pixel_footprint_m() * _reduction(capture, fitter)
    share = 1.0 if tracked else share_beyond_noise(fitter.corrections, after * pixel_cm)
    keypoint_share = 0.0
    if not tracked and share:
        keypoint_share = _take_keypoints(capture, fitter, share)
    corrections = fitter.corrections
    return CaptureFit(
        coefficients=share * fitter.coefficients,
        focal_factor=float(np.exp(share * fitter.log_focal)),
        corrections=share * _interpolate_corrections(capture, fitter, corrections),
        error_before_cm=before * pixel_cm,
        error_after_cm=after * pixel_cm,
        share=share,
        keypoint_share=keypoint_share,
        fits_body=fit_body,
    )


def _take_keypoints(capture: Capture, fitter: ClipFitter, share: float) -> float:
    """Fit poses once more, near given ones and those by key points; return the latter's weight."""
    evidence = weigh_keypoint_poses(capture, fitter, share)
    if evidence is None:
        return 0.0
    turns, weight = fitter.camera_rotations, evidence.weight
    fitter.expect(blend_poses(fitter.given, fitter.as_stated(evidence.poses), weight, turns))
    fitter.poses = blend_poses(fitter.poses, evidence.poses, weight, turns)
    for _ in range(BLENDED_ITERATIONS):
        fitter.iterate(FitParameters(proportions=False, focal=False))
    return weight


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
    for _ in range(KEYPOINT_ITERATIONS):
        fitter.iterate(everything._replace(outlines=False))
    errors = [fitter.iterate(everything) for _ in range(TRACKED_ITERATIONS)]
    fitter.weights = TRACKED_POSE_WEIGHTS
    poses = everything._replace(proportions=False, focal=False)
    return errors + [fitter.iterate(poses) for _ in range(POSE_ITERATIONS)]


def _iterate_until_settled(fitter: ClipFitter, fitted: FitParameters) -> list[float]:
    """Iterates until the error hardly decreases; returns it before each iteration."""
    errors: list[float] = []
    while len(errors) < MAX_ITERATIONS:
        errors.append(fitter.iterate(fitted))
        settled = errors[-1] > (1.0 - MIN_ERROR_DECREASE) * errors[max(len(errors) - 2, 0)]
        if len(errors) >= MIN_ITERATIONS and settled:
            break
    return errors


def make_fitter(capture: Capture) -> ClipFitter | None:
    """The problem of a capture's spread masks and key points; None without enough of them."""
    track = capture.motion.keypoints
    geometry, space = capture.geometry(), ProportionSpace.around(capture.shaped)
    count = TRACKED_KEY_FRAMES if track else KEY_FRAMES
    samples = {
        sample.index: sample
        for sample in read_silhouettes(capture, count)
        if geometry.row_for_frame(sample.index) is not None
    }
    others = _spread_frames(capture.source) if track is None else track.frames.tolist()
    numbers = {*samples, *others}
    sizes = [each.alpha.shape[::-1] for each in samples.values()]
    size_px = sizes[0] if sizes else _reduced_size_px(capture)
    camera_row, frames = associate_cameras(capture.cameras, capture.source), []
    for number in sorted(numbers - capture.cameras.frames_without_camera):
        row = geometry.row_for_frame(number)
        if row is not None:
            camera, sample = geometry.camera_at(camera_row(number), size_px), samples.get(number)
            mask = picture = None
            if sample is not None:
                mask, picture = OutlineDistances.of(sample.alpha, camera), sample.picture
            frames.append(
                ClipFrame(row=row, number=float(number), camera=camera, mask=mask, picture=picture)
            )
    if len(frames) < MIN_FRAMES or (track is None and len(samples) < MIN_FRAMES):
        return None
    if track is None:
        return ClipFitter(capture.motion, space, frames)
    return ClipFitter(
        capture.motion,
        space,
        frames,
        track=track,
        weights=TRACKED_WEIGHTS if samples else USUAL_WEIGHTS,
    )


def _spread_frames(source: FrameSource) -> range:
    """Numbers of at most `CHAIN_FRAMES` frames, evenly spread."""
    chosen, count = source.selection, source.frame_count or 1
    stride = chosen.step * -(-count // CHAIN_FRAMES)
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
    cameras = fit.scale_focal_lengths(capture.cameras)
    intrinsic = None if cameras.is_moving else cameras[0].intrinsic
    return replace(moved, betas=betas, proportions=fit.coefficients, intrinsic=intrinsic)


def _reduction(capture: Capture, fitter: ClipFitter) -> float:
    """Size of a pixel of the reduced masks, in pixels that training sees."""
    longer = max(capture.source.size_px)
    return min(capture.size_px, longer) / max(fitter.frames[0].camera.size_px)


def _interpolate_corrections(
    capture: Capture, fitter: ClipFitter, corrections: Float[np.ndarray, "frames 75"]
) -> Float[np.ndarray, "poses 75"]:
    """A correction for each row of the motion, linear in time between the fitted frames."""
    numbers = np.array([frame.number for frame in fitter.frames])
    rows = np.nan_to_num(capture.geometry().row_frames)
    return np.column_stack([np.interp(rows, numbers, each) for each in corrections.T])
