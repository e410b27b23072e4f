"""Solves a recording's cameras, stage after stage, and refuses what it cannot vouch for.

Key frames, features, matches, mapping, then the frames in between. A model is believed if it passes
its gates, and if points followed from key frame to key frame land where the next camera sees them.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from capture.hardware import peak_memory_mb
from capture.input_error import InputError
from capture.source import Frame, FrameSource
from preprocess.body.body_surface import DENSE_SKIN_POINTS, SkinPoints
from preprocess.cameras.camera_file import ASSUMED_CAMERA_SOURCE
from preprocess.capture_session import Capture, Provenance
from preprocess.frame_association import interpolate_missing_cameras
from preprocess.observation import associate_poses
from preprocess.sfm import colmap_mapping
from preprocess.sfm.camera_solution import (
    INTERPOLATED,
    KEY,
    MIN_REGISTERED_FRACTION,
    MIN_TURN_DEG,
    MISSING,
    PLACED,
    CameraSolution,
    QualityGate,
    SparseModel,
    evaluate_gates,
    find_outlier_cameras,
)
from preprocess.sfm.colmap_mapping import (
    MAX_KEYFRAMES,
    ColmapWorkspace,
    PersonMaskFn,
    SfmKeyframe,
    select_keyframes,
    write_keyframes,
)
from preprocess.sfm.metric_world import MetricPlacement, place_in_metric_world, solution_report
from preprocess.sfm.point_tracking import (
    ResectionResult,
    resect_intermediate_frames,
)
from preprocess.sfm.turning_camera import (
    MAX_STATIC_MOTION,
    measure_background_motion,
    solve_turning_camera,
)

MAX_TRACKED_POINT_ERROR_PX = 3.0
"""Largest distance of tracked points from their projection by a key frame's own camera, pixels."""
MIN_TRACKED_KEYFRAMES = 0.5
"""Fraction of the key frames that points must be tracked into."""


@dataclass(frozen=True, kw_only=True)
class SolverSettings:
    """Settings of a solution, which does not depend on the number of threads.

    `focal_ratio` is the focal length as a fraction of the image's longer side, if it is known.
    """

    focal_ratio: float | None = None
    seed: int = 0
    threads: int = 1
    max_keyframes: int = MAX_KEYFRAMES


def solve_cameras(
    source: FrameSource,
    person_mask: PersonMaskFn,
    settings: SolverSettings,
    report_progress: Callable[[float], None],
) -> CameraSolution:
    """Solve the cameras of all selected frames; takes minutes.

    `person_mask` finds the person, who moves and is ignored; progress is the fraction of the work
    that is done.
    """
    colmap_mapping.require_pycolmap()
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    with TemporaryDirectory() as folder:
        solution = _solve(source, person_mask, Path(folder), settings, report_progress)
    costs = {
        "wall_seconds": time.perf_counter() - wall_s,
        "cpu_seconds": time.process_time() - cpu_s,
        "peak_memory_mb": peak_memory_mb(),
    }
    return replace(solution, costs=costs)


