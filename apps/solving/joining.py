"""Solved cameras joined to a recording, and written beside its avatar."""

from dataclasses import replace
from typing import Any

from apps.learning.run_folder import RunFolder
from apps.recording.recording import Capture
from capture.atomic_files import atomic_file
from capture.camera import Camera
from preprocess.camera_file import ASSUMED_CAMERA_SOURCE, write_cameras
from preprocess.pose_file import write_motion
from preprocess.solve.placing import MetricPlacement, place_in_metric_world, solution_report
from preprocess.solve.solved import CameraSolution


def apply_camera_solution(recording: Capture, solved: CameraSolution) -> Capture:
    """The recording in the world of its solved cameras; as it was, if the camera stood still.

    Args:
        recording: With poses in the camera of each frame.
        solved: What the pictures say.

    Raises:
        InputError: If nothing tells the size of the world.
    """
    if solved.still:
        note = (
            f"The camera stood still (what is behind the person moved by {solved.moved:.2%} of the "
            "picture), so there was nothing to solve."
        )
        return replace(
            recording, notes=(*recording.notes, note), camera_report=solution_report(solved, None, recording.source)
        )
    place = place_in_metric_world(
        solved, recording.motion, _tracker_camera(recording), recording.shaped, recording.source
    )
    found = solution_report(solved, place, recording.source)
    return replace(
        recording,
        cameras=place.cameras,
        motion=place.motion,
        camera_report=found,
        notes=(*recording.notes, _describe_solution(found, place)),
    )


def write_solved_capture(recording: Capture, run: RunFolder) -> None:
    """cameras.npz and poses.npz of the run: the capture's own walk, to be played or reused."""
    with atomic_file(run.cameras) as path:
        write_cameras(path, recording.cameras)
    with atomic_file(run.poses) as path:
        write_motion(path, replace(recording.motion, intrinsic=None, camera_from_world=None))


def _tracker_camera(recording: Capture) -> Camera | None:
    """The camera that the poses were made for; None if its lens was only assumed."""
    motion, camera = recording.motion, recording.cameras[0]
    stated = motion.intrinsic is not None or motion.assumed_focal is not None
    return camera if stated or recording.cameras.source != ASSUMED_CAMERA_SOURCE else None


def _describe_solution(found: dict[str, Any], place: MetricPlacement) -> str:
    frames, scale = found["frames"], found["scale"]
    several = f"{frames['interpolated']} interpolated, " if frames["interpolated"] else ""
    return (
        f"Cameras: {frames['key']} key frames solved, {frames['placed']} placed between them, "
        f"{several}{frames['missing']} missing; focal length {found['focal_px']:.0f} px; size by "
        f"{' and '.join(scale['cues'])}, {place.floor_points} points of the floor seen."
    )
