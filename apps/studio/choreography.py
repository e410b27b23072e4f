"""The figures of the dances, and twelve poses that no film holds."""

from apps.studio.gesture import Arm, Gesture, Leg

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
    right_leg=SMALL_STEP,
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
    right=Arm(lift=8, forward=8, elbow=8),
    left_leg=Leg(out=16, forward=18, knee=34),
    right_leg=Leg(out=16, forward=18, knee=34),
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
    right_leg=SMALL_STEP,
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
    Gesture(left=Arm(lift=38, elbow=10), right=Arm(lift=38, elbow=10), nod=-10, left_leg=SMALL_STEP),
    Gesture(
        left=Arm(lift=-74, forward=6, elbow=4),
        right=Arm(lift=-74, forward=6, elbow=4),
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
        right_leg=SMALL_STEP,
        turn=18,
        yaw=-20,
    ),
    Gesture(
        left=Arm(lift=0, elbow=4),
        right=Arm(lift=0, elbow=4),
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
        right=Arm(lift=45, forward=14, elbow=14),
        left_leg=Leg(out=19, forward=6, knee=10),
        right_leg=SMALL_STEP,
        lean=14,
        tilt=10,
        yaw=-30,
    ),
)