def _solve(
    source: FrameSource,
    person_mask: PersonMaskFn,
    folder: Path,
    settings: SolverSettings,
    report_progress: Callable[[float], None],
) -> CameraSolution:
    """Run all stages; key frames and COLMAP's database lie in a folder meanwhile."""

    def part(start: float, end: float) -> Callable[[float], None]:
        """Report the progress of one stage, which takes about this part of the whole time."""
        return lambda share: report_progress(start + share * (end - start))

    chosen = select_keyframes(source, person_mask, part(0.0, 0.07), settings.max_keyframes)
    keys = write_keyframes(chosen, folder / "images", folder / "masks")
    background_motion = measure_background_motion(keys)
    if background_motion <= MAX_STATIC_MOTION:  # not of a background that was lost
        frames = source.frames_in_file
        return CameraSolution(
            is_static=True, background_motion=background_motion, gates=(), model=None,
            camera_from_solved=np.zeros((frames, 4, 4)),
            frame_status=np.full(frames, MISSING, dtype=np.int64), keyframe_count=len(keys),
        )  # fmt: skip
    ratio, longer_px = settings.focal_ratio, max(keys[0].gray.shape)
    workspace = ColmapWorkspace(
        images=folder / "images", masks=folder / "masks", database=folder / "matches.db",
        names=tuple(key.name for key in keys), size_px=keys[0].gray.shape[::-1],
        focal_px=None if ratio is None else ratio * longer_px, threads=settings.threads,
    )  # fmt: skip
    model = solve_turning_camera(keys, workspace.focal_px)
    gates = [] if model is None else evaluate_gates(model, len(keys))
    if model is None or not all(gate.passed for gate in gates):
        model, gates = _solve_path(workspace, folder / "models", keys, settings.seed, part)
    between = resect_intermediate_frames(source, model, keys, part(0.94, 1.0))
    gates.append(_tracking_gate(between, len(model.frames)))
    if not gates[-1].passed:
        raise _unsolved_error([gates[-1]])
    cameras, status = _cameras_of_all_frames(source, model, between)
    wanted = [i for i in range(source.frames_in_file) if source.selection.contains(i)]
    share = float((status[wanted] != MISSING).mean())
    if share < 0.5:
        raise InputError(
            f"--cameras solve: only {share:.0%} of the frames could be placed. Film without sudden "
            "movements, or give only the part that goes well (--frames START:STOP)."
        )
    return CameraSolution(
        is_static=False, background_motion=background_motion, gates=tuple(gates), model=model,
        camera_from_solved=cameras, frame_status=status, keyframe_count=len(keys),
    )  # fmt: skip


def _solve_path(
    workspace: ColmapWorkspace,
    folder: Path,
    keys: list[SfmKeyframe],
    seed: int,
    part: Callable[[float, float], Callable[[float], None]],
) -> tuple[SparseModel, list[QualityGate]]:
    """Solve the key frames of a camera that is carried around; return the gates passed, too."""
    colmap_mapping.extract_features(workspace, part(0.07, 0.57))
    colmap_mapping.match_features(workspace, part(0.57, 0.72))
    parallax = _parallax(workspace, len(keys))
    if not parallax.passed:
        raise _unsolved_error([parallax])
    model, gates = _map(workspace, folder, keys, seed, part(0.72, 0.94))
    return model, [parallax, *gates]


def _parallax(workspace: ColmapWorkspace, keys: int) -> QualityGate:
    """The gate of image pairs that show depth."""
    pairs, share = colmap_mapping.parallax_fraction(workspace.database)
    least = MIN_REGISTERED_FRACTION * (keys - 1)
    if pairs < least:
        reason = "the pictures have hardly anything in common"
        return QualityGate.at_least("matched_pairs", float(pairs), least, reason)
    return QualityGate.at_least(
        "pairs_with_parallax", share, 0.02,
        "nothing shows depth, as before one flat wall, and the camera does not just turn by "
        f"{MIN_TURN_DEG:.0f}° or more",
    )  # fmt: skip


def _map(
    workspace: ColmapWorkspace,
    folder: Path,
    keys: list[SfmKeyframe],
    seed: int,
    report_progress: Callable[[float], None],
) -> tuple[SparseModel, list[QualityGate]]:
    """Return the model without its outlier cameras, and the gates that it has passed."""
    folder.mkdir()
    model = colmap_mapping.map_incrementally(workspace, folder, seed, report_progress)
    if model is None:
        raise _unsolved_error([])
    model = model.without_cameras(find_outlier_cameras(model))
    gates = evaluate_gates(model, len(keys))
    failed = [gate for gate in gates if not gate.passed]
    if failed:
        raise _unsolved_error(failed)
    corner = np.hypot(*model.size_px) / 2.0 / model.focal_px
    shift_px = abs(model.radial_distortion) * corner**3 * model.focal_px
    if shift_px < 0.3:  # of the corners: as good as none
        model = replace(model, radial_distortion=0.0)
    return model, gates


