"""The coarse start of a capture's fit: distance, pelvis and an unknown focal length, by mask boxes.

Poses may be for a body of another size, and a camera may be a guess. All poses then move together,
so that the box around the posed body becomes the box of the mask in every frame.
Rotations stay. What frames do not share is left to the fit of poses.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from scipy.optimize import least_squares

from capture.camera import Vector3
from capture.source import AlphaMask
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.silhouette_objective import MaskSample, SilhouetteObjective, mean_score
from preprocess.body.body_surface import NEAR_PLANE_M, SkinPoints
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.capture_session import Capture
from preprocess.fitting.outlines import IMAGE_BORDER_PX
from preprocess.fitting.silhouettes import read_first_silhouettes

SIGMA_SIDE_PX = 3.0
"""Error of a box's side, px of the reduced masks, beyond which it counts ever less (Cauchy)."""
MIN_AGREEMENT = 0.6
"""Mean IoU of body and masks from which a start is taken, 0.01 better than before."""


class _Start(NamedTuple):
    """A geometry whose body is near the masks.

    Attributes:
        magnification: Size of the masks' boxes relative to the posed body's.
        shift_m: Shift of the pelvis in the root's axes; empty if only the focal length is changed.
        before, after: Mean IoU of body and masks.
    """

    geometry: CaptureGeometry
    magnification: float
    shift_m: Float[np.ndarray, "axes"]
    before: float
    after: float

    @property
    def is_taken(self) -> bool:
        """Whether body and masks agree better by it, and well enough."""
        return self.after >= max(MIN_AGREEMENT, self.before + 0.01)


def start_distances(
    capture: Capture, *, own: ShapedBody | None = None
) -> tuple[Capture, str, dict[str, Any] | None]:
    """Divide distances from the cameras and shift the pelvis, so that the body fits the masks.

    `own` is the body as it is, whose proportions are taken if they fit better than the capture's:
    files state SMPL for poses that were fitted to another body. Returns the capture, words for
    people, and figures for the report.
    """
    samples = read_first_silhouettes(capture)
    if not samples:
        note = (
            "There are no masks, and where the poses put the body no person was found in the "
            "images; distances stay as they are. Do poses and video belong together? Give --masks, "
            "from which ia-check can find what is wrong, or your own SMPL file (--body)."
        )
        return capture, "" if capture.masks.is_given else note, None
    start = _find_start(capture, samples, by_focal_length=False)
    if own is not None:
        other = _find_start(replace(capture, shaped=own), samples, by_focal_length=False)
        if other.is_taken and other.after > start.after + 0.02:  # of mean IoU
            capture, start = replace(capture, shaped=own), other
    moved_cm = 100.0 * float(np.linalg.norm(start.shift_m))
    figures = {
        "taken": start.is_taken,
        "agreement_before": round(start.before, 4),
        "agreement_after": round(start.after, 4),
        "distances_divided_by": round(start.magnification, 4),
        "pelvis_moved_cm": round(moved_cm, 2),
    }
    agreed = f"{start.before:.2f} before, {start.after:.2f} after"
    if start.is_taken:
        note = (
            f"Distances were divided by {start.magnification:.3f} and the pelvis moved by "
            f"{moved_cm:.1f} cm to fit the masks: agreement {agreed}."
        )
        return replace(capture, motion=start.geometry.motion), note, figures
    if start.after < MIN_AGREEMENT:
        note = (
            f"Their distances could not be fitted to the masks ({agreed}); they stay as they are."
        )
    else:
        note = f"Distances fit the masks, as they are (agreement {agreed})."
    return capture, note, figures


def start_focal_length(capture: Capture) -> Capture:
    """Multiply a focal length that no file states, so that the body fits the masks."""
    samples = read_first_silhouettes(capture)
    start = _find_start(capture, samples, by_focal_length=True) if samples else None
    if start is None or not start.is_taken:
        return capture
    usual_px = capture.cameras[0].focal_px[0]
    cameras = replace(
        capture.cameras.scale_focal(start.magnification),
        source="focal length found from the masks",
        note=f"No camera was given; a focal length of {start.magnification * usual_px:.0f} px was "
        f"found from the masks: with it they agree with the body by {start.after:.2f}, with the "
        f"usual {usual_px:.0f} px by {start.before:.2f}.",
    )
    return replace(capture, cameras=cameras)


