"""Solve the cameras of an opened capture, and bring it into their world."""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import Frame
from preprocess.body.body_surface import MeshSilhouette
from preprocess.cameras.camera_file import ASSUMED_CAMERA_SOURCE
from preprocess.capture_session import Capture, Provenance
from preprocess.observation import associate_poses
from preprocess.sfm.camera_solution import CameraSolution
from preprocess.sfm.camera_solver import SolverSettings, solve_cameras
from preprocess.sfm.colmap_mapping import PersonMaskFn
from preprocess.sfm.metric_world import MetricPlacement, place_in_metric_world, solution_report

BODY_MARGIN = 0.06
"""Margin for clothes and hair around the posed body; a fraction of its height in the image."""
MASK_THRESHOLD = 0.2
"""Opacity from which a pixel of a mask counts as the person."""


def solve_capture_cameras(
    capture: Capture, *, seed: int, threads: int, report_progress: Callable[[float], None]
) -> CameraSolution:
    """Solve the cameras of a capture whose poses are in the camera of each frame.

    A focal length that the poses state is where the solver starts. The result does not depend on
    the number of threads; progress is the fraction of the work that is done.
    """
    stated = capture.motion.intrinsic is not None
    ratio = capture.cameras[0].focal_px[0] / max(capture.source.size_px) if stated else None
    settings = SolverSettings(focal_ratio=ratio, seed=seed, threads=threads)
    return solve_cameras(capture.source, make_person_mask(capture), settings, report_progress)


def make_person_mask(capture: Capture) -> PersonMaskFn:
    """Make the function that finds the person: by the masks, or by the posed body and a margin."""
    source = capture.source
    if capture.masks.is_given:
        capture.masks.check()

        def by_mask(frame: Frame, size_px: tuple[int, int]) -> Bool[np.ndarray, "_ _"] | None:
            try:
                return capture.masks.read(frame.index, size_px) > MASK_THRESHOLD
            except InputError:  # one damaged mask
                return None

        return by_mask
    outline, pose_row = MeshSilhouette(capture.shaped), associate_poses(capture.motion, source)

    def by_body(frame: Frame, size_px: tuple[int, int]) -> Bool[np.ndarray, "_ _"] | None:
        row = pose_row(frame)
        if row is None or not capture.motion.valid[row]:
            return None
        body = outline.draw_pose(capture.motion[row], capture.cameras[0].resize(size_px))
        rows = np.flatnonzero(body.any(axis=1))
        if not len(rows):
            return None
        side = 2 * max(2, round(BODY_MARGIN * (rows[-1] - rows[0]))) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        return cv2.dilate(body.astype(np.uint8), disc) > 0

    return by_body


def apply_camera_solution(capture: Capture, solved: CameraSolution) -> Capture:
    """Return the capture in the world of its solved cameras; unchanged if the camera stood still.

    Poses are in the camera of each frame before.
    """
    if solved.is_static:
        note = (
            "The camera stood still (the background moved by "
            f"{solved.background_motion:.2%} of the picture), so there was nothing to solve."
        )
        report = solution_report(solved, None, capture.source)
        return capture.with_part(Provenance("cameras", "solved", (note,), figures=report))
    placement = place_in_metric_world(
        solved, capture.motion, _tracker_camera(capture), capture.shaped, capture.source
    )
    report = solution_report(solved, placement, capture.source)
    note = _describe_solution(report, placement, solved)
    return capture.with_part(
        Provenance("cameras", "solved", (note,), figures=report),
        cameras=placement.cameras,
        motion=placement.motion,
    )


def _tracker_camera(capture: Capture) -> Camera | None:
    """Return the camera that the poses were made for; None if its focal length was only assumed."""
    motion, camera = capture.motion, capture.cameras[0]
    stated = motion.intrinsic is not None or motion.assumed_focal is not None
    return camera if stated or capture.cameras.source != ASSUMED_CAMERA_SOURCE else None


def _describe_solution(
    report: dict[str, Any], placement: MetricPlacement, solved: CameraSolution
) -> str:
    frames, scale = report["frames"], report["scale"]
    several = f"{frames['interpolated']} interpolated, " if frames["interpolated"] else ""
    size = f"size by {' and '.join(scale['cues'])}"
    if solved.model is not None and solved.model.only_turns:
        size = f"the camera only turns, by {solved.model.turn_deg():.0f}°; {size}"
    else:
        size = f"{size}, {placement.floor_points} points of the floor seen"
    return (
        f"Cameras: {frames['key']} key frames solved, {frames['placed']} placed between them, "
        f"{several}{frames['missing']} missing; focal length {report['focal_px']:.0f} px; {size}."
    )
