"""Bring solved cameras and a tracker's poses into one metric world.

Units are metres, y points up, the floor is at 0 and the person above the origin. z points from the
person to the first camera, so that a person who faces it has SMPL's own axes.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import rigid_transform, rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack
from preprocess.poses.motion_builder import place_in_camera_world, transform_motion
from preprocess.sfm.camera_solution import KEY, MISSING, PLACED, CameraSolution
from preprocess.sfm.metric_scale import (
    SOLE_THICKNESS_M,
    FloorPlane,
    MetricScale,
    PersonInCameras,
    estimate_metric_scale,
    fit_floor_plane,
    mean_camera_up,
)


def upright_axes(
    up: Float[np.ndarray, "3"], towards_camera: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Rotation from the solved world into one with y along `up`."""
    level = towards_camera - up * (towards_camera @ up)
    if np.linalg.norm(level) < 1e-9:  # the camera is right above
        level = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 0.0, 1.0])
    z = level / np.linalg.norm(level)
    return np.stack([np.cross(up, z), up, z])


def to_metric_world(
    camera_from_solved: Float[np.ndarray, "cameras 4 4"],
    scale: float,
    floor: FloorPlane,
    person: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "cameras 4 4"]:
    """The same cameras in the metric world; all arguments are of the solved one, in its unit.

    A place X becomes s U (X - o): `scale` s in metres per unit, U upright axes, and o the point of
    the floor below the person.
    """
    turned, moved = camera_from_solved[:, :3, :3], camera_from_solved[:, :3, 3]
    centers = -np.einsum("cba,cb->ca", turned, moved)
    axes = upright_axes(floor.normal, centers[0] - person)
    origin = person - floor.normal * float(floor.heights_above(person[None])[0])
    there = scale * (centers - origin) @ axes.T
    rotations = turned @ axes.T
    return rigid_transform(rotations, -np.einsum("cab,cb->ca", rotations, there))


