"""Words for poses: a gesture names what the limbs do, and becomes 23 joint rotations.

Angles are in degrees, because they are for people to read. Left and right mirror each other: a
positive number does to the right arm what it does to the left.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

Degrees = float | int

# Rows of `joint_rotations` (joint number - 1).
HIPS, KNEES, ANKLES = (0, 1), (3, 4), (6, 7)
SPINE, NECK, HEAD = (2, 5, 8), 11, 14
COLLARS, SHOULDERS, ELBOWS, WRISTS = (12, 13), (15, 16), (17, 18), (19, 20)


@dataclass(frozen=True, kw_only=True)
class Arm:
    """Degrees.

    Attributes:
        lift: Upper arm above the horizontal (-90 hangs, 90 points up).
        forward: Upper arm swung to the front.
        twist: Upper arm turned about itself; positive: the bent forearm rises.
        elbow: How far the elbow is bent.
        wrist: How far the hand is bent down.
    """

    lift: Degrees = -50.0
    forward: Degrees = 0.0
    twist: Degrees = 0.0
    elbow: Degrees = 12.0
    wrist: Degrees = 0.0


@dataclass(frozen=True, kw_only=True)
class Leg:
    """Degrees.

    Attributes:
        forward: Thigh raised to the front.
        out: Thigh spread to its side.
        knee: How far the knee is bent.
        turn: Toes turned out.
        heel: Heel lifted; else the sole stays level.
    """

    forward: Degrees = 0.0
    out: Degrees = 6.0
    knee: Degrees = 0.0
    turn: Degrees = 4.0
    heel: Degrees = 0.0


@dataclass(frozen=True, kw_only=True)
class Gesture:
    """What the whole body does; angles in degrees, shift in metres.

    Attributes:
        left, right: Arms.
        left_leg, right_leg: Legs.
        bow, lean, turn: The back: to the front, to the left side, twisted to the left.
        nod, tilt, look: The head: down, to its left, turned left.
        yaw: The whole body turned left.
        shift: Where the body stands: to its left and to the front, metres.
        hop: Height above the floor, metres.
    """

    left: Arm = field(default_factory=Arm)
    right: Arm = field(default_factory=Arm)
    left_leg: Leg = field(default_factory=Leg)
    right_leg: Leg = field(default_factory=Leg)
    bow: Degrees = 0.0
    lean: Degrees = 0.0
    turn: Degrees = 0.0
    nod: Degrees = 0.0
    tilt: Degrees = 0.0
    look: Degrees = 0.0
    yaw: Degrees = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    hop: float = 0.0

    def mirror(self) -> "Gesture":
        """The same with left and right exchanged."""
        return replace(
            self,
            left=self.right,
            right=self.left,
            left_leg=self.right_leg,
            right_leg=self.left_leg,
            lean=-self.lean,
            turn=-self.turn,
            tilt=-self.tilt,
            look=-self.look,
            yaw=-self.yaw,
            shift=(-self.shift[0], self.shift[1]),
        )

    def joint_rotations(self) -> Rotation:
        """Local rotations of joints 1 … 23."""
        vectors = np.zeros((23, 3))
        for side, sign in ((0, 1.0), (1, -1.0)):
            _put_arm(vectors, (self.left, self.right)[side], side, sign)
            _put_leg(vectors, (self.left_leg, self.right_leg)[side], side, sign)
        for joint in SPINE:
            vectors[joint] = _vector("yxz", self.turn / 3, self.bow / 3, -self.lean / 3)
        for joint in (NECK, HEAD):
            vectors[joint] = _vector("yxz", self.look / 2, self.nod / 2, -self.tilt / 2)
        return Rotation.from_rotvec(vectors)


def _put_arm(vectors: Float[np.ndarray, "23 3"], arm: Arm, side: int, sign: float) -> None:
    # The collar bone follows an arm that rises above the shoulder.
    collar = max(0.0, arm.lift) * 0.30
    lift = arm.lift - collar
    vectors[COLLARS[side]] = _vector("z", sign * collar)
    vectors[SHOULDERS[side]] = _vector("yzx", -sign * arm.forward, sign * lift, -arm.twist)
    vectors[ELBOWS[side]] = _vector("y", -sign * arm.elbow)
    vectors[WRISTS[side]] = _vector("z", -sign * arm.wrist)


def _put_leg(vectors: Float[np.ndarray, "23 3"], leg: Leg, side: int, sign: float) -> None:
    vectors[HIPS[side]] = _vector("zxy", sign * leg.out, -leg.forward, sign * leg.turn)
    vectors[KNEES[side]] = _vector("x", leg.knee)
    vectors[ANKLES[side]] = _vector("xz", leg.forward - leg.knee + leg.heel, -sign * leg.out)


def _vector(axes: str, *degrees: Degrees) -> Float[np.ndarray, "3"]:
    """Axis-angle of turns about the world's axes; the first named is the outermost."""
    return Rotation.from_euler(axes.upper(), degrees, degrees=True).as_rotvec().reshape(3)
