"""First guess of poses from key points, frame by frame and without a search.

The root follows from the trunk's four key points, limbs from the directions between theirs. How far
an upper arm or a thigh twists about itself follows from where the elbow or the knee bends to. The
distance is the one at which the body covers its key points in the image.

Short stretches in which a tracker took the person's left for the right are repaired first: only
frames close in time are compared, and only a stretch that its longer neighbors contradict is
changed.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from capture.camera import Camera
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import axis_angles_from_matrices, rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.poses.motion_builder import fill_gaps, place_by_pixels
from preprocess.tracking.keypoints import HIPS, MIN_PRESENCE, MIRRORED_POINTS, KeypointTrack

COMPARED_POINTS = (11, 13, 23, 25, 27)
"""Left shoulder, elbow, hip, knee and ankle."""
MAX_COSINE = -0.4
"""Cosine between the directions from right to left of two frames below which one is swapped."""
MAX_STRETCH_FRAMES = 15
"""Longest stretch that is repaired, frames."""
MAX_GAP_FRAMES = 3
"""Frames between two rows beyond which they are not compared."""
TRUNK_POINTS = (11, 12, *HIPS)
"""Shoulders and hips."""
TRUNK_JOINTS = (16, 17, 1, 2)
"""The joints next to them."""
LIMBS = (
    (16, 18, 20, 11, 13, 15, (0.0, -1.0, 0.0)), (17, 19, 21, 12, 14, 16, (0.0, 1.0, 0.0)),
    (1, 4, 7, 23, 25, 27, (1.0, 0.0, 0.0)), (2, 5, 8, 24, 26, 28, (1.0, 0.0, 0.0)),
)  # fmt: skip
"""Of arms and legs: three joints, the three key points next to them, and the axis that the middle
joint bends about at rest."""
STRAIGHT = 0.35
"""Sine of a limb's bend at which its key points and its rest pose tell its twist alike."""
PLACED_JOINTS = (1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21)
"""Joints that are placed at their key points in the image."""
PLACED_POINTS = (23, 24, 25, 26, 27, 28, 11, 12, 13, 14, 15, 16)
"""Their key points."""


def repair_swaps(track: KeypointTrack) -> KeypointTrack:
    """Exchange left and right in short stretches that both sides contradict."""
    swapped = find_swaps(track)
    order = np.where(swapped[:, None], MIRRORED_POINTS, np.arange(33))
    rows = np.arange(len(track))[:, None]
    return replace(
        track,
        image_px=track.image_px[rows, order],
        world_m=track.world_m[rows, order],
        visibility=track.visibility[rows, order],
    )


def find_swaps(track: KeypointTrack) -> Bool[np.ndarray, "rows"]:
    """Rows in which left and right are exchanged, by their neighbors.

    A stretch ends where left and right change at once, or at a gap, as where a video was cut.
    """
    across = track.world_m[:, list(COMPARED_POINTS)]
    across = across - track.world_m[:, [point + 1 for point in COMPARED_POINTS]]
    turns = np.flatnonzero(_cosines(across.reshape(len(track), -1)) < MAX_COSINE) + 1
    gaps = np.flatnonzero(np.diff(track.frames) > MAX_GAP_FRAMES) + 1
    swapped = np.zeros(len(track), dtype=bool)
    for first, end in pairwise([0, *gaps.tolist(), len(track)]):
        bounds = [first, *turns[(turns > first) & (turns < end)].tolist(), end]
        lengths = np.diff(bounds).tolist()
        for index, (start, stop) in enumerate(pairwise(bounds)):
            beside = lengths[max(0, index - 1) : index] + lengths[index + 1 : index + 2]
            is_short = beside and lengths[index] <= min(MAX_STRETCH_FRAMES, *beside)
            if is_short and not (index and swapped[start - 1]):
                swapped[start:stop] = True
    return swapped


def _cosines(rows: Float[np.ndarray, "rows n"]) -> Float[np.ndarray, "gaps"]:
    """Cosine between each row and the next."""
    size = np.maximum(np.linalg.norm(rows, axis=1), 1e-9)
    return (rows[1:] * rows[:-1]).sum(axis=1) / (size[1:] * size[:-1])


