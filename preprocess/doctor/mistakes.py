"""The usual mistakes in a capture, each as the change that would undo it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from preprocess.doctor.claim import Claim
from preprocess.doctor.cure import (
    Cure,
    film_mirrored,
    film_reversed,
    film_shifted,
    film_turned,
    shifted,
)  # fmt: skip
from preprocess.kinematics import rotation_matrices
from preprocess.pose import Motion
from preprocess.skeleton import JOINT_NAMES

OFFSETS = (*range(1, 13), 15, 18, 21, 25, 30, 35, 40, 50, 60)
"""Frames by which poses may be late or early, at first look."""
MOST_SLACK = 24
"""Offsets that are tried, at most, where there are fewer poses than frames."""
RATES = (24.0, 25.0, 30.0, 50.0, 60.0)
"""Frames a second that are mistaken for one another."""
UNITS = {0.001: "millimetres", 0.01: "centimetres"}
OPENGL = np.diag([1.0, -1.0, -1.0])
FLIPS = {"y has": (1.0, -1.0, 1.0), "z has": (1.0, 1.0, -1.0), "y and z have": (1.0, -1.0, -1.0)}
MIRROR = np.diag([-1.0, 1.0, 1.0])
SWAPPED = [
    JOINT_NAMES.index(
        name.replace("left", "?").replace("right", "left").replace("?", "right")
    ) - 1
    for name in JOINT_NAMES[1:]
]  # fmt: skip
"""Row of each joint's other side among the 23 joint rotations."""

Rotation3 = Float[np.ndarray, "3 3"]