def _unsolved_error(failed: list[QualityGate]) -> InputError:
    reasons = "; ".join(gate.describe_failure() for gate in failed[:3])
    return InputError(
        "The cameras could not be solved with certainty: "
        f"{reasons or 'no two images fit together'}. Leave out --cameras solve to train without "
        "them, each pose in its own frame's camera; give cameras (--cameras FILE, "
        "docs/formats.md); or film with the surroundings in view (textured, not repeating, well "
        "lit), walking slowly and without sudden turns, or turning on the spot."
    )


def _tracking_gate(between: ResectionResult, keys: int) -> QualityGate:
    """The gate of tracked points that land where the next key frame's camera sees them."""
    misses = np.array(list(between.keyframe_errors_px.values()))
    known = misses[np.isfinite(misses)]
    share = len(known) / max(keys - 1, 1)
    worst = float(known.max()) if len(known) else float("inf")
    words = f"points followed through the video land up to {worst:.1f} px beside where they should"
    if share < MIN_TRACKED_KEYFRAMES:
        words = "the surroundings could hardly be followed from picture to picture"
    return QualityGate(
        name="followed_px", value=worst, bound=MAX_TRACKED_POINT_ERROR_PX, failure_reason=words,
        passed=share >= MIN_TRACKED_KEYFRAMES and worst < MAX_TRACKED_POINT_ERROR_PX,
    )  # fmt: skip


def _cameras_of_all_frames(
    source: FrameSource, model: SparseModel, between: ResectionResult
) -> tuple[Float[np.ndarray, "frames 4 4"], Int[np.ndarray, "frames"]]:
    """A camera for each frame of the file, and its status; short gaps are filled in."""
    total = max(source.frames_in_file, int(model.frames.max()) + 1)
    status = np.full(total, INTERPOLATED)
    known = dict.fromkeys(between.cameras, PLACED)
    known.update(dict.fromkeys(model.frames.tolist(), KEY))
    for frame, kind in known.items():
        status[frame] = kind
    own = dict(zip(model.frames.tolist(), model.camera_from_world, strict=True))
    found = {frame: model.camera(at) for frame, at in (between.cameras | own).items()}
    cameras, missing = interpolate_missing_cameras(found, total)
    status[list(missing)] = MISSING
    return np.stack([camera.camera_from_world for camera in cameras]), status


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
                return capture.masks.read(frame.index, size_px) > 0.2
            except InputError:  # one damaged mask
                return None

        return by_mask
    skin = SkinPoints.of(capture.shaped, DENSE_SKIN_POINTS)
    pose_row = associate_poses(capture.motion, source)

    def by_body(frame: Frame, size_px: tuple[int, int]) -> Bool[np.ndarray, "_ _"] | None:
        row = pose_row(frame)
        if row is None or not capture.motion.valid[row]:
            return None
        body = skin.draw(capture.motion[row], capture.cameras[0].resize(size_px))
        rows = np.flatnonzero(body.any(axis=1))
        if not len(rows):
            return None
        side = 2 * max(2, round(0.06 * (rows[-1] - rows[0]))) + 1  # clothes and hair
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
    motion, camera = capture.motion, capture.cameras[0]
    stated = motion.intrinsic is not None or motion.assumed_focal is not None
    is_known = stated or capture.cameras.source != ASSUMED_CAMERA_SOURCE
    placement = place_in_metric_world(
        solved, motion, camera if is_known else None, capture.shaped, capture.source
    )
    report = solution_report(solved, placement, capture.source)
    note = _describe_solution(report, placement, solved)
    return capture.with_part(
        Provenance("cameras", "solved", (note,), figures=report),
        cameras=placement.cameras,
        motion=placement.motion,
    )


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
