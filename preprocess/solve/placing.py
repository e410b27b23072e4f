"""Solved cameras and a tracker's poses brought into one metric world."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from capture.camera import Camera
from capture.errors import BadInput
from capture.source import Source
from preprocess.body import ShapedBody
from preprocess.camera_file import CameraTrack
from preprocess.doctor.claim import Claim
from preprocess.kinematics import rotation_matrices
from preprocess.pose import Motion
from preprocess.poses.place import moved, placed
from preprocess.solve.floor import Floor, find_floor, up_of_cameras
from preprocess.solve.scale import SOLE_M, Scale, Standing, metric_scale
from preprocess.solve.solved import KEY, MISSING, PLACED, Solved
from preprocess.solve.world import metric_cameras

FEET = (7, 8, 10, 11)
"""Ankles and feet among SMPL's joints."""
MOST_LEAN_DEG = 30.0
"""Between up as the cameras are held and up as the person stands."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Placed:
    """A capture in a world of metres, y up, the floor at 0.

    Attributes:
        cameras: One a frame.
        motion: In that world.
        scale: How the size was found.
        floor_points: Points of the floor that were seen; 0 if the soles had to tell.
    """

    cameras: CameraTrack
    motion: Motion
    scale: Scale
    floor_points: int


def place_in_world(
    solved: Solved, motion: Motion, seen_by: Camera | None, shaped: ShapedBody, source: Source
) -> Placed:
    """Cameras in metres and the poses in their world.

    Args:
        solved: Cameras of unknown size.
        motion: Each row in the camera of its frame, metres.
        seen_by: The camera that the poses were made for, at its world's origin; None if nobody
            knows, and then they are taken to be right for the solved lens.
        shaped: The person.
        source: The frames.

    Raises:
        BadInput: If nothing tells the size of the world.
    """
    lens = solved.lens(source.size_px)
    if seen_by is not None:
        motion = refocused_to(motion, seen_by, lens, shaped)
    frames = frames_of(motion, lens, source)
    usable = motion.valid & (solved.marks[frames] >= PLACED)
    standing = _standing(solved, motion, frames, np.flatnonzero(usable), shaped)
    assert solved.model is not None
    up = _up(solved, motion, frames, usable)
    floor = find_floor(solved.model, up)
    scale = metric_scale(standing, floor)
    if scale.refused is not None:
        raise BadInput(f"The cameras were solved, but {scale.refused}.")
    turned = np.einsum("nab,nb->na", standing.world_from_camera, standing.pelves)
    person = np.median(turned / scale.metres + standing.centers, axis=0)
    ground = floor or _under_the_soles(standing, scale.metres, up)
    transforms = metric_cameras(solved.camera_from_solved, scale.metres, ground, person)
    cameras = CameraTrack(
        cameras=tuple(replace(lens, camera_from_world=transform) for transform in transforms),
        source="solved from the pictures",
        missing=frozenset(np.flatnonzero(solved.marks == MISSING).tolist()),
    )
    worlds = np.linalg.inv(transforms[frames])
    return Placed(
        cameras=cameras,
        motion=moved(motion, worlds, shaped.joints[0]),
        scale=scale,
        floor_points=ground.points,
    )


def refocused_to(motion: Motion, seen_by: Camera, lens: Camera, shaped: ShapedBody) -> Motion:
    """Camera-frame poses as another lens sees them where the first one did."""
    there = replace(motion, space="camera", intrinsic=seen_by.intrinsic, lens=None)
    one = CameraTrack(cameras=(lens,), source="")
    return placed(there, shaped, one, cameras_given=True)


def frames_of(motion: Motion, camera: Camera, source: Source) -> Int[np.ndarray, "poses"]:
    """The frame that each row belongs to."""
    claim = Claim.of(motion, CameraTrack(cameras=(camera,), source=""), source)
    numbers = np.nan_to_num(claim.places).round().astype(np.int64)
    return numbers.clip(0, source.frames_in_file - 1)


def _standing(
    solved: Solved,
    motion: Motion,
    frames: Int[np.ndarray, "poses"],
    rows: Int[np.ndarray, "usable"],
    shaped: ShapedBody,
) -> Standing:
    weights = shaped.body.weights
    feet = np.flatnonzero(weights[:, FEET].sum(axis=1) > 0.5)
    rest = np.column_stack([shaped.vertices[feet], np.ones(len(feet))])
    soles = []
    for row in rows.tolist():
        transforms = shaped.with_pose(motion[row]).world_from_rest()[:, :3]
        blended = np.einsum("vj,jab->vab", weights[feet], transforms)
        soles.append(np.einsum("vab,vb->va", blended, rest))
    views = solved.camera_from_solved[frames[rows]]
    turned = views[:, :3, :3].transpose(0, 2, 1)
    return Standing(
        world_from_camera=turned,
        centers=-np.einsum("nab,nb->na", turned, views[:, :3, 3]),
        pelves=shaped.joints[0] + motion.root_translations[rows],
        soles=np.array(soles).reshape(len(rows), len(feet), 3),
    )


def _up(
    solved: Solved,
    motion: Motion,
    frames: Int[np.ndarray, "poses"],
    usable: np.ndarray,
) -> Float[np.ndarray, "3"]:
    """Up as the person stands, unless the cameras are held quite otherwise."""
    assert solved.model is not None
    held = up_of_cameras(solved.model)
    if not usable.any():
        return held
    backs = rotation_matrices(motion.root_rotations[usable])[:, :, 1]
    views = solved.camera_from_solved[frames[usable], :3, :3]
    up = np.median(np.einsum("nba,nb->na", views, backs), axis=0)
    length = float(np.linalg.norm(up))
    if length < 0.5 or up @ held < length * np.cos(np.radians(MOST_LEAN_DEG)):
        return held
    return up / length


def _under_the_soles(standing: Standing, scale: float, up: Float[np.ndarray, "3"]) -> Floor:
    """The level plane on which the lowest sole of most frames stands."""
    turned = np.einsum("nab,nkb->nka", standing.world_from_camera, standing.soles)
    lowest = ((turned @ up).min(axis=1) - SOLE_M) / scale + standing.centers @ up
    return Floor(normal=up, offset=-float(np.median(lowest)), points=0)


def told(solved: Solved, place: Placed | None, source: Source) -> dict[str, object]:
    """What report.json says of the cameras."""
    wanted = [i for i in range(len(solved.marks)) if source.selection.wants(i)]
    marks = solved.marks[wanted]
    content: dict[str, object] = {
        "verdict": "still" if solved.still else "solved",
        "background_moved": solved.moved,
        "key_frames": solved.keys,
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
            "metres_per_unit": place.scale.metres,
            "by_ground": place.scale.ground,
            "by_place": place.scale.place,
            "spread": place.scale.spread,
            "floor_points": place.floor_points,
        },
    }
