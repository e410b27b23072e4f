"""First guess of poses from key points, frame by frame and without a search.

The root follows from the trunk's four key points, limbs from the directions between theirs. How far
an upper arm or a thigh twists about itself follows from where the elbow or the knee bends to. The
distance is the one at which the body covers its key points in the image.

Stretches in which a tracker took the person's left for the right are repaired first: only frames
close in time are compared, and of two parts that contradict each other the shorter is changed.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from capture.camera import Camera, Matrix3, Vector3
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import axis_angles_from_matrices, shortest_turn, unit_vectors
from preprocess.body.parametric_body import ShapedBody
from preprocess.poses.motion_builder import fill_gaps, place_by_pixels
from preprocess.tracking.keypoints import HIPS, MIN_PRESENCE, MIRRORED_POINTS, KeypointTrack

LEFT_POINTS = [11, 13, 23, 25, 27]
"""Left shoulder, elbow, hip, knee and ankle."""
RIGHT_POINTS = [12, 14, 24, 26, 28]
"""Those on the right."""
LIMBS = (
    (16, 18, 20, 11, 13, 15, (0.0, -1.0, 0.0)), (17, 19, 21, 12, 14, 16, (0.0, 1.0, 0.0)),
    (1, 4, 7, 23, 25, 27, (1.0, 0.0, 0.0)), (2, 5, 8, 24, 26, 28, (1.0, 0.0, 0.0)),
)  # fmt: skip
"""Of arms and legs: three joints, the three key points next to them, and the axis that the middle
joint bends about at rest."""
PLACED_JOINTS = (1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21)
"""Joints that are placed at their key points in the image."""
PLACED_POINTS = (23, 24, 25, 26, 27, 28, 11, 12, 13, 14, 15, 16)
"""Their key points."""


def repair_swaps(track: KeypointTrack) -> KeypointTrack:
    """Exchange left and right where a tracker took one for the other."""
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
    """Rows in which left and right are exchanged: the sequence of least cost (Viterbi 1967).

    A person does not turn half round between two frames and stay in the same place. Between two
    rows, a turn costs (1 - cosine) / 2 of the directions from right to left before and after it,
    and so does the rest of an exchange; both count nothing over a gap and little over a cut.
    """
    if len(track) < 2:
        return np.zeros(len(track), dtype=bool)
    across = track.world_m[:, LEFT_POINTS] - track.world_m[:, RIGHT_POINTS]
    across = across.reshape(len(track), -1)
    sizes = np.linalg.norm(across, axis=1)
    # between two guesses, key points of both sides lie in the middle and tell them not apart
    kept = np.flatnonzero(sizes >= 0.5 * np.median(sizes))
    across /= np.maximum(sizes, 1e-9)[:, None]
    cosines = (across[kept[1:]] * across[kept[:-1]]).sum(axis=1)
    link = _continuity(track, kept)
    turn, exchange = link * (1.0 - cosines) / 2.0, link * ((1.0 + cosines) / 2.0 + 0.4)
    row_cost = np.array([0.0, 1.2 / len(kept)])  # of the whole film: the shorter part is wrong
    costs, crossed = row_cost, np.zeros((len(kept), 2), dtype=bool)
    for row, (stay, cross) in enumerate(zip(turn, exchange, strict=True), start=1):
        crossed[row] = costs[::-1] + cross < costs + stay
        costs = np.minimum(costs + stay, costs[::-1] + cross) + row_cost
    is_swapped = np.zeros(len(kept), dtype=bool)
    is_swapped[-1] = costs[1] < costs[0]
    for row in range(len(kept) - 1, 0, -1):
        is_swapped[row - 1] = is_swapped[row] ^ crossed[row, int(is_swapped[row])]
    before = np.maximum(np.searchsorted(kept, np.arange(len(track)), side="right") - 1, 0)
    is_against = (across * across[kept[before]]).sum(axis=1) < 0.0
    return is_swapped[before] ^ is_against


def _continuity(track: KeypointTrack, rows: Int[np.ndarray, "rows"]) -> Float[np.ndarray, "rows-1"]:
    """Degree to which the person moves as usual from row to row, in [0, 1]; 0 over a gap.

    Both sides' middles are compared, which an exchange leaves where they are.
    """
    middles = 0.5 * (track.image_px[rows][:, LEFT_POINTS] + track.image_px[rows][:, RIGHT_POINTS])
    size = np.linalg.norm(middles - middles.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    moved = np.linalg.norm(np.diff(middles, axis=0), axis=2).mean(axis=1)
    moved /= np.maximum(size[:-1], 1e-9) * np.diff(rows)
    beside = [-3, -2, -1, 1, 2, 3]
    places = np.arange(len(moved))[:, None] + beside
    usual = np.median(moved[np.abs(places) % max(len(moved), 1)], axis=1)
    gaps = np.concatenate([[0], np.cumsum(np.diff(track.frames) > 3)])  # not compared over these
    # three times the usual motion may be a cut; one at rest moves by 0.01 body sizes
    link = np.exp(-((moved / (3.0 * np.maximum(usual, 0.01))) ** 2))
    return link * (np.diff(gaps[rows]) == 0)


def lift_keypoints(track: KeypointTrack, shaped: ShapedBody, camera: Camera) -> Motion:
    """First guess of the poses of the body's mean shape; short gaps are bridged.

    The camera is that of all frames, of their size, at the world's origin. The motion has a row for
    each frame with a person or in a short gap, and holds the key points and the camera's K.
    """
    track, poses = repair_swaps(track), list[BodyPose]()
    for image_px, world_m in zip(track.image_px, track.world_m, strict=True):
        pose = lift_pose(world_m, shaped)
        joints = shaped.with_pose(pose).joints()[list(PLACED_JOINTS)]
        place = place_by_pixels(joints, image_px[list(PLACED_POINTS)], camera)
        poses.append(replace(pose, root_translation=place))
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


def lift_pose(world_m: Float[np.ndarray, "33 3"], shaped: ShapedBody) -> BodyPose:
    """First guess of a pose by the shoulders, hips and limbs among the key points, unplaced."""
    rest, local = shaped.joints, np.tile(np.eye(3), (24, 1, 1))
    shoulders_and_hips = rest[[16, 17, 1, 2]], world_m[[11, 12, *HIPS]]
    local[0] = _trunk_turn(*shoulders_and_hips)
    for upper, middle, lower, *points, hinge in LIMBS:
        first, second = np.diff(world_m[points], axis=0)
        turned = _limb_turn(rest[middle] - rest[upper], np.array(hinge), local[0], first, second)
        # the trunk's other joints and the collars rest: a limb's parent turns as the root does
        local[upper] = local[0].T @ turned
        bent = turned.T @ second
        local[middle] = shortest_turn(rest[lower] - rest[middle], bent)
    vectors = axis_angles_from_matrices(local)
    return BodyPose(
        root_rotation=vectors[0], root_translation=np.zeros(3), joint_rotations=vectors[1:]
    )


def _trunk_turn(rest: Float[np.ndarray, "4 3"], found: Float[np.ndarray, "4 3"]) -> Matrix3:
    """The rotation that takes one trunk nearest to another (Kabsch 1976)."""
    a, b = rest - rest.mean(axis=0), found - found.mean(axis=0)
    u, _, v = np.linalg.svd(b.T @ a)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v


def _limb_turn(
    rest: Vector3, hinge: Vector3, parent: Matrix3, first: Vector3, second: Vector3
) -> Matrix3:
    """World rotation of a limb's first bone, so that its hinge bends it where it is bent to.

    `rest` and `hinge` are the bone and the axis of the hinge at its end, at rest; `parent` is the
    world rotation of what it hangs on; `first` and `second` are the limb's bones as they were
    found.
    """
    along, further = unit_vectors(first), unit_vectors(second)
    unbent = parent @ shortest_turn(rest, parent.T @ first)
    # at a bend of sine 0.35, key points and rest pose tell the twist alike
    axis = np.cross(along, further) + 0.35 * (unbent @ hinge)
    axis = unit_vectors(axis - (axis @ along) * along)
    start = unit_vectors(rest)
    side = unit_vectors(hinge - (hinge @ start) * start)
    there = np.column_stack([along, axis, np.cross(along, axis)])
    here = np.column_stack([start, side, np.cross(start, side)])
    return there @ here.T
