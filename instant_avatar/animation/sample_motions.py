"""Short motions that the player's page offers; each is a loop on the spot."""

import numpy as np
from scipy.interpolate import CubicSpline

from capture.source import ASSUMED_FPS
from instant_avatar.animation.driving_motion import demo_motion
from instant_avatar.studio.gestures import UNFILMED_DANCE, Arm, Gesture, Leg
from preprocess.body.body_pose import Motion

HANGING = Arm(lift=-72, elbow=14)
GREETINGS = tuple(
    Gesture(left=Arm(lift=12, forward=10, twist=72, elbow=elbow), right=HANGING, tilt=-5)
    for elbow in (55, 100)
)
"""A raised hand, in and out."""
STRIDE = Gesture(
    left=Arm(lift=-62, forward=-48, elbow=18),
    right=Arm(lift=-62, forward=62, elbow=32),
    left_leg=Leg(out=3, forward=26, knee=8),
    right_leg=Leg(out=3, forward=-16, knee=20, heel=22),
    turn=-8,
)
PASSING = Gesture(
    left=HANGING,
    right=HANGING,
    left_leg=Leg(out=3, forward=3, knee=6),
    right_leg=Leg(out=3, forward=24, knee=58, heel=10),
)
"""One leg passes the other, which stands."""


def sample_motions() -> dict[str, Motion]:
    """The motions by their names on the page; the first is the built-in one."""
    steps = (STRIDE, PASSING, STRIDE.mirror(), PASSING.mirror())
    return {
        "Turn": demo_motion(),
        "Wave": _looped(GREETINGS, 24),
        "Walk": _looped(steps, 36),
        "Dance": _looped(UNFILMED_DANCE[:-1], 180),
    }


def _looped(gestures: tuple[Gesture, ...], frames: int) -> Motion:
    """Through the gestures and back to the first, smooth to the second derivative."""
    keys = np.stack([gesture.joint_rotations().as_rotvec() for gesture in (*gestures, gestures[0])])
    times = np.linspace(0.0, frames, len(keys))
    still = np.zeros((frames, 3))
    return Motion(
        root_rotations=still,
        root_translations=still,
        joint_rotations=CubicSpline(times, keys, bc_type="periodic")(np.arange(frames)),
        valid=np.ones(frames, dtype=bool),
        betas=np.zeros(10),
        body_model="body24",
        times_s=np.arange(frames) / ASSUMED_FPS,
    )
