"""What the actor does: the turn, the dance, the clip never filmed, and twelve poses apart."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from capture.input_error import InputError
from preprocess.body.body_pose import BodyPose, Motion
from studio.actor import Actor
from studio.gestures import FILMED_DANCE, KICK, NOVEL_POSES, UNFILMED_DANCE, Arm, Gesture, Leg

ARM_LIFT_DEG = -44.0
"""Upper arms above the horizontal, while the actor turns before a wide camera."""


def turning_motion(
    actor: Actor,
    *,
    frames: int,
    fps: float,
    turns: float,
    seed: int,
    arm_lift_deg: float = ARM_LIFT_DEG,
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
        right_leg=bend,
        lean=2.5 * wave[3],
        turn=4.0 * wave[7],
        nod=3.0 * wave[2],
        look=9.0 * wave[6],
        yaw=360.0 * turns * share,
    )


def gesturing_motion(actor: Actor, *, frames: int, fps: float, turns: float, seed: int) -> Motion:
    """Gesture on the spot for a moving camera: arms, knees, a slow turn, small shifts."""
    phases = np.random.default_rng([seed, 8]).uniform(0.0, 2.0 * np.pi, 12)
    return _motion_from_gestures(
        actor, [_waving_gesture(i / frames, turns, phases) for i in range(frames)], fps
    )


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


def unfilmed_dance(actor: Actor, *, frames: int = 150, fps: float = 30.0) -> Motion:
    """The driving motion: a dance with one turn that no camera has seen."""
    keys = [replace(key, hop=0.03 if key is KICK else 0.0) for key in UNFILMED_DANCE]
    return _motion_from_gestures(actor, _interpolate_gestures(keys, frames, 1.0), fps)


def novel_poses(actor: Actor, *, fps: float = 30.0) -> Motion:
    """Twelve poses that neither film holds: arms up and down, bent knees, steps, from all sides."""
    return _motion_from_gestures(actor, list(NOVEL_POSES), fps)


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
    """A track's poses on the spot, evenly spread; one in a camera's axes (y down) is set upright.

    Raises:
        InputError: If the track holds no valid pose.
    """
    if not track.valid.any():
        raise InputError("The track holds no valid pose that could be filmed.")
    rows = np.flatnonzero(track.valid)
    rows = rows[np.linspace(0, len(rows) - 1, frames).round().astype(int)]
    turns = Rotation.from_rotvec(track.root_rotations[rows])
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


def nearest_pose_angles(novel: Motion, filmed: Motion) -> Float[np.ndarray, "poses"]:
    """How far each pose is from the nearest filmed one: the largest joint angle, radians."""
    gaps = []
    for pose in novel.joint_rotations:
        difference = Rotation.from_rotvec(filmed.joint_rotations.reshape(-1, 3)).inv()
        angle = (difference * Rotation.from_rotvec(np.tile(pose, (len(filmed), 1)))).magnitude()
        gaps.append(angle.reshape(len(filmed), 23).max(axis=1).min())
    return np.array(gaps)
