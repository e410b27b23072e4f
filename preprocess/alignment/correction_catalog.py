"""The usual mistakes in a capture, each as the change that would undo it."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.corrections import (  # fmt: skip
    Correction,
    undo_pose_delay,
    undo_video_mirroring,
    undo_video_offset,
    undo_video_reversal,
    undo_video_rotation,
)
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import JOINT_NAMES, rotation_matrices

FRAME_OFFSETS = (*range(1, 13), 15, 18, 21, 25, 30, 35, 40, 50, 60)
"""Frames by which poses may be late or early, at first look."""
MAX_UNMATCHED_OFFSETS = 24
"""Offsets that are tried, at most, where there are fewer poses than frames."""
FRAME_RATES = (24.0, 25.0, 30.0, 50.0, 60.0)
"""Frames a second that are mistaken for one another."""
TRANSLATION_UNITS = {0.001: "millimetres", 0.01: "centimetres"}
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
AXIS_FLIPS = {
    "y has": (1.0, -1.0, 1.0),
    "z has": (1.0, 1.0, -1.0),
    "y and z have": (1.0, -1.0, -1.0),
}
MIRROR_X = np.diag([-1.0, 1.0, 1.0])
MIRRORED_JOINTS = [
    JOINT_NAMES.index(
        name.replace("left", "?").replace("right", "left").replace("?", "right")
    ) - 1
    for name in JOINT_NAMES[1:]
]  # fmt: skip
"""Row of each joint's other side among the 23 joint rotations."""

Rotation3 = Float[np.ndarray, "3 3"]


def body_corrections(
    geometry: CaptureGeometry, pelvis: Float[np.ndarray, "3"], frames: int
) -> Iterator[Correction]:
    """Every discrete mistake that the doctor knows; focal lengths and sizes are fitted instead.

    Args:
        claim: What the files say.
        pelvis: Rest place of the pelvis, J0, which the root turns about.
        frames: How many frames there are.
    """
    yield Correction(
        cause="mask_polarity",
        description="the masks are 1 where the person is not",
        apply=lambda c: replace(c, masks_inverted=not c.masks_inverted),
    )
    yield Correction(
        cause="second_person",
        description="the masks show somebody else, too, apart from the person whose poses are given",
        apply=lambda c: replace(c, keeps_person_only=True),
    )
    yield from _world_frame_corrections(geometry)
    yield from _axis_corrections(geometry)
    yield from _angle_corrections(geometry)
    yield from _rotation_corrections()
    yield from (
        undo_pose_delay(k) for near in FRAME_OFFSETS if near < frames // 2 for k in (near, -near)
    )
    rows = len(geometry.row_frames)
    if (
        rows < frames and np.ptp(geometry.row_frames) + 1 == rows
    ):  # the last frames' poses, or some between
        yield from (undo_pose_delay(-k) for k in _spaced_offsets(frames - rows))
    yield from _frame_rate_corrections(geometry, frames)
    yield from _left_right_corrections()
    yield from _root_origin_corrections(pelvis)
    yield from _unit_corrections()


def video_corrections(frames: int, mask_count: int, max_offset: int) -> Iterator[Correction]:
    """Every discrete mistake of a film whose masks and poses agree; crops are fitted instead.

    Args:
        frames: How many frames the film has.
        masks: How many masks there are.
        reach: Frames by which it may be late or early.
    """
    yield from (undo_video_rotation(turns) for turns in (1, 2, 3))
    yield from (undo_video_mirroring(turns) for turns in range(4))
    yield from (
        undo_video_offset(k) for near in FRAME_OFFSETS if near <= max_offset for k in (near, -near)
    )
    yield from (undo_video_offset(k) for k in _spaced_offsets(mask_count - frames))
    yield undo_video_reversal(frames)


