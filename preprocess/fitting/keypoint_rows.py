"""Key point residuals: how far a posed person's key points lie from those found, and the Jacobian.

Each key point is fixed in the frame of one joint. Its place in the image is compared in pixels;
how much farther away one of two key points is, weakly, in metres: this tells what images leave
open. All frames of a clip are linearised at once.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Int

from capture.camera import Camera
from preprocess.body.kinematics import JointPlaces, descendant_matrix
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_poses import ClipPoses, PosedJoints
from preprocess.tracking.keypoints import HIPS, MIN_PRESENCE, MIRRORED_POINTS, KeypointTrack

KEYPOINT_JOINTS = np.array(
    [15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 16, 17, 18, 19, 20, 21, 20, 21, 20, 21, 20, 21,
     0, 0, 4, 5, 7, 8, 7, 8, 7, 8]
)  # fmt: skip
"""The joint in whose frame each of the 33 key points is fixed."""
LEFT_OFFSETS_CM = {
    1: (1.5, 5.0, 8.6), 2: (2.6, 5.0, 8.0), 3: (3.7, 5.1, 7.5), 7: (5.5, 3.7, 3.3),
    9: (1.9, -1.4, 9.3), 11: (-2.1, 0.6, -0.1), 13: (-2.3, -0.2, 0.9), 15: (0.8, -0.8, 0.1),
    17: (8.8, -0.6, -0.9), 19: (8.8, -1.8, 1.2), 21: (6.2, -2.7, 1.8), 23: (10.4, -3.5, 1.3),
    25: (-0.7, 0.5, -0.1), 27: (-0.1, 2.9, 1.2), 29: (-0.6, -3.7, -3.0), 31: (3.0, -3.5, 18.6),
}  # fmt: skip
"""Places of the person's left key points in their joints' rest frames, centimetres; the right ones
are mirrored. Measured on synthetic actors; a centimetre apart between them."""
PIXEL_WEIGHTS = np.array([0.4] + [0.15] * 6 + [0.4] * 2 + [0.15] * 2 + [1.0] * 6 + [0.3] * 6
                         + [1.0] * 6 + [0.6] * 4)  # fmt: skip
"""Precision of each key point in the image, 1 / px² of the reduced masks (of 1.4 cm); those of the
face and of a hand err alike."""
DEPTH_PAIRS = (
    (11, 12, 0.12), (23, 24, 0.12), (11, 23, 0.15), (12, 24, 0.15), (11, 13, 0.15), (12, 14, 0.15),
    (13, 15, 0.36), (14, 16, 0.36), (23, 25, 0.15), (24, 26, 0.15), (25, 27, 0.15), (26, 28, 0.15),
    (29, 31, 0.15), (30, 32, 0.15), (7, 8, 0.04), (7, 0, 0.04), (8, 0, 0.04),
)  # fmt: skip
"""Key points whose difference in depth is compared, and its standard deviation, metres."""
NEARER_M = ((11, 12, 0.06), (13, 14, 0.10), *((hand, hand + 1, 0.135) for hand in (15, 17, 19, 21)))
"""Left and right key points that BlazePose finds too near to the camera, relative to the hips, and
by how much, metres: shoulders, elbows, wrists, hands. Means of five videos, all of one sign."""
RATIO_BONES = ((11, 13, 16, 18), (12, 14, 17, 19), (13, 15, 18, 20), (14, 16, 19, 21),
               (23, 25, 1, 4), (24, 26, 2, 5), (25, 27, 4, 7), (26, 28, 5, 8))  # fmt: skip
"""Two key points and the joints next to them, whose distances tell the points' scale."""


def _offsets_m() -> Float[np.ndarray, "33 3"]:
    offsets = np.zeros((33, 3))
    offsets[0] = 0.0, 1.8, 10.9  # the nose
    for left, place in LEFT_OFFSETS_CM.items():
        offsets[left] = place
        offsets[MIRRORED_POINTS[left]] = np.array(place) * (-1.0, 1.0, 1.0)
    return offsets / 100.0


KEYPOINT_OFFSETS_M = _offsets_m()
"""Place of each key point from its joint in the rest pose of a body of 1.7 m, metres."""


