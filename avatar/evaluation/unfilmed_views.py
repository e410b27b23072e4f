"""Views that no video shows: new poses from four sides, and how solid an avatar is in them.

Held-out frames come from the filmed side, where fog that imitates each view scores best. From
elsewhere, in other poses, fog shows as pixels that are neither opaque nor empty.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from avatar.avatar_model import Avatar
from avatar.render import render
from avatar.rig import Rig
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

SIDES = 4
"""Directions from which each pose is seen, evenly around the person."""
VIEW_PX = (320, 480)
"""Width and height of a view, pixels."""
DISTANCE_HEIGHTS = 2.5
"""Distance of the camera, in heights of the person."""
LEFT_HIP, RIGHT_HIP, LEFT_KNEE, RIGHT_KNEE = 0, 1, 3, 4
LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_ELBOW, RIGHT_ELBOW = 15, 16, 17, 18
"""Rows of joints in the 23 joint rotations."""
UNFILMED_POSES: tuple[dict[int, tuple[float, float, float]], ...] = (
    {
        LEFT_SHOULDER: (0.0, 0.0, -0.9), RIGHT_SHOULDER: (0.0, 0.0, 0.4),
        LEFT_ELBOW: (0.0, -0.4, 0.0), RIGHT_ELBOW: (0.0, 0.9, 0.3),
        LEFT_HIP: (-0.7, 0.0, 0.12), LEFT_KNEE: (1.0, 0.0, 0.0), RIGHT_HIP: (0.2, 0.0, -0.1),
    },
    {
        LEFT_SHOULDER: (0.0, -0.6, 0.2), RIGHT_SHOULDER: (0.0, 0.2, 1.1),
        LEFT_ELBOW: (0.0, -0.9, 0.0), RIGHT_ELBOW: (0.0, 0.3, 0.0),
        LEFT_HIP: (0.25, 0.0, 0.15), RIGHT_HIP: (-0.5, 0.0, -0.15), RIGHT_KNEE: (0.5, 0.0, 0.0),
    },
)  # fmt: skip
"""Axis-angle rotations, radians, of the joints that each pose moves: a lifted knee with one arm
raised, and a step with one arm forward."""


def unfilmed_views(rig: Rig) -> Iterator[tuple[BodyPose, Camera]]:
    """Poses and cameras of all views: each pose at the origin, from four sides at chest height."""
    height_m = float(rig.rest_joints[:, 1].max() - rig.rest_joints[:, 1].min()) * 1.1
    distance_m = DISTANCE_HEIGHTS * height_m
    middle = (rig.rest_joints[:, 1].max() + rig.rest_joints[:, 1].min()) / 2.0
    target = np.array([rig.rest_joints[0, 0], middle, rig.rest_joints[0, 2]])
    for rotations in UNFILMED_POSES:
        joints = np.zeros((23, 3))
        for joint, rotation in rotations.items():
            joints[joint] = rotation
        pose = replace(BodyPose.rest(), joint_rotations=joints)
        for side in range(SIDES):
            yield pose, _camera_around(target, 2.0 * np.pi * side / SIDES, distance_m, height_m)


def _camera_around(
    target: Float[np.ndarray, "3"], angle: float, distance_m: float, height_m: float
) -> Camera:
    """A level camera that looks at a point from an angle about the vertical, 0: from the front."""
    forward = -np.array([np.sin(angle), 0.0, np.cos(angle)])
    down = np.array([0.0, -1.0, 0.0])
    axes = np.stack([np.cross(down, forward), down, forward])
    focal_px = 0.8 * VIEW_PX[1] * distance_m / height_m  # the person fills 0.8 of the height
    return Camera.at(target - distance_m * forward, axes, focal_px, VIEW_PX)


def render_unfilmed_views(
    avatar: Avatar, *, reduction: int = 1
) -> list[Float32[np.ndarray, "height width 4"]]:
    """Premultiplied renderings of all views, in the order of `unfilmed_views`.

    Images are smaller by the factor `reduction`. A ray has no width: the share of half-transparent
    pixels stays the same.
    """
    size = VIEW_PX[0] // reduction, VIEW_PX[1] // reduction
    return [
        render(avatar, pose, camera.resize(size)) for pose, camera in unfilmed_views(avatar.rig)
    ]


def half_transparent_share(pictures: Sequence[Float32[np.ndarray, "height width 4"]]) -> float:
    """Share of the person's pixels that are half transparent, in [0, 1].

    Outlines alone make 5 to 8 % of a person of `VIEW_PX`. An avatar of which nothing is seen counts
    as wholly transparent.
    """
    alphas = np.concatenate([picture[..., 3].ravel() for picture in pictures])
    seen = alphas > 0.1
    if not seen.any():
        return 1.0
    return float((alphas[seen] < 0.9).mean())