def _spaced_offsets(most: int) -> list[int]:
    """Offsets from 1 to `most`, all of them or `MAX_UNMATCHED_OFFSETS`, evenly spread, the last one too."""
    return (
        sorted({round(k) for k in np.linspace(1, most, min(most, MAX_UNMATCHED_OFFSETS))})
        if most > 0
        else []
    )


def _unit_corrections() -> Iterator[Correction]:
    """Places that are not in metres."""
    for factor, unit in TRANSLATION_UNITS.items():
        yield Correction(
            cause="body_scale",
            description=f"the poses' translations are in {unit}, not in metres",
            apply=lambda c, factor=factor: replace(
                c,
                motion=replace(c.motion, root_translations=c.motion.root_translations * factor),
            ),
        )


def _angle_corrections(claim: CaptureGeometry) -> Iterator[Correction]:
    """Rotations that are not in radians, of which no joint needs so many."""
    motion = claim.motion
    roots, joints = motion.root_rotations[motion.valid], motion.joint_rotations[motion.valid]
    of_root, of_joints = (_exceeds_full_turn(vectors) for vectors in (roots, joints))
    if of_root or of_joints:
        yield Correction(
            cause="root_rotation",
            description="the rotations are in degrees, not in radians",
            apply=lambda c: replace(c, motion=_degrees_to_radians(c.motion, of_root, of_joints)),
        )


def _exceeds_full_turn(vectors: Float[np.ndarray, "*rows 3"]) -> bool:
    """Whether one of the axis-angles turns by more than a whole turn."""
    return bool((np.linalg.norm(vectors, axis=-1) > 2.0 * np.pi).any())


def _degrees_to_radians(motion: Motion, convert_root: bool, convert_joints: bool) -> Motion:
    """The motion with the root's angles, the joints', or both taken for degrees."""
    roots, joints = motion.root_rotations, motion.joint_rotations
    return replace(
        motion,
        root_rotations=np.deg2rad(roots) if convert_root else roots,
        joint_rotations=np.deg2rad(joints) if convert_joints else joints,
    )


def _world_frame_corrections(claim: CaptureGeometry) -> Iterator[Correction]:
    """Poses and cameras that are told in different worlds."""
    if not np.allclose(claim.extrinsics, np.eye(4), atol=1e-6):
        yield Correction(
            cause="world_frame",
            description="the poses are in the camera's own frame, and its position is applied twice",
            apply=lambda c: replace(c, extrinsics=np.broadcast_to(np.eye(4), c.extrinsics.shape)),
        )
        yield Correction(
            cause="world_frame",
            description="the camera matrices are world-from-camera, not camera-from-world",
            apply=lambda c: replace(c, extrinsics=np.linalg.inv(c.extrinsics)),
        )
        yield Correction(
            cause="opengl_axes",
            description="the camera matrices are world-from-camera with OpenGL's axes (y up, z back)",
            apply=lambda c: replace(
                c, extrinsics=_rotation_transform(OPENCV_FROM_OPENGL) @ np.linalg.inv(c.extrinsics)
            ),
        )


def _axis_corrections(claim: CaptureGeometry) -> Iterator[Correction]:
    """OpenGL's axes where OpenCV's were expected, in all numbers or in some."""
    yield Correction(
        cause="opengl_axes",
        description="camera space has OpenGL's axes (y up, z back), not OpenCV's (y down, z forward)",
        apply=lambda c: replace(
            c, extrinsics=_rotation_transform(OPENCV_FROM_OPENGL) @ c.extrinsics
        ),
    )
    if not np.allclose(claim.extrinsics, np.eye(4), atol=1e-6):
        yield Correction(
            cause="opengl_axes",
            description="the poses' world has y and z the other way round",
            apply=lambda c: replace(
                c, extrinsics=c.extrinsics @ _rotation_transform(OPENCV_FROM_OPENGL)
            ),
        )
    yield Correction(
        cause="opengl_axes",
        description="the roots' rotations and translations have y and z the other way round",
        apply=lambda c: _rotate_without_pelvis_offset(c, OPENCV_FROM_OPENGL),
    )
    yield Correction(
        cause="opengl_axes",
        description="the root's rotation has OpenGL's axes, its translation OpenCV's",
        apply=lambda c: _rotate_about_pelvis(c, OPENCV_FROM_OPENGL),
    )
    for which, signs in AXIS_FLIPS.items():
        flip = np.diag(np.array(signs, dtype=np.float64))
        yield Correction(
            cause="opengl_axes",
            description=f"in the root's translation {which} the wrong sign",
            apply=lambda c, flip=flip: _transform_translations(c, flip),
        )


