"""What the actor does: the turn, the dance, the clip that is never filmed, and twelve poses apart."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from apps.studio.actor import Actor
from apps.studio.gesture import Arm, Gesture, Leg
from preprocess.pose import BodyPose, Motion

NOISE_FRAMES = 3.0
"""A tracker wanders rather than flickers: its error is smooth over about this many frames."""


def turn(actor: Actor, *, frames: int, fps: float, turns: float, seed: int) -> Motion:
    """Turning round on the spot, arms held off the body, swaying a little (PeopleSnapshot's way)."""
    phases = np.random.default_rng([seed, 1]).uniform(0.0, 2.0 * np.pi, 8)
    return _acted(actor, [_turning(i / frames, turns, phases) for i in range(frames)], fps)


def _turning(share: float, turns: float, phases: Float[np.ndarray, "8"]) -> Gesture:
    """The turn after `share` of its length."""
    wave = np.sin(2.0 * np.pi * share * np.array([3, 2, 5, 3, 4, 2, 3, 5]) + phases)
    knee = 7.0 + 6.0 * wave[4]
    bend = Leg(out=5.0 + wave[3], forward=0.55 * knee, knee=knee)
    return Gesture(
        left=Arm(lift=-44.0 + 9.0 * wave[0], forward=8.0 * wave[1], elbow=16.0 + 9.0 * wave[2]),
        right=Arm(lift=-44.0 + 9.0 * wave[5], forward=8.0 * wave[6], elbow=16.0 - 9.0 * wave[2]),
        left_leg=bend,
        right_leg=bend,
        lean=2.5 * wave[3],
        turn=4.0 * wave[7],
        nod=3.0 * wave[2],
        look=9.0 * wave[6],
        yaw=360.0 * turns * share,
    )


STEP = Leg(out=13.0, forward=9.0, knee=16.0)
LIFTED = Leg(out=6.0, forward=38.0, knee=62.0, heel=12.0)
TIPTOE = Leg(out=7.0, forward=14.0, knee=38.0, heel=26.0)

GROOVE = Gesture(
    left=Arm(lift=-52, forward=30, twist=10, elbow=75),
    right=Arm(lift=-40, forward=-18, elbow=50),
    left_leg=STEP,
    right_leg=TIPTOE,
    lean=6,
    turn=14,
    look=-10,
    shift=(0.07, 0.0),
)
WAVE = Gesture(
    left=Arm(lift=22, forward=12, twist=70, elbow=70),
    right=Arm(lift=-30, forward=10, elbow=20),
    left_leg=STEP,
    right_leg=STEP,
    lean=-8,
    tilt=-8,
    shift=(-0.06, 0.0),
)
CROSS = Gesture(
    left=Arm(lift=-22, forward=62, elbow=88),
    right=Arm(lift=-14, forward=62, elbow=80),
    left_leg=TIPTOE,
    right_leg=STEP,
    bow=8,
    nod=8,
)
OPEN = Gesture(
    left=Arm(lift=8, forward=8, elbow=8),
    right=Arm(lift=8, forward=8, elbow=8),
    left_leg=Leg(out=16, forward=18, knee=34),
    right_leg=Leg(out=16, forward=18, knee=34),
    nod=-8,
)
POINT = Gesture(
    left=Arm(lift=52, forward=10, elbow=6),
    right=Arm(lift=-46, forward=12, twist=-40, elbow=80),
    left_leg=STEP,
    right_leg=Leg(out=18, forward=4, knee=8),
    lean=-9,
    turn=10,
    look=16,
    nod=-8,
)
KICK = Gesture(
    left=Arm(lift=-18, forward=40, elbow=50),
    right=Arm(lift=-10, forward=-20, elbow=40),
    left_leg=LIFTED,
    right_leg=Leg(out=4, forward=8, knee=14),
    bow=-3,
    turn=-10,
)
ROBOT = Gesture(
    left=Arm(lift=-4, forward=10, twist=85, elbow=88),
    right=Arm(lift=-4, forward=10, twist=-75, elbow=88),
    left_leg=STEP,
    right_leg=STEP,
    look=-18,
)
SHUFFLE = Gesture(
    left=Arm(lift=-60, forward=-25, elbow=70),
    right=Arm(lift=-56, forward=42, elbow=85),
    left_leg=Leg(out=4, forward=24, knee=20),
    right_leg=Leg(out=8, forward=-12, knee=18, heel=10),
    turn=-12,
)

CLIP = (
    GROOVE, GROOVE.mirrored(), WAVE, WAVE.mirrored(), OPEN, CROSS, SHUFFLE, SHUFFLE.mirrored(),
    POINT, POINT.mirrored(), KICK, KICK.mirrored(), ROBOT, ROBOT.mirrored(), OPEN, GROOVE,
)  # fmt: skip
FILMED_DANCE = (
    GROOVE.mirrored(), OPEN, KICK, WAVE, SHUFFLE.mirrored(), POINT.mirrored(), CROSS, ROBOT,
    GROOVE, KICK.mirrored(),
)  # fmt: skip


def dance(actor: Actor, *, frames: int, fps: float, turns: float, seed: int) -> Motion:
    """A dance that turns round while it goes, for filming."""
    keys = list(FILMED_DANCE)
    np.random.default_rng([seed, 2]).shuffle(keys)
    return _acted(actor, _danced(keys, frames, turns), fps)


def clip(actor: Actor, *, frames: int = 150, fps: float = 30.0) -> Motion:
    """The driving motion: a dance with one turn that no camera has seen."""
    keys = [replace(key, hop=0.03 if key is KICK else 0.0) for key in CLIP]
    return _acted(actor, _danced(keys, frames, 1.0), fps)


NOVEL = (
    Gesture(left=Arm(lift=38, elbow=10), right=Arm(lift=38, elbow=10), nod=-10, left_leg=STEP),
    Gesture(
        left=Arm(lift=-68, forward=6, elbow=8),
        right=Arm(lift=-68, forward=6, elbow=8),
        left_leg=Leg(out=5),
        right_leg=Leg(out=5),
        look=25,
    ),
    Gesture(
        left=Arm(lift=-4, forward=70, elbow=10),
        right=Arm(lift=-4, forward=70, elbow=10),
        left_leg=Leg(out=10, forward=50, knee=75, turn=12),
        right_leg=Leg(out=10, forward=50, knee=75, turn=12),
        bow=22,
    ),
    Gesture(
        left=Arm(lift=-58, forward=-26, elbow=30),
        right=Arm(lift=-58, forward=34, elbow=40),
        left_leg=Leg(out=3, forward=28, knee=14),
        right_leg=Leg(out=3, forward=-20, knee=16, heel=22),
        yaw=-60,
    ),
    Gesture(
        left=Arm(lift=-48, forward=20, twist=-45, elbow=95),
        right=Arm(lift=-48, forward=20, twist=-45, elbow=95),
        left_leg=Leg(out=14, knee=4),
        right_leg=Leg(out=14, knee=4),
        yaw=30,
        lean=6,
    ),
    Gesture(
        left=Arm(lift=44, forward=20, twist=60, elbow=100),
        right=Arm(lift=-40, forward=30, elbow=60),
        left_leg=TIPTOE,
        right_leg=STEP,
        turn=18,
        yaw=-20,
    ),
    Gesture(
        left=Arm(lift=0, elbow=4),
        right=Arm(lift=0, elbow=4),
        left_leg=LIFTED,
        right_leg=Leg(out=3, forward=3, knee=6),
        look=-20,
        yaw=15,
    ),
    Gesture(
        left=Arm(lift=-30, forward=75, elbow=110),
        right=Arm(lift=-40, forward=55, elbow=30),
        left_leg=STEP,
        right_leg=TIPTOE,
        bow=14,
        nod=14,
        yaw=110,
    ),
    Gesture(
        left=Arm(lift=14, forward=-12, elbow=20),
        right=Arm(lift=-26, forward=52, twist=40, elbow=90),
        left_leg=Leg(out=20, forward=22, knee=46),
        right_leg=Leg(out=22, forward=2, knee=4),
        lean=10,
        yaw=-140,
        shift=(-0.05, 0.0),
    ),
    Gesture(
        left=Arm(lift=30, forward=6, twist=88, elbow=95),
        right=Arm(lift=30, forward=6, twist=88, elbow=95),
        left_leg=Leg(out=15, forward=26, knee=44),
        right_leg=Leg(out=15, forward=26, knee=44),
        yaw=180,
    ),
    Gesture(
        left=Arm(lift=-54, forward=44, elbow=92),
        right=Arm(lift=-54, forward=-34, elbow=80),
        left_leg=Leg(out=3, forward=-22, knee=50, heel=24),
        right_leg=Leg(out=3, forward=44, knee=52),
        bow=8,
        turn=-14,
        yaw=80,
    ),
    Gesture(
        left=Arm(lift=-8, forward=-20, elbow=12),
        right=Arm(lift=56, forward=14, elbow=14),
        left_leg=Leg(out=19, forward=6, knee=10),
        right_leg=STEP,
        lean=14,
        tilt=10,
        yaw=-30,
    ),
)


def novel(actor: Actor, *, fps: float = 30.0) -> Motion:
    """Twelve poses that neither film holds: arms up and down, bent knees, steps, from all sides."""
    return _acted(actor, list(NOVEL), fps)


def _danced(keys: list[Gesture], frames: int, turns: float) -> list[tuple[Gesture, Rotation]]:
    """Gestures on the way through the keys, smooth to the second derivative, with rotations."""
    at = np.linspace(0.0, frames - 1.0 if frames > 1 else 1.0, len(keys))
    stacked = np.stack([key.rotations().as_rotvec() for key in keys])
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


def _acted(
    actor: Actor, gestures: list[Gesture] | list[tuple[Gesture, Rotation]], fps: float
) -> Motion:
    """Gestures as poses of the actor, the lowest point of each on the floor (y = 0)."""
    poses = [_posed(actor, *(g if isinstance(g, tuple) else (g, g.rotations()))) for g in gestures]
    count = len(poses)
    return Motion(
        root_rotations=np.stack([pose.root_rotation for pose in poses]),
        root_translations=np.stack([pose.root_translation for pose in poses]),
        joint_rotations=np.stack([pose.joint_rotations for pose in poses]),
        valid=np.ones(count, dtype=bool),
        betas=actor.betas,
        model="body24",
        frames=np.arange(count),
        times_s=np.arange(count) / fps,
    )


def _posed(actor: Actor, gesture: Gesture, rotations: Rotation) -> BodyPose:
    pelvis = actor.shaped.joints[0]
    pose = BodyPose(
        root_rotation=np.array([0.0, np.deg2rad(gesture.yaw), 0.0]),
        root_translation=np.array([gesture.shift[0], 0.0, gesture.shift[1]]) - pelvis,
        joint_rotations=rotations.as_rotvec(),
    )
    lifted = np.array([0.0, gesture.hop - actor.lowest(pose), 0.0])
    return replace(pose, root_translation=pose.root_translation + lifted)


def tracked(motion: Motion, *, degrees: float, centimetres: float, seed: int) -> Motion:
    """What a tracker would have said: the motion with smooth noise on rotations and place.

    Args:
        motion: The truth.
        degrees: Standard deviation of each component of each axis-angle.
        centimetres: Standard deviation of each component of the root's place.
        seed: Of the noise.
    """
    if degrees == 0.0 and centimetres == 0.0:
        return motion
    generator = np.random.default_rng([seed, 3])
    frames = len(motion)
    turned = _smooth_noise(generator, (frames, 24, 3)) * np.deg2rad(degrees)
    moved = _smooth_noise(generator, (frames, 3)) * centimetres / 100.0
    return replace(
        motion,
        root_rotations=motion.root_rotations + turned[:, 0],
        root_translations=motion.root_translations + moved,
        joint_rotations=motion.joint_rotations + turned[:, 1:],
    )


def _smooth_noise(
    generator: np.random.Generator, shape: tuple[int, ...]
) -> Float[np.ndarray, "frames *rest"]:
    """Gaussian noise of unit variance, smooth over `NOISE_FRAMES` frames."""
    margin = int(4 * NOISE_FRAMES)
    white = generator.standard_normal((shape[0] + 2 * margin, *shape[1:]))
    smooth = gaussian_filter1d(white, NOISE_FRAMES, axis=0)[margin:-margin]
    # The power of a Gaussian filter: its variance falls to 1 / (2 √π σ).
    return smooth * np.sqrt(2.0 * np.sqrt(np.pi) * NOISE_FRAMES)


def held_apart(novel: Motion, filmed: Motion) -> Float[np.ndarray, "poses"]:
    """For each pose, how far it is from the nearest filmed one: the largest joint angle, radians."""
    gaps = []
    for pose in novel.joint_rotations:
        difference = Rotation.from_rotvec(filmed.joint_rotations.reshape(-1, 3)).inv()
        angle = (difference * Rotation.from_rotvec(np.tile(pose, (len(filmed), 1)))).magnitude()
        gaps.append(angle.reshape(len(filmed), 23).max(axis=1).min())
    return np.array(gaps)