FOOT_JOINTS = (7, 8, 10, 11)
"""Ankles and feet among SMPL's joints."""
MAX_LEAN_DEG = 30.0
"""Largest angle between up as the cameras are held and up as the person stands."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MetricPlacement:
    """A capture in a world of metres, y up, the floor at 0.

    `floor_points` counts the points of the floor that were seen; 0 if the soles had to tell.
    """

    cameras: CameraTrack
    motion: Motion
    scale: MetricScale
    floor_points: int


def place_in_metric_world(
    solved: CameraSolution,
    motion: Motion,
    tracker_camera: Camera | None,
    shaped: ShapedBody,
    source: FrameSource,
) -> MetricPlacement:
    """Cameras in metres and the poses in their world.

    Args:
        solved: Cameras of unknown scale.
        motion: Each row in the camera of its frame, metres.
        tracker_camera: Camera that the poses were made for, at its world's origin; None if unknown:
            then they are taken to be right for the solved focal length.
    """
    lens = solved.lens(source.size_px)
    if tracker_camera is not None:
        motion = refocus_motion(motion, tracker_camera, lens, shaped)
    frames = frame_indices_of_rows(motion, lens, source)
    usable = motion.valid & (solved.frame_status[frames] >= PLACED)
    standing = _person_in_cameras(solved, motion, frames, np.flatnonzero(usable), shaped)
    assert solved.model is not None
    up = _estimate_up(solved, motion, frames, usable)
    if solved.model.only_turns:  # in one place: the person's own metres are the world's
        floor, scale = None, MetricScale.of_person()
    else:
        floor = fit_floor_plane(solved.model, up)
        scale = estimate_metric_scale(standing, floor)
    if scale.rejection_reason is not None:
        raise InputError(f"The cameras were solved, but {scale.rejection_reason}.")
    turned = np.einsum("nab,nb->na", standing.world_from_camera, standing.pelvis_positions)
    person = np.median(turned / scale.metres_per_unit + standing.centers, axis=0)
    ground = floor or _floor_below_soles(standing, scale.metres_per_unit, up)
    transforms = to_metric_world(solved.camera_from_solved, scale.metres_per_unit, ground, person)
    cameras = CameraTrack(
        cameras=tuple(replace(lens, camera_from_world=transform) for transform in transforms),
        source="solved from the pictures",
        frames_without_camera=frozenset(np.flatnonzero(solved.frame_status == MISSING).tolist()),
    )
    worlds = np.linalg.inv(transforms[frames])
    return MetricPlacement(
        cameras=cameras,
        motion=transform_motion(motion, worlds, shaped.joints[0]),
        scale=scale,
        floor_points=ground.points,
    )


def refocus_motion(
    motion: Motion, tracker_camera: Camera, lens: Camera, shaped: ShapedBody
) -> Motion:
    """Camera-frame poses as another lens sees them where the first one did."""
    there = replace(motion, space="camera", intrinsic=tracker_camera.intrinsic, assumed_focal=None)
    one = CameraTrack(cameras=(lens,), source="")
    return place_in_camera_world(there, shaped, one, cameras_given=True)


def frame_indices_of_rows(
    motion: Motion, camera: Camera, source: FrameSource
) -> Int[np.ndarray, "poses"]:
    """The frame that each row belongs to."""
    claim = CaptureGeometry.of(motion, CameraTrack(cameras=(camera,), source=""), source)
    numbers = np.nan_to_num(claim.row_frames).round().astype(np.int64)
    return numbers.clip(0, source.frames_in_file - 1)


def _person_in_cameras(
    solved: CameraSolution,
    motion: Motion,
    frames: Int[np.ndarray, "poses"],
    rows: Int[np.ndarray, "usable"],
    shaped: ShapedBody,
) -> PersonInCameras:
    weights = shaped.body.weights
    feet = np.flatnonzero(weights[:, FOOT_JOINTS].sum(axis=1) > 0.5)
    rest = np.column_stack([shaped.vertices[feet], np.ones(len(feet))])
    soles = []
    for row in rows.tolist():
        transforms = shaped.with_pose(motion[row]).world_from_rest()[:, :3]
        blended = np.einsum("vj,jab->vab", weights[feet], transforms)
        soles.append(np.einsum("vab,vb->va", blended, rest))
    views = solved.camera_from_solved[frames[rows]]
    turned = views[:, :3, :3].transpose(0, 2, 1)
    return PersonInCameras(
        world_from_camera=turned,
        centers=-np.einsum("nab,nb->na", turned, views[:, :3, 3]),
        pelvis_positions=shaped.joints[0] + motion.root_translations[rows],
        soles=np.array(soles).reshape(len(rows), len(feet), 3),
    )


def _estimate_up(
    solved: CameraSolution, motion: Motion, frames: Int[np.ndarray, "poses"], usable: np.ndarray
) -> Float[np.ndarray, "3"]:
    """Up as the person stands, unless the cameras are held quite otherwise."""
    assert solved.model is not None
    held = mean_camera_up(solved.model)
    if not usable.any():
        return held
    backs = rotation_matrices(motion.root_rotations[usable])[:, :, 1]
    views = solved.camera_from_solved[frames[usable], :3, :3]
    up = np.median(np.einsum("nba,nb->na", views, backs), axis=0)
    length = float(np.linalg.norm(up))
    if length < 0.5 or up @ held < length * np.cos(np.radians(MAX_LEAN_DEG)):
        return held
    return up / length


def _floor_below_soles(
    standing: PersonInCameras, scale: float, up: Float[np.ndarray, "3"]
) -> FloorPlane:
    """The level plane on which the lowest sole of most frames stands."""
    turned = np.einsum("nab,nkb->nka", standing.world_from_camera, standing.soles)
    lowest = ((turned @ up).min(axis=1) - SOLE_THICKNESS_M) / scale + standing.centers @ up
    return FloorPlane(normal=up, offset=-float(np.median(lowest)), points=0)


def solution_report(
    solved: CameraSolution, place: MetricPlacement | None, source: FrameSource
) -> dict[str, object]:
    """The entry of report.json about the cameras."""
    wanted = [i for i in range(len(solved.frame_status)) if source.selection.contains(i)]
    marks = solved.frame_status[wanted]
    content: dict[str, object] = {
        "verdict": "still" if solved.is_static else "solved",
        "background_moved": solved.background_motion,
        "key_frames": solved.keyframe_count,
        **solved.costs,
    }
    if place is None or solved.model is None:
        return content
    lens = solved.lens(source.size_px)
    return content | {
        "frames": {
            "key": int((marks == KEY).sum()),
            "placed": int((marks == PLACED).sum()),
            "interpolated": int(((marks != MISSING) & (marks < PLACED)).sum()),
            "missing": int((marks == MISSING).sum()),
        },
        "focal_px": lens.focal_px[0],
        "distortion": list(lens.distortion),
        "gates": {gate.name: {"value": gate.value, "bound": gate.bound} for gate in solved.gates},
        "scale": {
            "cues": list(place.scale.cues),
            "metres_per_unit": place.scale.metres_per_unit,
            "by_ground": place.scale.ground,
            "by_place": place.scale.place,
            "spread": place.scale.spread,
            "floor_points": place.floor_points,
        },
    }