def _rotation_corrections() -> Iterator[Correction]:
    """Quarter turns: pictures that were turned for the tracker, and worlds with another axis up."""
    for degrees in (90, 180, 270):
        turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        yield Correction(
            cause="root_rotation",
            description=f"the tracker saw the pictures turned by {360 - degrees}°",
            apply=lambda c, turn=turn: replace(
                c, extrinsics=_rotation_transform(turn) @ c.extrinsics
            ),
        )
    for axis, degrees in [(a, d) for a in "xyz" for d in (90, 180, 270) if (a, d) != ("x", 180)]:
        turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
        yield Correction(
            cause="root_rotation",
            description=f"the root is turned by {360 - degrees}° about the camera's {axis}",
            apply=lambda c, turn=turn: _rotate_about_pelvis(c, turn),
        )
    for axis, degrees in (("x", 90), ("x", 180), ("x", 270), ("y", 90), ("y", 180), ("y", 270)):
        turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
        yield Correction(
            cause="root_rotation",
            description=f"the body at rest is turned by {360 - degrees}° about its {axis}",
            apply=lambda c, turn=turn: _with_root_rotations(c, _root_matrices(c.motion) @ turn),
        )
    for degrees in (90, 270):
        turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
        yield Correction(
            cause="root_rotation",
            description="the poses' world has z up where the camera's has y, or the other way round",
            apply=lambda c, turn=turn: replace(
                c, extrinsics=c.extrinsics @ _rotation_transform(turn)
            ),
        )
        yield Correction(
            cause="root_rotation",
            description="the poses' world has z up where the camera's has y, or the other way round "
            "(rotations and translations were converted without the pelvis's offset)",
            apply=lambda c, turn=turn: _rotate_without_pelvis_offset(c, turn),
        )


def _frame_rate_corrections(claim: CaptureGeometry, frames: int) -> Iterator[Correction]:
    """Poses of a copy of the video with another number of frames a second, or played backwards."""
    known = claim.row_frames[np.isfinite(claim.row_frames)]
    if len(known) > 1:
        ends = known.min() + known.max()
        yield Correction(
            cause="frame_rate",
            description="the film runs backwards against its poses",
            apply=lambda c: replace(c, row_frames=ends - c.row_frames),
        )
    factors = {a / b for a in FRAME_RATES for b in FRAME_RATES if a != b}
    rows = len(claim.row_frames)
    if rows != frames:
        factors.add(frames / rows)
    for factor in sorted(factors):
        yield Correction(
            cause="frame_rate",
            description=f"the poses were made at {1.0 / factor:.3g} times the video's frame rate",
            apply=lambda c, factor=factor: replace(c, row_frames=c.row_frames * factor),
        )


def _left_right_corrections() -> Iterator[Correction]:
    """Left taken for right: in the joints' order, in the body, or in the picture."""
    yield Correction(
        cause="left_right",
        description="the joints of the left and the right side are exchanged",
        apply=lambda c: replace(
            c,
            motion=replace(c.motion, joint_rotations=c.motion.joint_rotations[:, MIRRORED_JOINTS]),
        ),
    )
    yield Correction(
        cause="left_right",
        description="the limbs are mirrored",
        apply=lambda c: replace(c, motion=_mirror_limbs(c.motion)),
    )
    yield Correction(
        cause="left_right",
        description="the tracker saw the pictures mirrored",
        apply=lambda c: _mirror_picture(c),
    )


