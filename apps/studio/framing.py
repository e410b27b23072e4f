"""Where the camera stands: 3.2 m away at chest height, the whole person in the picture."""

import numpy as np
from jaxtyping import Float

from apps.studio.actor import Actor
from apps.studio.gesture import Gesture
from capture.camera import Camera
from preprocess.pose import BodyPose

STATIC_DISTANCE_M = 3.2
STATIC_HEIGHT_M = 1.2

PERSON_HEIGHT_SHARE = 0.825
"""Height of the standing person as a share of the picture's."""
HEADROOM_SHARE = 0.110
"""Share of the picture above the head: room for raised arms."""


def static_camera(actor: Actor, size: int) -> Camera:
    """The studio's square camera, set up for one actor; the world's floor is y = 0."""
    points = _standing_vertices(actor)
    focal, target = 1.3 * size, 0.9
    camera = _aim_camera(size, focal, target)
    for _ in range(12):
        rows = camera.project(points)[:, 1] / size
        focal *= PERSON_HEIGHT_SHARE / float(np.ptp(rows))
        target += (HEADROOM_SHARE - float(rows.min())) * size * STATIC_DISTANCE_M / focal
        camera = _aim_camera(size, focal, target)
    return camera


def _standing_vertices(actor: Actor) -> Float[np.ndarray, "vertices 3"]:
    """The standing actor from the front and from the side, feet on the floor."""
    views = []
    for yaw in (0.0, 0.5 * np.pi):
        pelvis = actor.shaped.joints[0]
        pose = BodyPose(
            root_rotation=np.array([0.0, yaw, 0.0]),
            root_translation=-pelvis,
            joint_rotations=Gesture().joint_rotations().as_rotvec(),
        )
        views.append(actor.vertices(pose) - np.array([0.0, actor.sole_height_m(pose), 0.0]))
    return np.concatenate(views)


def _aim_camera(size: int, focal: float, target: float) -> Camera:
    """A camera in front of the actor that looks at the height `target` above the origin."""
    eye = np.array([0.0, STATIC_HEIGHT_M, STATIC_DISTANCE_M])
    forward = np.array([0.0, target, 0.0]) - eye
    forward /= np.linalg.norm(forward)
    right = np.array([1.0, 0.0, 0.0])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = [right, np.cross(forward, right), forward]
    camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ eye
    return Camera(
        focal_px=(focal, focal),
        center_px=(0.5 * size, 0.5 * size),
        size_px=(size, size),
        camera_from_world=camera_from_world,
    )
