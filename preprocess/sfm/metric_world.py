"""Bring solved cameras and a tracker's poses into one metric world.

Units are metres, y points up, the floor is at 0 and the person above the origin. z points from the
person to the first camera, so that a person who faces it has SMPL's own axes.

A camera-frame point q (metres) is X = R_iᵀ q + s c_i in the world, with s metres per unit of the
solved world: linear in s, so that each cue is a row a s = b of one least-squares problem.

* **ground**: the lowest foot stands on the floor, s h_i = sole - min_j n · (R_iᵀ f_ij), h_i being
  the camera's height above the floor. One value a frame; half of them agree, or it is no cue.
* **in place**: the person stays about where it is: s (c_i - c̄) = -(q_i - q̄), q_i = R_iᵀ p_i.

One scale for all frames: with one a frame the body would jitter in depth.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from capture.camera import Camera, Matrix3, Vector3
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import rigid_transform, rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack
from preprocess.poses.motion_builder import place_in_camera_world, transform_motion
from preprocess.sfm.camera_solution import KEY, MISSING, PLACED, CameraSolution, SparseModel

MIN_POINTS = 40
"""Fewest points that a floor is fitted to."""
SIGMA_GROUND_M = 0.06
"""Standard deviation of a sole's height above the floor by a tracker's depth, metres."""
SIGMA_PLACE_M = 0.20
"""Standard deviation of a person from its usual place, metres."""
MIN_FRAMES = 5
"""Fewest frames with a pose and a camera."""
SOLE_THICKNESS_M = 0.01
"""Usual height of a body's bare sole above the floor, from barefoot to a shoe of 3 cm; metres."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FloorPlane:
    """A plane: normal · x + offset = 0, the unit normal pointing up to the cameras.

    `offset` is in the world's own unit; `points` on it are 0 if it was not seen and only up is
    known.
    """

    normal: Vector3
    offset: float
    points: int

    def heights_above(self, places: Float[np.ndarray, "places 3"]) -> Float[np.ndarray, "places"]:
        """Signed distances of places from the plane, up."""
        return places @ self.normal + self.offset


def mean_camera_up(model: SparseModel) -> Vector3:
    """Up as the cameras hold their images: minus the mean of their y axes."""
    up = -model.camera_from_world[:, 1, :3].mean(axis=0)
    return up / np.linalg.norm(up)


def fit_floor_plane(model: SparseModel, up: Vector3) -> FloorPlane | None:
    """The largest plane below the cameras that is nearly level and has next to nothing below it.

    RANSAC (Fischler & Bolles 1981) over triples of points, then least squares over near points;
    `up` is a first guess.
    """
    views = np.bincount(model.observation_point, minlength=len(model.points))
    points = model.points[views >= 3]
    centers = model.camera_centers()
    distance = np.linalg.norm(
        model.points[model.observation_point] - centers[model.observation_camera], axis=1
    )
    if not len(points):
        return None
    near = 0.01 * float(np.median(distance))  # what is nearer belongs to a plane
    lowest = float((centers @ up).min())
    points = points[points @ up < lowest]
    if len(points) < MIN_POINTS:
        return None
    rng = np.random.default_rng(0)
    best, most = None, max(MIN_POINTS, 0.05 * len(points))
    for _ in range(2000):
        plane = _plane_through(points[rng.choice(len(points), 3, replace=False)], up)
        if plane is None:
            continue
        heights = points @ plane[0] + plane[1]
        inside = np.abs(heights) < near
        if inside.sum() > most and (heights < -3.0 * near).mean() < 0.05:
            best, most = inside, float(inside.sum())
    return None if best is None else _refine_plane(points, best, up, near)


def _plane_through(three: Matrix3, up: Vector3) -> tuple[Vector3, float] | None:
    normal = np.cross(three[1] - three[0], three[2] - three[0])
    length = float(np.linalg.norm(normal))
    if length < 1e-12:
        return None
    normal = normal / length * (1.0 if normal @ up > 0.0 else -1.0)
    if normal @ up < np.cos(np.radians(20.0)):
        return None
    return normal, -float(normal @ three[0])