def _root_origin_corrections(pelvis: Float[np.ndarray, "3"]) -> Iterator[Correction]:
    """EasyMocap turns bodies about the origin, SMPL about the pelvis: R x + t, and back."""

    def undo(claim: CaptureGeometry, sign: float) -> CaptureGeometry:
        moved = sign * (_root_matrices(claim.motion) @ pelvis - pelvis)
        there = claim.motion.root_translations + moved
        return replace(claim, motion=replace(claim.motion, root_translations=there))

    yield Correction(
        cause="root_origin",
        description="the root turns about the origin (EasyMocap, ZJU), not about the pelvis",
        apply=lambda c: undo(c, 1.0),
    )
    yield Correction(
        cause="root_origin",
        description="the root's translation was already converted from the origin to the pelvis",
        apply=lambda c: undo(c, -1.0),
    )


def _rotation_transform(rotation: Rotation3) -> Float[np.ndarray, "4 4"]:
    transform = np.eye(4)
    transform[:3, :3] = rotation
    return transform


def _root_matrices(motion: Motion) -> Float[np.ndarray, "poses 3 3"]:
    return rotation_matrices(np.nan_to_num(motion.root_rotations))


def _with_root_rotations(
    claim: CaptureGeometry, roots: Float[np.ndarray, "poses 3 3"]
) -> CaptureGeometry:
    vectors = Rotation.from_matrix(roots).as_rotvec()
    return replace(claim, motion=replace(claim.motion, root_rotations=vectors))


def _camera_rotations(claim: CaptureGeometry) -> Float[np.ndarray, "poses 3 3"]:
    """Rotation from the world into the camera of each row."""
    return claim.extrinsics[claim.camera_rows(), :3, :3]


def _rotate_about_pelvis(claim: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    """The root turned in the camera's axes, about the pelvis, which stays."""
    cameras = _camera_rotations(claim)
    return _with_root_rotations(
        claim, np.swapaxes(cameras, 1, 2) @ turn @ cameras @ _root_matrices(claim.motion)
    )


def _rotate_without_pelvis_offset(claim: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    """Root rotations and translations in another world, as converters write them that forget J0.

    A pose's pelvis is at J0 + translation, so a correct conversion rotates that sum.
    """
    motion = claim.motion
    moved = replace(motion, root_translations=motion.root_translations @ turn.T)
    return _with_root_rotations(replace(claim, motion=moved), turn @ _root_matrices(motion))


def _transform_translations(claim: CaptureGeometry, change: Rotation3) -> CaptureGeometry:
    """The root's place changed in the camera's axes; its rotation stays."""
    rows = claim.camera_rows()
    turned, moved = claim.extrinsics[rows, :3, :3], claim.extrinsics[rows, :3, 3]
    translations = claim.motion.root_translations
    seen = np.einsum("cab,cb->ca", turned, translations) + moved
    back = np.einsum("cba,cb->ca", turned, seen @ change.T - moved)
    return replace(claim, motion=replace(claim.motion, root_translations=back))


def _mirror_limbs(motion: Motion) -> Motion:
    """Each limb moves as the other side's did in a mirror."""
    limbs = motion.joint_rotations[:, MIRRORED_JOINTS] * np.array([1.0, -1.0, -1.0])
    return replace(motion, joint_rotations=limbs)


def _mirror_picture(claim: CaptureGeometry) -> CaptureGeometry:
    """The person as a mirror shows them, left and right exchanged in the camera's axes."""
    mirrored = _transform_translations(claim, MIRROR_X)
    cameras = _camera_rotations(claim)
    back = np.swapaxes(cameras, 1, 2)
    roots = back @ MIRROR_X @ cameras @ _root_matrices(claim.motion) @ MIRROR_X
    return _with_root_rotations(replace(mirrored, motion=_mirror_limbs(mirrored.motion)), roots)
