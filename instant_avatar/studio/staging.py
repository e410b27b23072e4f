"""Staging: the actor's motion, and the camera's position, frame by frame.

The actor turns, dances, dances a clip that is never filmed, or takes twelve poses apart. The camera
stands 3.2 m away at chest height with the whole person in the picture, or a phone is carried around
the actor.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from capture.camera import Camera
from capture.input_error import InputError
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.gestures import (
    FILMED_DANCE,
    KICK,
    NOVEL_POSES,
    UNFILMED_DANCE,
    Arm,
    Gesture,
    Leg,
)
from instant_avatar.studio.input_errors import smooth_noise
from preprocess.body.body_pose import BodyPose, Motion


def turning_motion(
    actor: Actor,
    *,
    frames: int,
    fps: float,
    turns: float,
    seed: int,
    arm_lift_deg: float = -44.0,
) -> Motion:
    """Turning round on the spot, arms off the body, swaying a little (PeopleSnapshot's way)."""
    phases = np.random.default_rng([seed, 1]).uniform(0.0, 2.0 * np.pi, 8)
    gestures = [_turning_gesture(i / frames, turns, phases, arm_lift_deg) for i in range(frames)]
    return _motion_from_gestures(actor, gestures, fps)


def _turning_gesture(
    share: float, turns: float, phases: Float[np.ndarray, "8"], lift: float
) -> Gesture:
    """The turn after `share` of its length, the arms at `lift` degrees."""
    wave = np.sin(2.0 * np.pi * share * np.array([3, 2, 5, 3, 4, 2, 3, 5]) + phases)
    knee = 7.0 + 6.0 * wave[4]
    bend = Leg(out=5.0 + wave[3], forward=0.55 * knee, knee=knee)
    return Gesture(
        left=Arm(lift=lift + 9.0 * wave[0], forward=8.0 * wave[1], elbow=16.0 + 9.0 * wave[2]),
        right=Arm(lift=lift + 9.0 * wave[5], forward=8.0 * wave[6], elbow=16.0 - 9.0 * wave[2]),
        left_leg=bend,
        lean=2.5 * wave[3],
        turn=4.0 * wave[7],
        nod=3.0 * wave[2],
        look=9.0 * wave[6],
        yaw=360.0 * turns * share,
    )


def gesturing_motion(actor: Actor, *, frames: int, fps: float, turns: float, seed: int) -> Motion:
    """Gesture for a moving camera: arms, knees, a slow turn, shifts."""
    phases = np.random.default_rng([seed, 8]).uniform(0.0, 2.0 * np.pi, 12)
    gestures = [_waving_gesture(share, turns, phases) for share in np.arange(frames) / frames]
    return _motion_from_gestures(actor, gestures, fps)


def _waving_gesture(share: float, turns: float, phases: Float[np.ndarray, "12"]) -> Gesture:
    """The gestures after `share` of their length."""
    wave = np.sin(2.0 * np.pi * share * np.array([3, 2, 4, 3, 2, 4, 3, 2, 3, 4, 1, 1]) + phases)
    knees = 9.0 + 8.0 * wave[8], 9.0 + 8.0 * wave[9]
    arms = [
        Arm(
            lift=-30.0 + 20.0 * wave[i], forward=14.0 + 16.0 * wave[i + 1],
            elbow=34.0 + 24.0 * wave[i + 2], twist=16.0 * wave[i + 3],
        )
        for i in (0, 4)
    ]  # fmt: skip
    legs = [Leg(out=7.0, forward=0.55 * knee, knee=knee) for knee in knees]
    return Gesture(
        left=arms[0],
        right=arms[1],
        left_leg=legs[0],
        right_leg=legs[1],
        lean=3.0 * wave[9],
        turn=6.0 * wave[8],
        look=12.0 * wave[1],
        nod=4.0 * wave[2],
        yaw=360.0 * turns * share,
        shift=(0.08 * wave[10], 0.08 * wave[11]),
    )


def dancing_motion(actor: Actor, *, frames: int, fps: float, turns: float, seed: int) -> Motion:
    """A dance that turns round while it goes, for filming."""
    keys = list(FILMED_DANCE)
    np.random.default_rng([seed, 2]).shuffle(keys)
    return _motion_from_gestures(actor, _interpolate_gestures(keys, frames, turns), fps)


def unfilmed_dance(actor: Actor) -> Motion:
    """The driving motion: five seconds of a dance with one turn that no camera has seen."""
    keys = [replace(key, hop=0.03 if key is KICK else 0.0) for key in UNFILMED_DANCE]
    return _motion_from_gestures(actor, _interpolate_gestures(keys, 150, 1.0), 30.0)


def novel_poses(actor: Actor) -> Motion:
    """Twelve poses that neither film holds: arms up and down, bent knees, steps, from all sides."""
    return _motion_from_gestures(actor, list(NOVEL_POSES), 30.0)


def _interpolate_gestures(
    keys: list[Gesture], frames: int, turns: float
) -> list[tuple[Gesture, Rotation]]:
    """Gestures on the way through the keys, smooth to the second derivative, with rotations."""
    at = np.linspace(0.0, frames - 1.0 if frames > 1 else 1.0, len(keys))
    stacked = np.stack([key.joint_rotations().as_rotvec() for key in keys])
    times = np.arange(frames, dtype=np.float64)
    joints = [RotationSpline(at, Rotation.from_rotvec(stacked[:, j]))(times) for j in range(23)]
    vectors = np.stack([joint.as_rotvec() for joint in joints], axis=1)
    shift = np.stack([np.interp(times, at, [k.shift[a] for k in keys]) for a in (0, 1)], axis=1)
    shift = gaussian_filter1d(shift, 2.0, axis=0, mode="nearest")
    hop = np.interp(times, at, [key.hop for key in keys])
    return [
        (
            Gesture(yaw=360.0 * turns * i / frames, shift=tuple(shift[i]), hop=float(hop[i])),
            Rotation.from_rotvec(vectors[i]),
        )
        for i in range(frames)
    ]


def tracked_motion(actor: Actor, track: Motion, *, frames: int, fps: float) -> Motion:
    """Set a track's poses on the spot, evenly spread and upright; `InputError` if none is valid."""
    if not track.valid.any():
        raise InputError("The track holds no valid pose that could be filmed.")
    rows = np.flatnonzero(track.valid)
    rows = rows[np.linspace(0, len(rows) - 1, frames).round().astype(int)]
    turns = Rotation.from_rotvec(track.root_rotations[rows])
    # the body's y axis points down in a camera's axes
    if turns.as_matrix()[:, 1, 1].mean() < 0.0:
        turns = Rotation.from_rotvec([np.pi, 0.0, 0.0]) * turns
    on_the_spot, turned = -actor.shaped.joints[0], turns.as_rotvec()
    poses = [
        BodyPose(
            root_rotation=turned[i],
            root_translation=on_the_spot,
            joint_rotations=track.joint_rotations[row],
        )
        for i, row in enumerate(rows)
    ]
    return _motion_of([_set_on_floor(actor, pose, 0.0) for pose in poses], actor, fps)


def _motion_from_gestures(
    actor: Actor, gestures: list[Gesture] | list[tuple[Gesture, Rotation]], fps: float
) -> Motion:
    """Gestures as poses of the actor, the lowest point of each on the floor (y = 0)."""
    poses = [
        _pose_on_floor(actor, *(g if isinstance(g, tuple) else (g, g.joint_rotations())))
        for g in gestures
    ]
    return _motion_of(poses, actor, fps)


def _motion_of(poses: list[BodyPose], actor: Actor, fps: float) -> Motion:
    count = len(poses)
    return Motion(
        root_rotations=np.stack([pose.root_rotation for pose in poses]),
        root_translations=np.stack([pose.root_translation for pose in poses]),
        joint_rotations=np.stack([pose.joint_rotations for pose in poses]),
        valid=np.ones(count, dtype=bool),
        betas=actor.betas,
        body_model="body24",
        frames=np.arange(count),
        times_s=np.arange(count) / fps,
    )


def _pose_on_floor(actor: Actor, gesture: Gesture, rotations: Rotation) -> BodyPose:
    pelvis = actor.shaped.joints[0]
    pose = BodyPose(
        root_rotation=np.array([0.0, np.deg2rad(gesture.yaw), 0.0]),
        root_translation=np.array([gesture.shift[0], 0.0, gesture.shift[1]]) - pelvis,
        joint_rotations=rotations.as_rotvec(),
    )
    return _set_on_floor(actor, pose, gesture.hop)


def _set_on_floor(actor: Actor, pose: BodyPose, hop: float) -> BodyPose:
    """The pose with its soles `hop` metres above the floor."""
    lifted = np.array([0.0, hop - actor.sole_height_m(pose), 0.0])
    return replace(pose, root_translation=pose.root_translation + lifted)


STATIC_DISTANCE_M = 3.2


def static_camera(actor: Actor, size: int) -> Camera:
    """The studio's square camera, set up for one actor; the world's floor is y = 0."""
    return _frame_actor(actor, (size, size), height_share=0.825, headroom_share=0.110)


def portrait_camera(actor: Actor, width: int, *, dances: bool = False) -> Camera:
    """Return a phone's camera upright on a tripod, 9:16, set up for one actor; sides are even."""
    size_px = 2 * round(width / 2), 2 * round(width * 8 / 9)
    if dances:
        return _frame_actor(actor, size_px, height_share=0.62, headroom_share=0.20)
    return _frame_actor(actor, size_px, height_share=0.85, headroom_share=0.075)


def _frame_actor(
    actor: Actor, size_px: tuple[int, int], *, height_share: float, headroom_share: float
) -> Camera:
    """Frame the standing actor: shares of the image's height, of the person and above the head."""
    points, height = _standing_vertices(actor), size_px[1]
    focal, target = 1.3 * height, 0.9
    camera = _aim_camera(size_px, focal, target)
    for _ in range(12):
        rows = camera.project(points)[:, 1] / height
        focal *= height_share / float(np.ptp(rows))
        target += (headroom_share - float(rows.min())) * height * STATIC_DISTANCE_M / focal
        camera = _aim_camera(size_px, focal, target)
    return camera


def _standing_vertices(actor: Actor) -> Float[np.ndarray, "vertices 3"]:
    """The standing actor from the front and from the side, feet on the floor."""
    views = []
    for yaw in (0.0, 0.5 * np.pi):
        pelvis = actor.shaped.joints[0]
        pose = BodyPose(
            root_rotation=np.array([0.0, yaw, 0.0]),
            root_translation=-pelvis,
            joint_rotations=Gesture().joint_rotations().as_rotvec(),
        )
        views.append(actor.vertices(pose) - np.array([0.0, actor.sole_height_m(pose), 0.0]))
    return np.concatenate(views)


def _aim_camera(size_px: tuple[int, int], focal: float, target: float) -> Camera:
    """A camera in front of the actor that looks at the height `target` above the origin."""
    eye = np.array([0.0, 1.2, STATIC_DISTANCE_M])
    forward = np.array([0.0, target, 0.0]) - eye
    forward /= np.linalg.norm(forward)
    right = np.array([1.0, 0.0, 0.0])
    axes = np.stack([right, np.cross(forward, right), forward])
    return Camera.at(eye, axes, focal, size_px)


HANDHELD_HEIGHT_M = 1.4
SHAKE_M, SHAKE_DEG = 0.012, 0.6
"""Standard deviation of the hand's trembling, for each axis."""


def handheld_cameras(
    actor_xz_m: Float[np.ndarray, "frames 2"], height_m: float, size: int, seed: int
) -> tuple[Camera, ...]:
    """Return one camera a frame, on an arc around the actor, the actor in the image.

    `size` is the images' width in pixels; the height is 9/16 of it.
    """
    frames = len(actor_xz_m)
    generator = np.random.default_rng([seed, 7])
    # two frames more, as in the films of which the figures in docs and log are
    shake = smooth_noise(generator, (frames + 2, 6), 2.5)[1:-1]
    slow = smooth_noise(generator, (frames + 2, 3), max(frames / 6.0, 1.0))[1:-1]
    share = np.linspace(0.0, 1.0, frames) + 0.02 * np.sin(2.0 * np.pi * np.linspace(0, 1, frames))
    angles = np.deg2rad(120.0) * (share - 0.5)
    steps = np.arange(frames) * (2.0 * np.pi / 16.0)  # a step lifts the hand, twice a second
    away = 1.52 * height_m + 0.05 * np.tanh(slow[:, 0])
    eyes = np.column_stack(
        [away * np.sin(angles), np.full(frames, HANDHELD_HEIGHT_M), away * np.cos(angles)]
    )
    eyes[:, 1] += 0.03 * np.tanh(slow[:, 1]) + 0.012 * np.sin(steps)
    eyes += SHAKE_M * shake[:, :3]
    turned = np.deg2rad(SHAKE_DEG) * shake[:, 3:]
    turned[:, 2] += np.deg2rad(1.5) * np.tanh(slow[:, 2])
    return tuple(
        _aim_handheld_camera(eyes[i], actor_xz_m[i], height_m, size, turned[i])
        for i in range(frames)
    )


def standing_camera(height_m: float, size: int) -> Camera:
    """A camera that stands still in the middle of the arc, a step behind it."""
    eye = np.array([0.0, HANDHELD_HEIGHT_M, 3.4])
    return _aim_handheld_camera(eye, np.zeros(2), height_m, size, np.zeros(3))


def actor_height_m(actor: Actor) -> float:
    """Height of the standing actor, shoes and hair included."""
    pose = BodyPose.rest()
    return float(actor.vertices(pose)[:, 1].max() - actor.sole_height_m(pose))


def _aim_handheld_camera(
    eye: Float[np.ndarray, "3"],
    actor_xz_m: Float[np.ndarray, "2"],
    height_m: float,
    size: int,
    shake_rotation: Float[np.ndarray, "3"],
) -> Camera:
    """A camera whose picture has the head as far from its middle as the feet, then turned."""
    across = np.array([actor_xz_m[0] - eye[0], 0.0, actor_xz_m[1] - eye[2]])
    away = float(np.linalg.norm(across))
    ends = np.arctan2(height_m - eye[1], away), np.arctan2(-eye[1], away - 0.2)  # the nearer foot
    pitch = 0.5 * (ends[0] + ends[1]) + shake_rotation[0]
    yaw = np.arctan2(across[0], across[2]) + shake_rotation[1]
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cosine, sine = np.cos(shake_rotation[2]), np.sin(shake_rotation[2])
    axes = np.stack([cosine * right + sine * down, cosine * down - sine * right, forward])
    height = max(1, round(size * 9 / 16))
    return Camera.at(eye, axes, 0.68 * size, (size, height))  # a phone's main camera