def _find_start(
    capture: Capture, samples: tuple[MaskSample, ...], *, by_focal_length: bool
) -> _Start:
    """Bring the boxes of body and masks together by the robust least squares of their sides."""
    shaped, stated = capture.shaped, capture.geometry()
    objective = SilhouetteObjective(samples=samples, skin=SkinPoints.of(shaped))

    def geometry_of(numbers: Float[np.ndarray, "numbers"]) -> CaptureGeometry:
        magnification = float(np.exp(numbers[0]))
        if by_focal_length:
            intrinsics = stated.intrinsics.copy()
            intrinsics[:, [0, 1], [0, 1]] *= magnification
            return replace(stated, intrinsics=intrinsics)
        return _place(stated, shaped, magnification, numbers[1:])

    bodies = list(_bodies_before_camera(stated, objective))
    # 0.2 m: from one side, a smaller distance and a shift towards the camera look alike
    prior = SIGMA_SIDE_PX * np.sqrt(max(4 * len(bodies), 1)) / 0.2

    def distances_px(numbers: Float[np.ndarray, "numbers"]) -> Float[np.ndarray, "rows"]:
        """Of the sides of both boxes, and the shift's prior; none at the image's border."""
        geometry, off = geometry_of(numbers), [prior * numbers[1:]]
        moved = geometry.motion.root_translations - stated.motion.root_translations
        for sample, row, points, sides in bodies:
            camera = geometry.camera_at(sample.camera_row, objective.size_px)
            pixels = camera.project(points + moved[row])
            off.append(np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]) - sides)
        return np.nan_to_num(np.concatenate(off))

    start = np.zeros(1 if by_focal_length else 4)
    found = start
    if bodies:
        found = least_squares(distances_px, start, loss="cauchy", f_scale=SIGMA_SIDE_PX).x
    geometry = geometry_of(found)
    before, after = (mean_score(objective.frame_scores(each)) for each in (stated, geometry))
    return _Start(geometry, float(np.exp(found[0])), found[1:], before, after)


def _place(
    geometry: CaptureGeometry, shaped: ShapedBody, divisor: float, shift_m: Vector3
) -> CaptureGeometry:
    """Divide each pelvis's distance from its own camera, then shift it in the root's axes."""
    eyes = geometry.camera_centers()[geometry.camera_rows()]
    pelves = shaped.joints[0] + geometry.motion.root_translations
    turned = rotation_matrices(geometry.motion.root_rotations) @ shift_m
    places = eyes + (pelves - eyes) / divisor + turned - shaped.joints[0]
    return replace(geometry, motion=replace(geometry.motion, root_translations=places))


def _bodies_before_camera(
    geometry: CaptureGeometry, objective: SilhouetteObjective
) -> Iterator[tuple[MaskSample, int, Float32[np.ndarray, "points 3"], Float[np.ndarray, "4"]]]:
    """Masks whose frames have a pose before the camera, with its row, the skin and their sides."""
    for sample in objective.samples:
        row = geometry.row_for_frame(sample.index)
        if row is not None:
            points = objective.posed_points(geometry.motion, row)
            view = geometry.camera_at(sample.camera_row, objective.size_px).camera_from_world[2]
            if (points @ view[:3] + view[3]).min() > NEAR_PLANE_M:
                yield sample, row, points, _sides_of_mask(sample.alpha)


def _sides_of_mask(alpha: AlphaMask) -> Float[np.ndarray, "4"]:
    """Left, top, right and bottom of a mask, px; NaN at the image's border or in an empty mask."""
    size = np.array(alpha.shape[::-1], dtype=np.float64)
    columns, lines = (np.flatnonzero((alpha > 0.5).any(axis=axis)) for axis in (0, 1))
    if not len(columns):
        return np.full(4, np.nan)
    low = np.array([columns[0], lines[0]], dtype=np.float64)
    high = np.array([columns[-1], lines[-1]], dtype=np.float64) + 1.0
    low[low < IMAGE_BORDER_PX] = np.nan
    high[high > size - IMAGE_BORDER_PX] = np.nan
    return np.concatenate([low, high])
