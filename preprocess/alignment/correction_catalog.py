"""The usual mistakes in a capture, each as the change that would undo it.

Each function lists corrections of one kind by their descriptions; a change maps a capture's
geometry to what it should have been.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.corrections import (  # fmt: skip
    Correction,
    GeometryChange,
    undo_pose_delay,
    undo_video_offset,
    undo_video_reversal,
    undo_video_rotation,
)
from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import JOINT_NAMES, rigid_transform, rotation_matrices
from preprocess.cameras.named_camera import OPENCV_FROM_OPENGL

FRAME_OFFSETS = (*range(1, 13), 15, 18, 21, 25, 30, 35, 40, 50, 60)
"""Frames by which poses may be late or early, on the coarse grid."""
MAX_UNMATCHED_OFFSETS = 24
"""Largest number of offsets to try where there are fewer poses than frames."""
FRAME_RATES = (24.0, 25.0, 30.0, 50.0, 60.0)
"""Frame rates, Hz, that are mistaken for one another."""
TRANSLATION_UNITS = {0.001: "millimetres", 0.01: "centimetres"}
"""Metres in each unit that translations may wrongly be given in."""
AXIS_FLIPS = {
    "y has": (1.0, -1.0, 1.0),
    "z has": (1.0, 1.0, -1.0),
    "y and z have": (1.0, -1.0, -1.0),
}
"""Signs of the root translation's coordinates, by what is wrong with them."""
MIRROR_X = np.diag([-1.0, 1.0, 1.0])
"""Reflection that exchanges left and right."""
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
    """Every discrete mistake between body and masks; focal lengths and sizes are fitted instead.

    Args:
        geometry: The capture as its files state it.
        pelvis: Rest position of the pelvis, J0, about which the root rotates.
        frames: Number of frames.
    """
    yield Correction(
        cause="mask_polarity",
        description="the masks are 1 where the person is not",
        apply=lambda c: replace(c, masks_inverted=not c.masks_inverted),
    )
    yield Correction(
        cause="second_person",
        description="the masks show another person, too, apart from the one whose poses are given",
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
    consecutive = np.ptp(geometry.row_frames) + 1 == rows
    if rows < frames and consecutive:  # these may be the last frames' poses, or some in between
        yield from (undo_pose_delay(-k) for k in _spaced_offsets(frames - rows))
    yield from _frame_rate_corrections(geometry, frames)
    yield from _left_right_corrections()
    yield from _root_origin_corrections(pelvis)
    yield from _unit_corrections()


def video_corrections(frames: int, mask_count: int, max_offset: int) -> Iterator[Correction]:
    """Every discrete mistake of a video whose masks and poses agree; crops are fitted instead.

    Args:
        frames: Number of frames in the video.
        mask_count: Number of masks.
        max_offset: Largest number of frames by which the video may be late or early.
    """
    yield from (undo_video_rotation(turns) for turns in (1, 2, 3))
    yield from (undo_video_rotation(turns, mirrored=True) for turns in range(4))
    yield from (
        undo_video_offset(k) for near in FRAME_OFFSETS if near <= max_offset for k in (near, -near)
    )
    yield from (undo_video_offset(k) for k in _spaced_offsets(mask_count - frames))
    yield undo_video_reversal(frames)


def _corrections(cause: str, changes: dict[str, GeometryChange]) -> Iterator[Correction]:
    """Corrections of one cause, from their descriptions and changes."""
    for description, apply in changes.items():
        yield Correction(cause=cause, description=description, apply=apply)


def _spaced_offsets(largest: int) -> list[int]:
    """At most `MAX_UNMATCHED_OFFSETS` offsets, evenly spaced from 1 to the largest."""
    if largest <= 0:
        return []
    count = min(largest, MAX_UNMATCHED_OFFSETS)
    return sorted({round(offset) for offset in np.linspace(1, largest, count)})


def _unit_corrections() -> Iterator[Correction]:
    """Translations that are not in metres."""

    def scaled(motion: Motion, factor: float) -> Motion:
        return replace(motion, root_translations=motion.root_translations * factor)

    yield from _corrections(
        "body_scale",
        {
            f"the poses' translations are in {unit}, not in metres": _moves(
                partial(scaled, factor=factor)
            )
            for factor, unit in TRANSLATION_UNITS.items()
        },
    )


def _angle_corrections(geometry: CaptureGeometry) -> Iterator[Correction]:
    """Rotations in degrees, offered where one exceeds a full turn in radians."""
    motion = geometry.motion
    roots, joints = motion.root_rotations[motion.valid], motion.joint_rotations[motion.valid]
    of_root, of_joints = (_exceeds_full_turn(vectors) for vectors in (roots, joints))
    if of_root or of_joints:
        change = _moves(lambda m: _degrees_to_radians(m, of_root, of_joints))
        words = "the rotations are in degrees, not in radians"
        yield from _corrections("root_rotation", {words: change})


def _exceeds_full_turn(vectors: Float[np.ndarray, "*rows 3"]) -> bool:
    """Whether an axis-angle vector turns by more than 2π."""
    return bool((np.linalg.norm(vectors, axis=-1) > 2.0 * np.pi).any())


def _degrees_to_radians(motion: Motion, convert_root: bool, convert_joints: bool) -> Motion:
    """The motion with the root's angles, the joints', or both converted from degrees."""
    roots, joints = motion.root_rotations, motion.joint_rotations
    return replace(
        motion,
        root_rotations=np.deg2rad(roots) if convert_root else roots,
        joint_rotations=np.deg2rad(joints) if convert_joints else joints,
    )


def _world_frame_corrections(geometry: CaptureGeometry) -> Iterator[Correction]:
    """Poses and cameras in different worlds; none if all cameras are at the origin."""
    if _cameras_at_origin(geometry):
        return
    in_camera = _moves_cameras(lambda e: np.broadcast_to(np.eye(4), e.shape))
    inverted = _moves_cameras(np.linalg.inv)
    inverted_opengl = _moves_cameras(lambda e: OPENCV_FROM_OPENGL @ np.linalg.inv(e))
    yield from _corrections(
        "world_frame",
        {
            "the poses are in the camera's own frame, and its position is applied twice": in_camera,
            "the camera matrices are world-from-camera, not camera-from-world": inverted,
        },
    )
    words = "the camera matrices are world-from-camera with OpenGL's axes (y up, z back)"
    yield from _corrections("opengl_axes", {words: inverted_opengl})


def _axis_corrections(geometry: CaptureGeometry) -> Iterator[Correction]:
    """OpenGL's axes in place of OpenCV's, in all numbers or in some."""
    flip = OPENCV_FROM_OPENGL[:3, :3]
    changes: dict[str, GeometryChange] = {
        "camera space has OpenGL's axes (y up, z back), not OpenCV's (y down, z forward)": partial(
            _rotate_camera_space, turn=flip
        )
    }
    if not _cameras_at_origin(geometry):
        world = partial(_rotate_world_space, turn=flip)
        changes["the poses' world has y and z the other way round"] = world
    changes["the roots' rotations and translations have y and z the other way round"] = partial(
        _rotate_without_pelvis_offset, turn=flip
    )
    changes["the root's rotation has OpenGL's axes, its translation OpenCV's"] = partial(
        _rotate_about_pelvis, turn=flip
    )
    for which, signs in AXIS_FLIPS.items():
        flipped = partial(_transform_translations, change=np.diag(np.array(signs)))
        changes[f"in the root's translation {which} the wrong sign"] = flipped
    yield from _corrections("opengl_axes", changes)


def _rotation_corrections() -> Iterator[Correction]:
    """Quarter turns: images rotated for the tracker, and worlds with another axis up."""
    quarters = (90, 180, 270)
    changes: dict[str, GeometryChange] = {}
    for degrees in quarters:
        words = f"the tracker saw the images rotated by {360 - degrees}°"
        changes[words] = partial(_rotate_camera_space, turn=_rotation("z", degrees))
    for axis, degrees in [(a, d) for a in "xyz" for d in quarters if (a, d) != ("x", 180)]:
        words = f"the root is rotated by {360 - degrees}° about the camera's {axis}"
        changes[words] = partial(_rotate_about_pelvis, turn=_rotation(axis, degrees))
    for axis, degrees in [(a, d) for a in "xy" for d in quarters]:
        words = f"the body at rest is rotated by {360 - degrees}° about its {axis}"
        changes[words] = partial(_rotate_rest_body, turn=_rotation(axis, degrees))
    yield from _corrections("root_rotation", changes)
    words = "the poses' world has z up where the camera's has y, or the other way round"
    converted = f"{words} (rotations and translations were converted without the pelvis's offset)"
    for degrees in (90, 270):
        turn = _rotation("x", degrees)
        world = partial(_rotate_world_space, turn=turn)
        roots = partial(_rotate_without_pelvis_offset, turn=turn)
        yield from _corrections("root_rotation", {words: world, converted: roots})


def _frame_rate_corrections(geometry: CaptureGeometry, frames: int) -> Iterator[Correction]:
    """Poses of a copy of the video with another frame rate, or played backwards."""

    def mapped(geometry: CaptureGeometry, factor: float, offset: float) -> CaptureGeometry:
        return replace(geometry, row_frames=offset + factor * geometry.row_frames)

    known = geometry.row_frames[np.isfinite(geometry.row_frames)]
    if len(known) > 1:
        reverse = partial(mapped, factor=-1.0, offset=known.min() + known.max())
        words = "the video runs backwards against its poses"
        yield from _corrections("frame_rate", {words: reverse})
    factors = {a / b for a in FRAME_RATES for b in FRAME_RATES if a != b}
    rows = len(geometry.row_frames)
    if rows != frames:
        factors.add(frames / rows)
    for factor in sorted(factors):
        words = f"the poses were made at {1.0 / factor:.3g} times the video's frame rate"
        change = partial(mapped, factor=factor, offset=0.0)
        yield from _corrections("frame_rate", {words: change})


def _left_right_corrections() -> Iterator[Correction]:
    """Left and right exchanged: in the joints' order, in the limbs, or in the image."""

    def swapped(motion: Motion) -> Motion:
        return replace(motion, joint_rotations=motion.joint_rotations[:, MIRRORED_JOINTS])

    yield from _corrections(
        "left_right",
        {
            "the joints of the left and the right side are exchanged": _moves(swapped),
            "the limbs are mirrored": _moves(_mirror_limbs),
            "the tracker saw the images mirrored": _mirror_image,
        },
    )


def _root_origin_corrections(pelvis: Float[np.ndarray, "3"]) -> Iterator[Correction]:
    """EasyMocap rotates bodies about the origin, SMPL about the pelvis: R x + t, and back."""

    def moved(motion: Motion, sign: float) -> Motion:
        offset = sign * (_root_matrices(motion) @ pelvis - pelvis)
        return replace(motion, root_translations=motion.root_translations + offset)

    about_origin = "the root turns about the origin (EasyMocap, ZJU), not about the pelvis"
    converted = "the root's translation was already converted from the origin to the pelvis"
    yield from _corrections(
        "root_origin",
        {
            about_origin: _moves(partial(moved, sign=1.0)),
            converted: _moves(partial(moved, sign=-1.0)),
        },
    )


def _moves(change: Callable[[Motion], Motion]) -> GeometryChange:
    """Lifts a change of the motion to one of the geometry."""
    return lambda c: replace(c, motion=change(c.motion))


def _moves_cameras(
    change: Callable[[Float[np.ndarray, "cameras 4 4"]], Float[np.ndarray, "cameras 4 4"]],
) -> GeometryChange:
    """Lifts a change of the extrinsics to one of the geometry."""
    return lambda c: replace(c, extrinsics=change(c.extrinsics))


def _cameras_at_origin(geometry: CaptureGeometry) -> bool:
    """Whether world and camera space are the same."""
    return np.allclose(geometry.extrinsics, np.eye(4), atol=1e-6)


def _rotation(axis: str, degrees: int) -> Rotation3:
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def _rotate_camera_space(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    return replace(geometry, extrinsics=rigid_transform(turn, np.zeros(3)) @ geometry.extrinsics)


def _rotate_world_space(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    return replace(geometry, extrinsics=geometry.extrinsics @ rigid_transform(turn, np.zeros(3)))


def _rotate_rest_body(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    return _with_root_rotations(geometry, _root_matrices(geometry.motion) @ turn)


def _root_matrices(motion: Motion) -> Float[np.ndarray, "poses 3 3"]:
    return rotation_matrices(np.nan_to_num(motion.root_rotations))


def _with_root_rotations(
    geometry: CaptureGeometry, roots: Float[np.ndarray, "poses 3 3"]
) -> CaptureGeometry:
    vectors = Rotation.from_matrix(roots).as_rotvec()
    return replace(geometry, motion=replace(geometry.motion, root_rotations=vectors))


def _camera_rotations(geometry: CaptureGeometry) -> Float[np.ndarray, "poses 3 3"]:
    """Rotation from the world into the camera of each row."""
    return geometry.extrinsics[geometry.camera_rows(), :3, :3]


def _rotate_about_pelvis(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    """The root rotated in the camera's axes about the pelvis, which stays."""
    cameras = _camera_rotations(geometry)
    return _with_root_rotations(
        geometry, np.swapaxes(cameras, 1, 2) @ turn @ cameras @ _root_matrices(geometry.motion)
    )


def _rotate_without_pelvis_offset(geometry: CaptureGeometry, turn: Rotation3) -> CaptureGeometry:
    """Root rotations and translations in another world, as converters write them that forget J0.

    A pose's pelvis is at J0 + translation, so a correct conversion rotates that sum.
    """
    motion = geometry.motion
    moved = replace(motion, root_translations=motion.root_translations @ turn.T)
    return _with_root_rotations(replace(geometry, motion=moved), turn @ _root_matrices(motion))


def _transform_translations(geometry: CaptureGeometry, change: Rotation3) -> CaptureGeometry:
    """The root translations changed in the camera's axes; the rotations stay."""
    rows = geometry.camera_rows()
    rotation, offset = geometry.extrinsics[rows, :3, :3], geometry.extrinsics[rows, :3, 3]
    in_camera = np.einsum("cab,cb->ca", rotation, geometry.motion.root_translations) + offset
    in_world = np.einsum("cba,cb->ca", rotation, in_camera @ change.T - offset)
    return replace(geometry, motion=replace(geometry.motion, root_translations=in_world))


def _mirror_limbs(motion: Motion) -> Motion:
    """Each limb takes the mirrored rotations of the other side."""
    limbs = motion.joint_rotations[:, MIRRORED_JOINTS] * np.array([1.0, -1.0, -1.0])
    return replace(motion, joint_rotations=limbs)


def _mirror_image(geometry: CaptureGeometry) -> CaptureGeometry:
    """The person as a mirror shows them, left and right exchanged in the camera's axes."""
    mirrored = _transform_translations(geometry, MIRROR_X)
    cameras = _camera_rotations(geometry)
    back = np.swapaxes(cameras, 1, 2)
    roots = back @ MIRROR_X @ cameras @ _root_matrices(geometry.motion) @ MIRROR_X
    return _with_root_rotations(replace(mirrored, motion=_mirror_limbs(mirrored.motion)), roots)
