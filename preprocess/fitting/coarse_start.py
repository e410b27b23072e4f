"""The coarse start of a capture's fit: distance, pelvis and an unknown focal length, by mask boxes.

Poses may be for a body of another size, and a camera may be a guess. All poses then move together,
so that the box around the posed body becomes the box of the mask in every frame: linear least
squares over the boxes' sides. Rotations stay. What frames do not share is left to the fit of poses.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from capture.source import AlphaMask
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.silhouette_objective import MaskSample, SilhouetteObjective, mean_score
from preprocess.body.body_surface import NEAR_PLANE_M, SkinPoints
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.capture_session import Capture
from preprocess.fitting.outlines import IMAGE_BORDER_PX
from preprocess.fitting.silhouettes import read_first_silhouettes

START_FRAMES = 16
"""Frames whose boxes are compared."""
ROUNDS = 4
"""Times that the linear equations are solved, each time around the place found before."""
SIGMA_SHIFT_M = 0.2
"""Prior standard deviation of the pelvis's shift, metres: from one side, a smaller distance and a
shift towards the camera look alike."""
SIGMA_SIDE_PX = 3.0
"""Error of a box's side, px of the reduced masks, beyond which it counts ever less (Cauchy)."""
MIN_AGREEMENT = 0.6
"""Mean IoU of body and masks from which a start is taken, better than by chance."""
MIN_GAIN = 0.01
"""Gain in mean IoU from which a start is taken."""
MIN_OWN_GAIN = 0.02
"""Gain in mean IoU by which the body's own proportions must beat SMPL's."""
NO_PERSON_FOUND = (
    "There are no masks, and where the poses put the body no person was found in the images; "
    "distances stay as they are. Do poses and video belong together? Give --masks, from which "
    "ia-check can find what is wrong, or your own SMPL file (--body)."
)
"""Note about a capture in which no masks can be estimated."""


class _Start(NamedTuple):
    """A geometry whose body is near the masks.

    Attributes:
        magnification: Size of the masks' boxes relative to the posed body's.
        shift_m: Shift of the pelvis in the root's axes.
        before, after: Mean IoU of body and masks.
    """

    geometry: CaptureGeometry
    magnification: float
    shift_m: Float[np.ndarray, "3"]
    before: float
    after: float

    @property
    def is_taken(self) -> bool:
        """Whether body and masks agree better by it, and well enough."""
        return self.after >= max(MIN_AGREEMENT, self.before + MIN_GAIN)


def start_distances(
    capture: Capture, *, own: ShapedBody | None = None
) -> tuple[Capture, str, dict[str, Any] | None]:
    """Divide distances from the cameras and shift the pelvis, so that the body fits the masks.

    `own` is the body as it is, whose proportions are taken if they fit better than the capture's:
    files state SMPL for poses that were fitted to another body.

    Returns:
        The capture, words for people, and figures for the report.
    """
    samples = read_first_silhouettes(capture, START_FRAMES)
    if not samples:
        return capture, "" if capture.masks.is_given else NO_PERSON_FOUND, None
    start = _find_start(capture, samples, by_focal_length=False)
    if own is not None:
        other = _find_start(replace(capture, shaped=own), samples, by_focal_length=False)
        if other.is_taken and other.after > start.after + MIN_OWN_GAIN:
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
    samples = read_first_silhouettes(capture, START_FRAMES)
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
    """Bring the boxes of body and masks together."""
    objective = SilhouetteObjective(samples=samples, skin=SkinPoints.of(capture.shaped))
    stated = geometry = capture.geometry()
    magnification, shift = 1.0, np.zeros(3)
    for _ in range(ROUNDS):
        factor, shift = _compare_boxes(geometry, objective, shift, by_focal_length=by_focal_length)
        magnification *= factor
        if by_focal_length:
            intrinsics = stated.intrinsics.copy()
            intrinsics[:, [0, 1], [0, 1]] *= magnification
            geometry = replace(stated, intrinsics=intrinsics)
        else:
            geometry = _place(stated, capture.shaped, magnification, shift)
    before, after = (mean_score(objective.frame_scores(each)) for each in (stated, geometry))
    return _Start(geometry, magnification, shift, before, after)


