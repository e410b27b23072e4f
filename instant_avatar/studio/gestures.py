"""Words for poses: a gesture names the limbs' positions, and becomes 23 joint rotations.

Angles are in degrees, because they are for people to read. Left and right mirror each other: a
positive number does to the right arm what it does to the left.

The figures of the dances, and twelve poses that no film holds.
"""

from dataclasses import dataclass, replace

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
    """Angles of an arm, degrees.

    Attributes:
        lift: Upper arm above the horizontal (-90 hangs, 90 points up).
        forward: Upper arm swung to the front.
        twist: Upper arm turned about itself; positive: the bent forearm rises.
        wrist: Hand bent down.
    """

    lift: Degrees = -50.0
    forward: Degrees = 0.0
    twist: Degrees = 0.0
    elbow: Degrees = 12.0
    wrist: Degrees = 0.0


@dataclass(frozen=True, kw_only=True)
class Leg:
    """Angles of a leg, degrees.

    Attributes:
        forward: Thigh raised to the front.
        out: Thigh spread to its side.
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
    """Position of the whole body; angles in degrees, lengths in metres.

    Attributes:
        right, right_leg: Like the left ones if None.
        bow, lean, turn: The back: to the front, to the left side, twisted to the left.
        nod, tilt, look: The head: down, to its left, turned left.
        yaw: The whole body turned left.
        shift: Position on the floor: to the body's left and to the front.
        hop: Height above the floor.
    """

    left: Arm = Arm()
    right: Arm | None = None
    left_leg: Leg = Leg()
    right_leg: Leg | None = None
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
            left=self.right or self.left,
            right=self.left,
            left_leg=self.right_leg or self.left_leg,
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
            _put_arm(vectors, (self.left, self.right or self.left)[side], side, sign)
            _put_leg(vectors, (self.left_leg, self.right_leg or self.left_leg)[side], side, sign)
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


SMALL_STEP = Leg(out=13.0, forward=9.0, knee=16.0)
RAISED_LEG = Leg(out=6.0, forward=38.0, knee=62.0, heel=12.0)
TIPTOE = Leg(out=7.0, forward=14.0, knee=38.0, heel=26.0)

GROOVE = Gesture(
    left=Arm(lift=-52, forward=30, twist=10, elbow=75),
    right=Arm(lift=-40, forward=-18, elbow=50),
    left_leg=SMALL_STEP,
    right_leg=TIPTOE,
    lean=6,
    turn=14,
    look=-10,
    shift=(0.07, 0.0),
)
WAVE = Gesture(
    left=Arm(lift=14, forward=12, twist=62, elbow=66),
    right=Arm(lift=-30, forward=10, elbow=20),
    left_leg=SMALL_STEP,
    lean=-8,
    tilt=-8,
    shift=(-0.06, 0.0),
)
CROSS = Gesture(
    left=Arm(lift=-22, forward=62, elbow=88),
    right=Arm(lift=-14, forward=62, elbow=80),
    left_leg=TIPTOE,
    right_leg=SMALL_STEP,
    bow=8,
    nod=8,
)
OPEN = Gesture(
    left=Arm(lift=8, forward=8, elbow=8),
    left_leg=Leg(out=16, forward=18, knee=34),
    nod=-8,
)
POINT = Gesture(
    left=Arm(lift=38, forward=10, elbow=6),
    right=Arm(lift=-46, forward=12, twist=-40, elbow=80),
    left_leg=SMALL_STEP,
    right_leg=Leg(out=18, forward=4, knee=8),
    lean=-9,
    turn=10,
    look=16,
    nod=-8,
)
KICK = Gesture(
    left=Arm(lift=-18, forward=40, elbow=50),
    right=Arm(lift=-10, forward=-20, elbow=40),
    left_leg=RAISED_LEG,
    right_leg=Leg(out=4, forward=8, knee=14),
    bow=-3,
    turn=-10,
)
ROBOT = Gesture(
    left=Arm(lift=-4, forward=10, twist=85, elbow=88),
    right=Arm(lift=-4, forward=10, twist=-75, elbow=88),
    left_leg=SMALL_STEP,
    look=-18,
)
SHUFFLE = Gesture(
    left=Arm(lift=-60, forward=-25, elbow=70),
    right=Arm(lift=-56, forward=42, elbow=85),
    left_leg=Leg(out=4, forward=24, knee=20),
    right_leg=Leg(out=8, forward=-12, knee=18, heel=10),
    turn=-12,
)

UNFILMED_DANCE = (
    GROOVE, GROOVE.mirror(), WAVE, WAVE.mirror(), OPEN, CROSS, SHUFFLE, SHUFFLE.mirror(),
    POINT, POINT.mirror(), KICK, KICK.mirror(), ROBOT, ROBOT.mirror(), OPEN, GROOVE,
)  # fmt: skip
FILMED_DANCE = (
    GROOVE.mirror(), OPEN, KICK, WAVE, SHUFFLE.mirror(), POINT.mirror(), CROSS, ROBOT,
    GROOVE, KICK.mirror(),
)  # fmt: skip

NOVEL_POSES = (
    Gesture(left=Arm(lift=38, elbow=10), nod=-10, left_leg=SMALL_STEP, right_leg=Leg()),
    Gesture(
        left=Arm(lift=-74, forward=6, elbow=4),
        left_leg=Leg(out=5),
        look=25,
    ),
    Gesture(
        left=Arm(lift=-4, forward=70, elbow=10),
        left_leg=Leg(out=10, forward=50, knee=75, turn=12),
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
        left_leg=Leg(out=14, knee=4),
        yaw=30,
        lean=6,
    ),
    Gesture(
        left=Arm(lift=44, forward=20, twist=60, elbow=100),
        right=Arm(lift=-40, forward=30, elbow=60),
        left_leg=TIPTOE,
        right_leg=SMALL_STEP,
        turn=18,
        yaw=-20,
    ),
    Gesture(
        left=Arm(lift=0, elbow=4),
        left_leg=RAISED_LEG,
        right_leg=Leg(out=3, forward=3, knee=6),
        look=-20,
        yaw=15,
    ),
    Gesture(
        left=Arm(lift=-30, forward=75, elbow=110),
        right=Arm(lift=-40, forward=55, elbow=30),
        left_leg=SMALL_STEP,
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
        left_leg=Leg(out=15, forward=26, knee=44),
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
        right=Arm(lift=45, forward=14, elbow=14),
        left_leg=Leg(out=19, forward=6, knee=10),
        right_leg=SMALL_STEP,
        lean=14,
        tilt=10,
        yaw=-30,
    ),
)
