"""Solved cameras joined to a recording, and written beside its avatar."""

from dataclasses import replace
from typing import Any

from apps.learning.run_folder import RunFolder
from apps.recording.recording import Recording
from capture.atomic_files import whole_file
from capture.camera import Camera
from preprocess.camera_file import ASSUMED, write_cameras
from preprocess.pose_file import write_motion
from preprocess.solve.placing import Placed, place_in_world, told
from preprocess.solve.solved import Solved


def joined(recording: Recording, solved: Solved) -> Recording:
    """The recording in the world of its solved cameras; as it was, if the camera stood still.

    Args:
        recording: With poses in the camera of each frame.
        solved: What the pictures say.

    Raises:
        BadInput: If nothing tells the size of the world.
    """
    if solved.still:
        note = (
            f"The camera stood still (what is behind the person moved by {solved.moved:.2%} of the "
            "picture), so there was nothing to solve."
        )
        return replace(
            recording, notes=(*recording.notes, note), solved=told(solved, None, recording.source)
        )
    place = place_in_world(
        solved, recording.motion, _seen_by(recording), recording.shaped, recording.source
    )
    found = told(solved, place, recording.source)
    return replace(
        recording,
        cameras=place.cameras,
        motion=place.motion,
        solved=found,
        notes=(*recording.notes, _in_words(found, place)),
    )


def write_solved(recording: Recording, run: RunFolder) -> None:
    """cameras.npz and poses.npz of the run: the capture's own walk, to be played or reused."""
    with whole_file(run.cameras) as path:
        write_cameras(path, recording.cameras)
    with whole_file(run.poses) as path:
        write_motion(path, replace(recording.motion, intrinsic=None, camera_from_world=None))


def _seen_by(recording: Recording) -> Camera | None:
    """The camera that the poses were made for; None if its lens was only assumed."""
    motion, camera = recording.motion, recording.cameras[0]
    stated = motion.intrinsic is not None or motion.lens is not None
    return camera if stated or recording.cameras.source != ASSUMED else None


def _in_words(found: dict[str, Any], place: Placed) -> str:
    frames, scale = found["frames"], found["scale"]
    several = f"{frames['interpolated']} interpolated, " if frames["interpolated"] else ""
    return (
        f"Cameras: {frames['key']} key frames solved, {frames['placed']} placed between them, "
        f"{several}{frames['missing']} missing; focal length {found['focal_px']:.0f} px; size by "
        f"{' and '.join(scale['cues'])}, {place.floor_points} points of the floor seen."
    )