def _place(
    geometry: CaptureGeometry, shaped: ShapedBody, divisor: float, shift_m: Float[np.ndarray, "3"]
) -> CaptureGeometry:
    """Divide each pelvis's distance from its own camera, then shift it in the root's axes."""
    eyes = geometry.camera_centers()[geometry.camera_rows()]
    pelves = shaped.joints[0] + geometry.motion.root_translations
    turned = rotation_matrices(geometry.motion.root_rotations) @ shift_m
    places = eyes + (pelves - eyes) / divisor + turned - shaped.joints[0]
    return replace(geometry, motion=replace(geometry.motion, root_translations=places))


def _compare_boxes(
    geometry: CaptureGeometry,
    objective: SilhouetteObjective,
    shift_m: Float[np.ndarray, "3"],
    *,
    by_focal_length: bool,
) -> tuple[float, Float[np.ndarray, "3"]]:
    """The factor by which bodies are too small in the images, and the pelvis's whole shift.

    `shift_m` is the shift that the geometry has already.
    """
    # A side e of a body's box, seen from a camera with the pelvis at p and the center at c, moves
    # by (k - 1) (e - p) as distances are divided by k, by (k - 1) (e - c) as the focal length is
    # multiplied by it, and by f/z R_x s - (e - c)/z R_z s as the pelvis is shifted by R s.
    rows, targets = [np.zeros((0, 4))], [np.zeros(0)]
    for sample in objective.samples:
        row = geometry.row_for_frame(sample.index)
        if row is None:
            continue
        camera = geometry.camera_at(sample.camera_row, objective.size_px)
        points = objective.posed_points(geometry.motion, row).astype(np.float64)
        view = camera.camera_from_world
        pelvis = objective.skin.shaped.joints[0] + geometry.motion.root_translations[row]
        depth = float(view[2, :3] @ pelvis + view[2, 3])
        if (points @ view[2, :3] + view[2, 3]).min() < NEAR_PLANE_M:
            continue
        pixels, center = camera.project(points), np.tile(camera.center_px, 2)
        sides = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
        fixed = center if by_focal_length else np.tile(camera.project(pelvis[None])[0], 2)
        turn = view[:3, :3] @ rotation_matrices(geometry.motion.root_rotations[row])
        across = np.tile(camera.focal_px, 2)[:, None] * np.tile(turn[:2], (2, 1))
        shifted = (across - (sides - center)[:, None] * turn[2]) / depth
        target = _sides_of_mask(sample.alpha, camera) - sides
        seen = np.isfinite(target)
        rows.append(np.column_stack([sides - fixed, shifted * (not by_focal_length)])[seen])
        targets.append(target[seen])
    found = _solve_robustly(np.concatenate(rows), np.concatenate(targets), shift_m)
    return max(1.0 + float(found[0]), 0.2), shift_m + found[1:]


def _sides_of_mask(alpha: AlphaMask, camera: Camera) -> Float[np.ndarray, "4"]:
    """Left, top, right and bottom of a mask, px; NaN at the image's border or in an empty mask."""
    size = np.array(camera.size_px, dtype=np.float64)
    columns, lines = (np.flatnonzero((alpha > 0.5).any(axis=axis)) for axis in (0, 1))
    if not len(columns):
        return np.full(4, np.nan)
    low = np.array([columns[0], lines[0]], dtype=np.float64)
    high = np.array([columns[-1], lines[-1]], dtype=np.float64) + 1.0
    low[low < IMAGE_BORDER_PX] = np.nan
    high[high > size - IMAGE_BORDER_PX] = np.nan
    return np.concatenate([low, high])


def _solve_robustly(
    rows: Float[np.ndarray, "sides 4"],
    targets: Float[np.ndarray, "sides"],
    shift_m: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "4"]:
    """The change of size and the further shift that the sides tell, with the shift's prior."""
    prior = SIGMA_SIDE_PX * np.sqrt(max(len(rows), 1)) / SIGMA_SHIFT_M
    held = prior * np.eye(4)[1:]
    found, weights = np.zeros(4), np.ones(len(rows))
    for _ in range(ROUNDS):
        design = np.concatenate([weights[:, None] * rows, held])
        target = np.concatenate([weights * targets, -prior * shift_m])
        found = np.linalg.lstsq(design, target, rcond=None)[0]
        off = (rows @ found - targets) / SIGMA_SIDE_PX
        weights = 1.0 / np.sqrt(1.0 + off**2)
    return found