def _refine_plane(
    points: Float[np.ndarray, "points 3"],
    inside: Bool[np.ndarray, "points"],
    up: Vector3,
    near: float,
) -> FloorPlane:
    """Least squares over the points of the plane, three times."""
    normal, offset = up, 0.0
    for _ in range(3):
        middle = points[inside].mean(axis=0)
        normal = np.linalg.svd(points[inside] - middle, full_matrices=False)[2][2]
        normal = normal if normal @ up > 0.0 else -normal
        offset = -float(normal @ middle)
        inside = np.abs(points @ normal + offset) < near
    return FloorPlane(normal=normal, offset=offset, points=int(inside.sum()))


@dataclass(frozen=True, eq=False, kw_only=True)
class PersonInCameras:
    """The person in the cameras' own frames, one row for each frame with a pose and a camera.

    Pelvis and soles, the skin of both feet, are in the camera, metres; cameras have the rotations
    R_iᵀ and are at `centers`, in the solved world's unit.
    """

    world_from_camera: Float[np.ndarray, "frames 3 3"]
    centers: Float[np.ndarray, "frames 3"]
    pelvis_positions: Float[np.ndarray, "frames 3"]
    soles: Float[np.ndarray, "frames soles 3"]


@dataclass(frozen=True, kw_only=True)
class MetricScale:
    """Metres per unit of the solved world.

    Attributes:
        cues: The cues that made it: "ground", "in place"; "the person" if the camera only turns.
        ground, place: The scale by each alone; None where it says nothing.
        spread: Of the frames' own values by ground contact, relative; NaN without ground.
        rejection_reason: Why it is not to be believed; None if it is.
    """

    metres_per_unit: float
    cues: tuple[str, ...]
    ground: float | None
    place: float | None
    spread: float
    rejection_reason: str | None = None


def estimate_metric_scale(standing: PersonInCameras, floor: FloorPlane | None) -> MetricScale:
    """Estimate the scale by all cues that hold; `floor` is None if it was not seen."""
    contact = heights = np.zeros(0)
    if floor is not None and floor.points and len(standing.centers) >= MIN_FRAMES:
        heights = floor.heights_above(standing.centers)
        turned = np.einsum("nab,nkb->nka", standing.world_from_camera, standing.soles)
        contact = SOLE_THICKNESS_M - (turned @ floor.normal).min(axis=1)
    ground, spread = _scale_from_ground(heights, contact)
    seen = np.einsum("nab,nb->na", standing.world_from_camera, standing.pelvis_positions)
    moves = (standing.centers - standing.centers.mean(axis=0)).ravel()
    stays = -(seen - seen.mean(axis=0)).ravel()
    place, wander = _scale_from_static_person(moves, stays)
    if ground is not None and spread <= 0.25:
        if place is None or abs(place - ground) > 0.1 * ground:  # the person walks
            scale, cues = ground, ("ground",)
        else:
            rows = np.concatenate([heights / SIGMA_GROUND_M, moves / SIGMA_PLACE_M])
            right = np.concatenate([contact / SIGMA_GROUND_M, stays / SIGMA_PLACE_M])
            scale = _fit_scale_huber(rows, right, 0.5 * (ground + place))
            cues = ("ground", "in place")
        return MetricScale(
            metres_per_unit=scale, cues=cues, ground=ground, place=place, spread=spread
        )
    refused = None
    if place is None or wander > 0.35:  # metres
        refused = (
            "nothing tells how large the room is: "
            + ("the floor was not seen" if ground is None else "the feet are never on the floor")
            + ", and the person does not stay in one place. Film so that the floor shows some "
            "texture (a rug, planks), or give cameras with a size of their own (ARKit, Record3D)"
        )
    return MetricScale(
        metres_per_unit=place or 1.0, cues=("in place",), ground=ground, place=place, spread=spread,
        rejection_reason=refused,
    )  # fmt: skip


def _scale_from_ground(
    heights: Float[np.ndarray, "frames"], contact: Float[np.ndarray, "frames"]
) -> tuple[float | None, float]:
    """The median over frames, and its relative spread."""
    usable = (heights > 0.0) & (contact > 0.0)
    if usable.sum() < MIN_FRAMES:
        return None, float("nan")
    each = contact[usable] / heights[usable]
    middle = float(np.median(each))
    return middle, 1.4826 * float(np.median(np.abs(each - middle))) / middle