def cures(claim: Claim, pelvis: Float[np.ndarray, "3"], frames: int) -> Iterator[Cure]:
    """Every discrete mistake that the doctor knows; focal lengths and sizes are fitted instead.

    Args:
        claim: What the files say.
        pelvis: Rest place of the pelvis, J0, which the root turns about.
        frames: How many frames there are.
    """
    yield Cure(
        cause="mask_polarity",
        words="the masks are 1 where the person is not",
        undo=lambda c: replace(c, inverted=not c.inverted),
    )
    yield Cure(
        cause="second_person",
        words="the masks show somebody else, too, apart from the person whose poses are given",
        undo=lambda c: replace(c, alone=True),
    )
    yield from _wrong_world(claim)
    yield from _wrong_axes(claim)
    yield from _wrong_angles(claim)
    yield from _wrong_rotation()
    yield from (shifted(k) for near in OFFSETS if near < frames // 2 for k in (near, -near))
    rows = len(claim.places)
    if (
        rows < frames and np.ptp(claim.places) + 1 == rows
    ):  # the last frames' poses, or some between
        yield from (shifted(-k) for k in _slack(frames - rows))
    yield from _wrong_rate(claim, frames)
    yield from _wrong_side()
    yield from _wrong_origin(pelvis)
    yield from _wrong_units()


def film_cures(frames: int, masks: int, reach: int) -> Iterator[Cure]:
    """Every discrete mistake of a film whose masks and poses agree; crops are fitted instead.

    Args:
        frames: How many frames the film has.
        masks: How many masks there are.
        reach: Frames by which it may be late or early.
    """
    yield from (film_turned(turns) for turns in (1, 2, 3))
    yield from (film_mirrored(turns) for turns in range(4))
    yield from (film_shifted(k) for near in OFFSETS if near <= reach for k in (near, -near))
    yield from (film_shifted(k) for k in _slack(masks - frames))
    yield film_reversed(frames)


def _slack(most: int) -> list[int]:
    """Offsets from 1 to `most`, all of them or `MOST_SLACK`, evenly spread, the last one too."""
    return (
        sorted({round(k) for k in np.linspace(1, most, min(most, MOST_SLACK))}) if most > 0 else []
    )


def _wrong_units() -> Iterator[Cure]:
    """Places that are not in metres."""
    for factor, unit in UNITS.items():
        yield Cure(
            cause="body_scale",
            words=f"the poses' translations are in {unit}, not in metres",
            undo=lambda c, factor=factor: replace(
                c,
                motion=replace(c.motion, root_translations=c.motion.root_translations * factor),
            ),
        )


def _wrong_angles(claim: Claim) -> Iterator[Cure]:
    """Rotations that are not in radians, of which no joint needs so many."""
    motion = claim.motion
    roots, joints = motion.root_rotations[motion.valid], motion.joint_rotations[motion.valid]
    of_root, of_joints = (_beyond_a_turn(vectors) for vectors in (roots, joints))
    if of_root or of_joints:
        yield Cure(
            cause="root_rotation",
            words="the rotations are in degrees, not in radians",
            undo=lambda c: replace(c, motion=_in_radians(c.motion, of_root, of_joints)),
        )


def _beyond_a_turn(vectors: Float[np.ndarray, "*rows 3"]) -> bool:
    """Whether one of the axis-angles turns by more than a whole turn."""
    return bool((np.linalg.norm(vectors, axis=-1) > 2.0 * np.pi).any())


def _in_radians(motion: Motion, of_root: bool, of_joints: bool) -> Motion:
    """The motion with the root's angles, the joints', or both taken for degrees."""
    roots, joints = motion.root_rotations, motion.joint_rotations
    return replace(
        motion,
        root_rotations=np.deg2rad(roots) if of_root else roots,
        joint_rotations=np.deg2rad(joints) if of_joints else joints,
    )


def _wrong_world(claim: Claim) -> Iterator[Cure]:
    """Poses and cameras that are told in different worlds."""
    if not np.allclose(claim.extrinsics, np.eye(4), atol=1e-6):
        yield Cure(
            cause="world_frame",
            words="the poses are in the camera's own frame, and its position is applied twice",
            undo=lambda c: replace(c, extrinsics=np.broadcast_to(np.eye(4), c.extrinsics.shape)),
        )
        yield Cure(
            cause="world_frame",
            words="the camera matrices are world-from-camera, not camera-from-world",
            undo=lambda c: replace(c, extrinsics=np.linalg.inv(c.extrinsics)),
        )
        yield Cure(
            cause="opengl_axes",
            words="the camera matrices are world-from-camera with OpenGL's axes (y up, z back)",
            undo=lambda c: replace(c, extrinsics=_rigid(OPENGL) @ np.linalg.inv(c.extrinsics)),
        )


def _wrong_axes(claim: Claim) -> Iterator[Cure]:
    """OpenGL's axes where OpenCV's were expected, in all numbers or in some."""
    yield Cure(
        cause="opengl_axes",
        words="camera space has OpenGL's axes (y up, z back), not OpenCV's (y down, z forward)",
        undo=lambda c: replace(c, extrinsics=_rigid(OPENGL) @ c.extrinsics),
    )
    if not np.allclose(claim.extrinsics, np.eye(4), atol=1e-6):
        yield Cure(
            cause="opengl_axes",
            words="the poses' world has y and z the other way round",
            undo=lambda c: replace(c, extrinsics=c.extrinsics @ _rigid(OPENGL)),
        )
    yield Cure(
        cause="opengl_axes",
        words="the roots' rotations and translations have y and z the other way round",
        undo=lambda c: _turned_about_the_origin(c, OPENGL),
    )
    yield Cure(
        cause="opengl_axes",
        words="the root's rotation has OpenGL's axes, its translation OpenCV's",
        undo=lambda c: _turned_in_place(c, OPENGL),
    )
    for which, signs in FLIPS.items():
        flip = np.diag(np.array(signs, dtype=np.float64))
        yield Cure(
            cause="opengl_axes",
            words=f"in the root's translation {which} the wrong sign",
            undo=lambda c, flip=flip: _placed(c, flip),
        )


def _wrong_rotation() -> Iterator[Cure]:
    """Quarter turns: pictures that were turned for the tracker, and worlds with another axis up."""
    for degrees in (90, 180, 270):
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        yield Cure(
            cause="root_rotation",
            words=f"the tracker saw the pictures turned by {360 - degrees}°",
            undo=lambda c, turn=turn: replace(c, extrinsics=_rigid(turn) @ c.extrinsics),
        )
    for axis, degrees in [(a, d) for a in "xyz" for d in (90, 180, 270) if (a, d) != ("x", 180)]:
        turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
        yield Cure(
            cause="root_rotation",
            words=f"the root is turned by {360 - degrees}° about the camera's {axis}",
            undo=lambda c, turn=turn: _turned_in_place(c, turn),
        )
    for axis, degrees in (("x", 90), ("x", 180), ("x", 270), ("y", 90), ("y", 180), ("y", 270)):
        turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
        yield Cure(
            cause="root_rotation",
            words=f"the body at rest is turned by {360 - degrees}° about its {axis}",
            undo=lambda c, turn=turn: _with_root(c, _roots(c.motion) @ turn),
        )
    for degrees in (90, 270):
        turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
        yield Cure(
            cause="root_rotation",
            words="the poses' world has z up where the camera's has y, or the other way round",
            undo=lambda c, turn=turn: replace(c, extrinsics=c.extrinsics @ _rigid(turn)),
        )
        yield Cure(
            cause="root_rotation",
            words="the poses' world has z up where the camera's has y, or the other way round "
            "(rotations and translations were converted without the pelvis's offset)",
            undo=lambda c, turn=turn: _turned_about_the_origin(c, turn),
        )


def _wrong_rate(claim: Claim, frames: int) -> Iterator[Cure]:
    """Poses of a copy of the video with another number of frames a second, or played backwards."""
    known = claim.places[np.isfinite(claim.places)]
    if len(known) > 1:
        ends = known.min() + known.max()
        yield Cure(
            cause="frame_rate",
            words="the film runs backwards against its poses",
            undo=lambda c: replace(c, places=ends - c.places),
        )
    factors = {a / b for a in RATES for b in RATES if a != b}
    rows = len(claim.places)
    if rows != frames:
        factors.add(frames / rows)
    for factor in sorted(factors):
        yield Cure(
            cause="frame_rate",
            words=f"the poses were made at {1.0 / factor:.3g} times the video's frame rate",
            undo=lambda c, factor=factor: replace(c, places=c.places * factor),
        )


def _wrong_side() -> Iterator[Cure]:
    """Left taken for right: in the joints' order, in the body, or in the picture."""
    yield Cure(
        cause="left_right",
        words="the joints of the left and the right side are exchanged",
        undo=lambda c: replace(
            c, motion=replace(c.motion, joint_rotations=c.motion.joint_rotations[:, SWAPPED])
        ),
    )
    yield Cure(
        cause="left_right",
        words="the limbs are mirrored",
        undo=lambda c: replace(c, motion=_mirrored_limbs(c.motion)),
    )
    yield Cure(
        cause="left_right",
        words="the tracker saw the pictures mirrored",
        undo=lambda c: _mirrored_picture(c),
    )


def _wrong_origin(pelvis: Float[np.ndarray, "3"]) -> Iterator[Cure]:
    """EasyMocap turns bodies about the origin, SMPL about the pelvis: R x + t, and back."""

    def undo(claim: Claim, sign: float) -> Claim:
        moved = sign * (_roots(claim.motion) @ pelvis - pelvis)
        there = claim.motion.root_translations + moved
        return replace(claim, motion=replace(claim.motion, root_translations=there))

    yield Cure(
        cause="root_origin",
        words="the root turns about the origin (EasyMocap, ZJU), not about the pelvis",
        undo=lambda c: undo(c, 1.0),
    )
    yield Cure(
        cause="root_origin",
        words="the root's translation was already converted from the origin to the pelvis",
        undo=lambda c: undo(c, -1.0),
    )


def _rigid(rotation: Rotation3) -> Float[np.ndarray, "4 4"]:
    transform = np.eye(4)
    transform[:3, :3] = rotation
    return transform


def _roots(motion: Motion) -> Float[np.ndarray, "poses 3 3"]:
    return rotation_matrices(np.nan_to_num(motion.root_rotations))


def _with_root(claim: Claim, roots: Float[np.ndarray, "poses 3 3"]) -> Claim:
    vectors = Rotation.from_matrix(roots).as_rotvec()
    return replace(claim, motion=replace(claim.motion, root_rotations=vectors))


def _camera_turns(claim: Claim) -> Float[np.ndarray, "poses 3 3"]:
    """Rotation from the world into the camera of each row."""
    return claim.extrinsics[claim.camera_rows(), :3, :3]


def _turned_in_place(claim: Claim, turn: Rotation3) -> Claim:
    """The root turned in the camera's axes, about the pelvis, which stays."""
    cameras = _camera_turns(claim)
    return _with_root(claim, np.swapaxes(cameras, 1, 2) @ turn @ cameras @ _roots(claim.motion))


def _turned_about_the_origin(claim: Claim, turn: Rotation3) -> Claim:
    """Root rotations and translations in another world, as converters write them that forget J0.

    A pose's pelvis is at J0 + translation, so a correct conversion rotates that sum.
    """
    motion = claim.motion
    moved = replace(motion, root_translations=motion.root_translations @ turn.T)
    return _with_root(replace(claim, motion=moved), turn @ _roots(motion))


def _placed(claim: Claim, change: Rotation3) -> Claim:
    """The root's place changed in the camera's axes; its rotation stays."""
    rows = claim.camera_rows()
    turned, moved = claim.extrinsics[rows, :3, :3], claim.extrinsics[rows, :3, 3]
    translations = claim.motion.root_translations
    seen = np.einsum("cab,cb->ca", turned, translations) + moved
    back = np.einsum("cba,cb->ca", turned, seen @ change.T - moved)
    return replace(claim, motion=replace(claim.motion, root_translations=back))


def _mirrored_limbs(motion: Motion) -> Motion:
    """Each limb moves as the other side's did in a mirror."""
    limbs = motion.joint_rotations[:, SWAPPED] * np.array([1.0, -1.0, -1.0])
    return replace(motion, joint_rotations=limbs)


def _mirrored_picture(claim: Claim) -> Claim:
    """The person as a mirror shows them, left and right exchanged in the camera's axes."""
    mirrored = _placed(claim, MIRROR)
    cameras = _camera_turns(claim)
    back = np.swapaxes(cameras, 1, 2)
    roots = back @ MIRROR @ cameras @ _roots(claim.motion) @ MIRROR
    return _with_root(replace(mirrored, motion=_mirrored_limbs(mirrored.motion)), roots)
