"""Aligns an opened capture to its masks: body, poses and focal length at once.

Exact poses are left alone: nothing is changed where the roots would hardly turn, or where
proportions and focal length alone bring the outlines as close to the masks as corrected poses do.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from capture.input_error import InputError
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.mask_alignment import body_height_m, rescale_motion, scale_to_height
from preprocess.alignment.silhouette_objective import sample_masks
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.proportion_space import ProportionSpace
from preprocess.body.silhouette import SkinPoints
from preprocess.capture_session import Capture
from preprocess.fitting.capture_fit import CaptureFit
from preprocess.fitting.clip_fitting import ClipFitter, ClipFrame, FitParameters
from preprocess.fitting.outlines import OUTLINE_PERSON_PX, OutlineDistances
from preprocess.observe import associate_cameras, associate_masks

KEY_FRAMES = 120
"""Frames, evenly spread, whose masks are fitted; poses between them follow their neighbors."""
MIN_ITERATIONS = 6
"""Fewest Gauss-Newton iterations; the first ones may overshoot."""
MAX_ITERATIONS = 12
"""Most Gauss-Newton iterations."""
PROPORTION_ITERATIONS = 4
"""Iterations that show how well proportions and focal length alone explain the masks."""
MIN_ERROR_DECREASE = 0.01
"""Relative decrease of the error below which the iterations end."""
MAX_ERROR_RATIO = 0.9
"""Ratio of the errors with and without corrected poses above which the poses are exact."""
MIN_ROOT_TURN_DEG = 1.0
"""Mean rotation of the roots below which the poses are exact, degrees."""
MIN_FRAMES = 4
"""Fewest frames with a usable mask for which an alignment is attempted."""


def apply_fit(capture: Capture, fit: CaptureFit, *, height_m: float | None = None) -> Capture:
    """The capture with the changes of a fit, and a note about them.

    A static camera shows only the ratio of size and distance: the person keeps its size. The
    person of a finished avatar does not change at all.

    Args:
        capture: The capture that was fitted.
        fit: Its fit.
        height_m: The person's stated height, which stays; metres.
    """
    if not fit.taken:
        return replace(capture, fit=fit)
    geometry = CaptureGeometry.of(capture.motion, capture.cameras, capture.source)
    motion, cameras = fit.correct_motion(geometry), fit.scale_focal_lengths(capture.cameras)
    shaped = fit.shape(capture.shaped) if fit.fits_body else capture.shaped
    if height_m is None and not cameras.is_moving:
        height_m = body_height_m(shaped) * _size_ratio(capture.shaped, shaped)
    if height_m is not None and fit.fits_body:
        sized = scale_to_height(shaped, height_m)
        there = CaptureGeometry.of(motion, cameras, capture.source)
        motion, shaped = rescale_motion(there, shaped, sized), sized
    return replace(
        capture, motion=motion, shaped=shaped, cameras=cameras, fit=fit,
        notes=(*capture.notes, fit.describe()),
    )  # fmt: skip


def _size_ratio(one: ShapedBody, other: ShapedBody) -> float:
    """How many times as large one person is as another, by least squares over their joints."""
    a, b = one.joints - one.joints[0], other.joints - other.joints[0]
    return float((a * b).sum() / (b * b).sum())


def fit_capture(capture: Capture, *, fit_body: bool = True) -> CaptureFit | None:
    """Fit a capture to the masks of a few frames.

    Args:
        capture: A recording with masks.
        fit_body: Whether proportions may change; not where an avatar's person is given.

    Returns:
        The changes; None if there are no masks that could be fitted.
    """
    fitter = _make_fitter(capture)
    if fitter is None:
        return None
    before = fitter.error_px()
    focal = not capture.cameras.is_moving
    without_poses = FitParameters(poses=False, proportions=fit_body, focal=focal)
    for _ in range(PROPORTION_ITERATIONS):
        fitter.iterate(without_poses)
    explained, everything = fitter.error_px(), without_poses._replace(poses=True)
    errors: list[float] = []
    while len(errors) < MAX_ITERATIONS:
        errors.append(fitter.iterate(everything))
        settled = errors[-1] > (1.0 - MIN_ERROR_DECREASE) * errors[max(len(errors) - 2, 0)]
        if len(errors) >= MIN_ITERATIONS and settled:
            break
    after = fitter.error_px()
    turned = np.degrees(np.linalg.norm(fitter.corrections[:, :3], axis=1).mean())
    geometry = CaptureGeometry.of(capture.motion, capture.cameras, capture.source)
    pixel_cm = 100.0 * capture.pixel_footprint_m() * _reduction(capture, fitter)
    return CaptureFit(
        coefficients=fitter.coefficients,
        focal_factor=float(np.exp(fitter.log_focal)),
        corrections=_interpolate_corrections(fitter, geometry),
        error_before_cm=before * pixel_cm,
        error_after_cm=after * pixel_cm,
        taken=bool(after < MAX_ERROR_RATIO * explained and turned > MIN_ROOT_TURN_DEG),
        fits_body=fit_body,
    )


def _make_fitter(capture: Capture) -> ClipFitter | None:
    """The problem of a capture's evenly spread masks; None without enough of them."""
    if capture.live is not None or (capture.masks is None and not capture.source.has_alpha):
        return None
    geometry = CaptureGeometry.of(capture.motion, capture.cameras, capture.source)
    try:
        objective = sample_masks(
            capture.source,
            capture.masks,
            associate_masks(capture.masks, capture.source),
            associate_cameras(capture.cameras, capture.source),
            SkinPoints.of(capture.shaped, 1),
            count=KEY_FRAMES,
            person_px=OUTLINE_PERSON_PX,
            excluded_frames=capture.cameras.frames_without_camera,
        )
    except InputError:  # parts that do not fit are reported elsewhere
        return None
    frames = []
    for sample in objective.samples:
        row = geometry.row_for_frame(sample.index)
        if row is not None:
            camera = geometry.camera_at(sample.camera_row, objective.size_px)
            mask = OutlineDistances.of(sample.alpha, camera)
            frames.append(ClipFrame(row=row, number=float(sample.index), mask=mask))
    if len(frames) < MIN_FRAMES:
        return None
    return ClipFitter(capture.motion, ProportionSpace.around(capture.shaped), frames)


def _reduction(capture: Capture, fitter: ClipFitter) -> float:
    """Size of a pixel of the reduced masks, in pixels that training sees."""
    longer = max(capture.source.size_px)
    return min(capture.size_px or longer, longer) / max(fitter.frames[0].mask.distance.shape)


def _interpolate_corrections(
    fitter: ClipFitter, geometry: CaptureGeometry
) -> Float[np.ndarray, "poses 75"]:
    """A correction for each row of the motion, linear in time between the fitted frames."""
    numbers = np.array([frame.number for frame in fitter.frames])
    rows = np.nan_to_num(geometry.row_frames)
    return np.column_stack([np.interp(rows, numbers, each) for each in fitter.corrections.T])