def _scale_from_static_person(
    moves: Float[np.ndarray, "rows"], stays: Float[np.ndarray, "rows"]
) -> tuple[float | None, float]:
    """The scale for which the person moves least, and the r.m.s. distance from its place."""
    square = float((moves**2).sum())
    if len(moves) < 3 * MIN_FRAMES or square <= 0.0:
        return None, float("inf")
    scale = float((moves * stays).sum()) / square  # least squares: s = Σ a b / Σ a²
    if scale <= 0.0 or scale * np.sqrt(3.0 * square / len(moves)) < 0.3:  # metres of path
        return None, float("inf")
    return scale, float(np.sqrt(3.0 * ((moves * scale - stays) ** 2).mean()))


def _fit_scale_huber(
    rows: Float[np.ndarray, "rows"], right: Float[np.ndarray, "rows"], start: float
) -> float:
    """Least squares of rows · s = right, far ones weighing less (Huber 1964).

    Iteratively reweighted: s = Σ w a b / Σ w a², w = min(1, threshold / |a s - b|).
    """
    scale = start
    for _ in range(5):
        off = np.abs(rows * scale - right)
        weights = np.minimum(1.0, 1.345 / np.maximum(off, 1e-12))  # 95 % efficiency
        scale = float((weights * rows * right).sum() / (weights * rows**2).sum())
    return scale


def upright_axes(up: Vector3, towards_camera: Vector3) -> Matrix3:
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
    person: Vector3,
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
    """Cameras in metres and the poses in their world; before, each is in its frame's camera.

    Poses were made for the tracker's camera, at its world's origin; where that is unknown (None)
    they are taken to be right for the solved focal length.
    """
    lens = solved.lens(source.size_px)
    one = CameraTrack(cameras=(lens,), source="")
    if tracker_camera is not None:  # as the solved lens sees them where the tracker's did
        motion = replace(
            motion, space="camera", intrinsic=tracker_camera.intrinsic, assumed_focal=None
        )
        motion = place_in_camera_world(motion, shaped, one, cameras_given=True)
    numbers = np.nan_to_num(CaptureGeometry.of(motion, one, source).row_frames).round()
    frames = numbers.astype(np.int64).clip(0, source.frames_in_file - 1)
    usable = motion.valid & (solved.frame_status[frames] >= PLACED)
    standing = _person_in_cameras(solved, motion, frames, np.flatnonzero(usable), shaped)
    assert solved.model is not None
    up = _estimate_up(solved, motion, frames, usable)
    if solved.model.only_turns:  # in one place: the person's own metres are the world's
        floor = None
        scale = MetricScale(
            metres_per_unit=1.0, cues=("the person",), ground=None, place=None, spread=float("nan")
        )
    else:
        floor = fit_floor_plane(solved.model, up)
        scale = estimate_metric_scale(standing, floor)
    if scale.rejection_reason is not None:
        raise InputError(f"The cameras were solved, but {scale.rejection_reason}.")
    turned = np.einsum("nab,nb->na", standing.world_from_camera, standing.pelvis_positions)
    person = np.median(turned / scale.metres_per_unit + standing.centers, axis=0)
    ground = floor
    if ground is None:  # the level plane on which the lowest sole of most frames stands
        soles = np.einsum("nab,nkb->nka", standing.world_from_camera, standing.soles) @ up
        lowest = (soles.min(axis=1) - SOLE_THICKNESS_M) / scale.metres_per_unit
        offset = -float(np.median(lowest + standing.centers @ up))
        ground = FloorPlane(normal=up, offset=offset, points=0)
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


def _person_in_cameras(
    solved: CameraSolution,
    motion: Motion,
    frames: Int[np.ndarray, "poses"],
    rows: Int[np.ndarray, "usable"],
    shaped: ShapedBody,
) -> PersonInCameras:
    weights = shaped.body.weights
    feet = np.flatnonzero(weights[:, [7, 8, 10, 11]].sum(axis=1) > 0.5)  # ankles, feet
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
) -> Vector3:
    """Up as the person stands, unless the cameras are held quite otherwise."""
    assert solved.model is not None
    held = mean_camera_up(solved.model)
    if not usable.any():
        return held
    backs = rotation_matrices(motion.root_rotations[usable])[:, :, 1]
    views = solved.camera_from_solved[frames[usable], :3, :3]
    up = np.median(np.einsum("nba,nb->na", views, backs), axis=0)
    length = float(np.linalg.norm(up))
    if length < 0.5 or up @ held < length * np.cos(np.radians(30.0)):
        return held
    return up / length


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