class ClipCameras(NamedTuple):
    """The cameras of a clip's frames, camera from world, in pixels of the reduced masks."""

    rotations: Float[np.ndarray, "frames 3 3"]
    translations: Float[np.ndarray, "frames 3"]
    focal_px: Float[np.ndarray, "frames 2"]
    center_px: Float[np.ndarray, "frames 2"]

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> "ClipCameras":
        """One camera a frame."""
        return cls(
            rotations=np.stack([each.camera_from_world[:3, :3] for each in cameras]),
            translations=np.stack([each.camera_from_world[:3, 3] for each in cameras]),
            focal_px=np.array([each.focal_px for each in cameras]),
            center_px=np.array([each.center_px for each in cameras]),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class ClipKeypoints:
    """Key points of a clip's frames, in pixels of the reduced masks.

    Attributes:
        depths_m: Depth of each key point, from any origin, corrected by `NEARER_M`.
        confidence: Weight of each key point, in [0, 1]; 0 in frames without key points.
    """

    pixels: Float[np.ndarray, "frames 33 2"]
    depths_m: Float[np.ndarray, "frames 33"]
    confidence: Float[np.ndarray, "frames 33"]

    @classmethod
    def of(
        cls,
        track: KeypointTrack,
        numbers: Sequence[int],
        cameras: Sequence[Camera],
        rest_joints: JointPlaces,
    ) -> "ClipKeypoints":
        """Select a track's key points in some frames, seen by cameras of the reduced masks' size.

        The person's rest joints tell the scale of depths.
        """
        row_of = {int(number): row for row, number in enumerate(track.frames)}
        rows = [row_of.get(int(number), -1) for number in numbers]
        known = np.array(rows) >= 0
        known &= track.presence[rows] >= MIN_PRESENCE
        scale = np.array([each.size_px for each in cameras]) / np.array(track.size_px)
        pixels = track.image_px[rows] * scale[:, None]
        center = np.array([each.center_px for each in cameras])
        focal = np.array([each.focal_px for each in cameras])
        view = np.concatenate(
            [(pixels[:, HIPS].mean(axis=1) - center) / focal, np.ones((len(rows), 1))], axis=1
        )
        view /= np.linalg.norm(view, axis=1, keepdims=True) * (-1.0, -1.0, 1.0)
        # the points' own z axis is the view of the person's middle
        depths = (track.world_m[rows] * view[:, None]).sum(axis=-1)
        return cls(
            pixels=pixels,
            depths_m=depths / _world_scale(track, rest_joints) + _NEARER_M,
            confidence=np.where(known[:, None], track.visibility[rows], 0.0),
        )


def _world_scale(track: KeypointTrack, rest_joints: JointPlaces) -> float:
    """Size of a track's points in space, relative to the person."""
    ratios = [
        np.linalg.norm(track.world_m[:, end] - track.world_m[:, start], axis=1)
        / np.linalg.norm(rest_joints[joint] - rest_joints[parent])
        for start, end, parent, joint in RATIO_BONES
    ]
    return max(float(np.median(ratios)), 0.1)


class KeypointRows(NamedTuple):
    """Residuals of all frames, px of the reduced masks or standard deviations, and derivatives.

    `weights` are robust precisions; the Jacobians are as in `OutlineRows`.
    """

    residuals: Float[np.ndarray, "frames rows"]
    weights: Float[np.ndarray, "frames rows"]
    pose_jacobian: Float[np.ndarray, "frames rows 75"]
    shape_jacobian: Float[np.ndarray, "frames rows coefficients"]
    focal_jacobian: Float[np.ndarray, "frames rows"]


class PlacedPoints(NamedTuple):
    """Places of points on the body in camera axes, metres, and their derivatives."""

    places: Float[np.ndarray, "frames points 3"]
    pose_jacobian: Float[np.ndarray, "frames points 3 75"]
    shape_jacobian: Float[np.ndarray, "frames points 3 coefficients"]


@final
class AttachedPoints:
    """Points that are fixed in the frames of a person's joints."""

    def __init__(
        self,
        space: ProportionSpace,
        joints: Int[np.ndarray, "points"],
        offsets_m: Float[np.ndarray, "points 3"],
    ) -> None:
        """Takes the joint of each point, and its place from there in the rest pose, metres."""
        self._space, self._joints, self._offsets = space, joints, offsets_m
        self._parents = space.shaped.body.parents
        self._below = descendant_matrix(self._parents)[:, joints].T.copy()

    def place(
        self,
        poses: ClipPoses,
        rest_joints: JointPlaces,
        rotations: Float[np.ndarray, "frames 3 3"],
        translations: Float[np.ndarray, "frames 3"],
    ) -> PlacedPoints:
        """Places in poses, for the rest joints of the present proportions and camera from world."""
        joints, rotation = poses.joints(rest_joints, self._parents), rotations[:, None]
        turns = rotation @ joints.turns
        places = _apply(rotation, joints.places) + translations[:, None]
        points = places[:, self._joints] + _apply(turns[:, self._joints], self._offsets)
        by_shape = rotation @ self._joints_by_shape(joints)
        return PlacedPoints(points, self._by_pose(points, turns, places), by_shape[:, self._joints])

    def _by_pose(
        self,
        points: Float[np.ndarray, "frames points 3"],
        turns: Float[np.ndarray, "frames 24 3 3"],
        places: Float[np.ndarray, "frames 24 3"],
    ) -> Float[np.ndarray, "frames points 3 75"]:
        """Derivatives of the points by joint rotations and the root's place, in camera axes."""
        lever = points[:, :, None] - places[:, None]
        lever *= self._below[..., None]
        x, y, z = (lever[..., axis, None] for axis in range(3))
        a, b, c = (turns[:, None, :, axis] for axis in range(3))
        moved = np.empty((*points.shape[:2], 3, 75))
        for axis, part in enumerate((b * z - c * y, c * x - a * z, a * y - b * x)):  # ω × lever
            moved[:, :, axis, :72] = part.reshape(*points.shape[:2], 72)
        moved[..., 72:] = np.eye(3)
        return moved

    def _joints_by_shape(
        self, joints: PosedJoints
    ) -> Float[np.ndarray, "frames 24 3 coefficients"]:
        """Derivatives of the joints' places by the proportions, in world axes."""
        moved = self._space.joint_directions
        placed = np.empty((len(joints.turns), *moved.shape))
        for joint, parent in enumerate(self._parents):
            if parent < 0:
                placed[:, joint] = moved[joint]
            else:
                bone = moved[joint] - moved[parent]
                placed[:, joint] = placed[:, parent] + joints.turns[:, parent] @ bone
        return placed


@final
class KeypointModel:
    """A person whose key points are compared with those of a clip."""

    def __init__(self, space: ProportionSpace) -> None:
        """Takes the shape at the space's origin."""
        size = float(np.ptp(space.shaped.vertices[:, 1])) / 1.7
        self.offsets_m = size * KEYPOINT_OFFSETS_M
        self._attached = AttachedPoints(space, KEYPOINT_JOINTS, self.offsets_m)

    def compare(
        self,
        poses: ClipPoses,
        rest_joints: JointPlaces,
        cameras: ClipCameras,
        found: ClipKeypoints,
        factors: Float[np.ndarray, "frames"],
    ) -> KeypointRows:
        """Residuals of poses, for the rest joints of the present proportions.

        `factors` multiply the precision of each frame's key points in the image.
        """
        points, by_pose, by_shape = self._attached.place(
            poses, rest_joints, cameras.rotations, cameras.translations
        )
        depth = points[..., 2:]
        plane = points[..., :2] / depth
        scale = cameras.focal_px[:, None] / depth
        pixels = cameras.focal_px[:, None] * plane + cameras.center_px[:, None]
        off = pixels - found.pixels
        # derivative of (f x/z, f y/z) by the point: rows (f/z, 0, -f x/z²) and (0, f/z, -f y/z²)
        view = np.zeros((*points.shape[:2], 2, 3))
        view[..., 0, 0], view[..., 1, 1] = scale[..., 0], scale[..., 1]
        view[..., 2] = -scale * plane
        # Geman-McClure: what is 6 px off, or 3 standard deviations, counts a quarter
        robust = 1.0 / (1.0 + (off**2).sum(axis=-1) / 6.0**2) ** 2
        weights = factors[:, None] * PIXEL_WEIGHTS * found.confidence * robust
        one, other = _PAIRS[:, 0], _PAIRS[:, 1]
        farther = (points[:, other, 2] - points[:, one, 2]) - (
            found.depths_m[:, other] - found.depths_m[:, one]
        )
        sure = np.minimum(found.confidence[:, one], found.confidence[:, other])
        frames = len(points)
        # by the logarithm of the focal length: pixels move from the center by their distance to it
        return KeypointRows(
            residuals=np.concatenate([off.reshape(frames, -1), farther / _PAIR_SIGMAS], axis=1),
            weights=np.concatenate(
                [
                    np.repeat(weights, 2, axis=1),
                    sure / (1.0 + (farther / (3.0 * _PAIR_SIGMAS)) ** 2) ** 2,
                ],
                axis=1,
            ),
            pose_jacobian=_stack_rows(view, by_pose),
            shape_jacobian=_stack_rows(view, by_shape),
            focal_jacobian=np.concatenate(
                [(pixels - cameras.center_px[:, None]).reshape(frames, -1), 0.0 * farther], axis=1
            ),
        )


_NEARER_M = np.zeros(33)
for _left, _right, _nearer in NEARER_M:
    _NEARER_M[[_left, _right]] = _nearer
_PAIRS = np.array([pair[:2] for pair in DEPTH_PAIRS])
_PAIR_SIGMAS = np.array([pair[2] for pair in DEPTH_PAIRS])


def _apply(
    rotations: Float[np.ndarray, "... 3 3"], vectors: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "... 3"]:
    return (rotations @ vectors[..., None])[..., 0]


def _stack_rows(
    view: Float[np.ndarray, "frames 33 2 3"], by: Float[np.ndarray, "frames 33 3 n"]
) -> Float[np.ndarray, "frames rows n"]:
    """Rows of the image, then rows of the differences in depth."""
    seen = (view @ by).reshape(len(by), 66, -1)
    deep = (by[:, _PAIRS[:, 1], 2] - by[:, _PAIRS[:, 0], 2]) / _PAIR_SIGMAS[:, None]
    return np.concatenate([seen, deep], axis=1)