def lift_keypoints(track: KeypointTrack, shaped: ShapedBody, camera: Camera) -> Motion:
    """First guess of the poses of the body's mean shape; short gaps are bridged.

    The camera is that of all frames, of their size, at the world's origin. The motion has a row for
    each frame with a person or in a short gap, and holds the key points and the camera's K.
    """
    track = repair_swaps(track)
    poses = [
        _lift(track.image_px[row], track.world_m[row], shaped, camera) for row in range(len(track))
    ]
    motion = Motion(
        root_rotations=np.array([pose.root_rotation for pose in poses]).reshape(-1, 3),
        root_translations=np.array([pose.root_translation for pose in poses]).reshape(-1, 3),
        joint_rotations=np.array([pose.joint_rotations for pose in poses]).reshape(-1, 23, 3),
        valid=track.presence >= MIN_PRESENCE,
        betas=np.zeros(shaped.body.shape_directions.shape[-1]),
        body_model=shaped.body.family,
        frames=track.frames,
        times_s=track.times_s,
        intrinsic=camera.intrinsic,
        keypoints=track,
    )
    return fill_gaps(motion)


def _lift(
    image_px: Float[np.ndarray, "33 2"],
    world_m: Float[np.ndarray, "33 3"],
    shaped: ShapedBody,
    camera: Camera,
) -> BodyPose:
    pose = lift_pose(world_m, shaped)
    joints = shaped.with_pose(pose).joints()[list(PLACED_JOINTS)]
    place = place_by_pixels(joints, image_px[list(PLACED_POINTS)], camera)
    return replace(pose, root_translation=place)


def lift_pose(world_m: Float[np.ndarray, "33 3"], shaped: ShapedBody) -> BodyPose:
    """First guess of a pose by the shoulders, hips and limbs among the key points, unplaced."""
    rest, local = shaped.joints, np.tile(np.eye(3), (24, 1, 1))
    local[0] = _trunk_turn(rest[list(TRUNK_JOINTS)], world_m[list(TRUNK_POINTS)])
    for upper, middle, lower, *points, hinge in LIMBS:
        first, second = np.diff(world_m[points], axis=0)
        turned = _limb_turn(rest[middle] - rest[upper], np.array(hinge), local[0], first, second)
        # the trunk's other joints and the collars rest: a limb's parent turns as the root does
        local[upper] = local[0].T @ turned
        bent = turned.T @ second
        local[middle] = _swing(rest[lower] - rest[middle], bent)
    vectors = axis_angles_from_matrices(local)
    return BodyPose(
        root_rotation=vectors[0], root_translation=np.zeros(3), joint_rotations=vectors[1:]
    )


def _trunk_turn(
    rest: Float[np.ndarray, "4 3"], found: Float[np.ndarray, "4 3"]
) -> Float[np.ndarray, "3 3"]:
    """The rotation that takes one trunk nearest to another (Kabsch 1976)."""
    a, b = rest - rest.mean(axis=0), found - found.mean(axis=0)
    u, _, v = np.linalg.svd(b.T @ a)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v


def _limb_turn(
    rest: Float[np.ndarray, "3"],
    hinge: Float[np.ndarray, "3"],
    parent: Float[np.ndarray, "3 3"],
    first: Float[np.ndarray, "3"],
    second: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3 3"]:
    """World rotation of a limb's first bone, so that its hinge bends it where it is bent to.

    `rest` and `hinge` are the bone and the axis of the hinge at its end, at rest; `parent` is the
    world rotation of what it hangs on; `first` and `second` are the limb's bones as they were
    found.
    """
    along, further = _unit(first), _unit(second)
    unbent = parent @ _swing(rest, parent.T @ first)
    axis = np.cross(along, further) + STRAIGHT * (unbent @ hinge)
    axis = _unit(axis - (axis @ along) * along)
    start, side = _unit(rest), _unit(hinge - (hinge @ _unit(rest)) * _unit(rest))
    there = np.column_stack([along, axis, np.cross(along, axis)])
    here = np.column_stack([start, side, np.cross(start, side)])
    return there @ here.T


def _swing(a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes direction a to direction b."""
    a, b = _unit(a), _unit(b)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-8:
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        return rotation_matrices(_unit(axis) * (0.0 if a @ b > 0.0 else np.pi))
    return rotation_matrices(axis / sine * np.arctan2(sine, a @ b))


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)
