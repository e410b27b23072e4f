"""Where the camera stands: 3.2 m away at chest height, the whole person in the picture.

A phone that is carried around the actor: where it is and looks in each frame.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from studio.actor import Actor
from studio.gestures import Gesture

STATIC_DISTANCE_M = 3.2
STATIC_HEIGHT_M = 1.2

PERSON_HEIGHT_SHARE = 0.825
"""Height of the standing person as a share of the picture's."""
HEADROOM_SHARE = 0.110
"""Share of the picture above the head: room for raised arms."""


PORTRAIT_HEIGHT_SHARE, PORTRAIT_HEADROOM_SHARE = 0.85, 0.075
"""The same of a portrait."""
DANCE_HEIGHT_SHARE, DANCE_HEADROOM_SHARE = 0.62, 0.20
"""The same of a portrait of a dance: arms and legs reach to all sides."""


def static_camera(actor: Actor, size: int) -> Camera:
    """The studio's square camera, set up for one actor; the world's floor is y = 0."""
    return _frame_actor(actor, (size, size), PERSON_HEIGHT_SHARE, HEADROOM_SHARE)


def portrait_camera(actor: Actor, width: int, *, dances: bool = False) -> Camera:
    """A phone held upright on a tripod, 9:16, set up for one actor; sides are even numbers.

    Args:
        actor: Who is filmed.
        width: Of the pictures, px.
        dances: Whether there must be room for a dance.
    """
    size_px = 2 * round(width / 2), 2 * round(width * 8 / 9)
    if dances:
        return _frame_actor(actor, size_px, DANCE_HEIGHT_SHARE, DANCE_HEADROOM_SHARE)
    return _frame_actor(actor, size_px, PORTRAIT_HEIGHT_SHARE, PORTRAIT_HEADROOM_SHARE)


def _frame_actor(
    actor: Actor, size_px: tuple[int, int], height_share: float, headroom_share: float
) -> Camera:
    """A camera whose picture the standing actor fills to a share of its height."""
    points, height = _standing_vertices(actor), size_px[1]
    focal, target = 1.3 * height, 0.9
    camera = _aim_camera(size_px, focal, target)
    for _ in range(12):
        rows = camera.project(points)[:, 1] / height
        focal *= height_share / float(np.ptp(rows))
        target += (headroom_share - float(rows.min())) * height * STATIC_DISTANCE_M / focal
        camera = _aim_camera(size_px, focal, target)
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


def _aim_camera(size_px: tuple[int, int], focal: float, target: float) -> Camera:
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
        center_px=(0.5 * size_px[0], 0.5 * size_px[1]),
        size_px=size_px,
        camera_from_world=camera_from_world,
    )


WALK_ASPECT = (16, 9)
FOCAL_SHARE = 0.68
"""Focal length in units of the picture's longer side: a phone's main camera."""
ARC_DEG = 120.0
WALK_DISTANCE_HEIGHTS = 1.52
"""Distance to the actor, in heights of the actor: the whole body is in the image."""
HANDHELD_HEIGHT_M = 1.4
STANDING_DISTANCE_M = 3.4
"""From here the camera that stands still sees raised arms, too."""

NEAR_FOOT_OFFSET_M = 0.2
"""Distance by which the nearer foot is closer to the camera than the body center, metres."""

SHAKE_M, SHAKE_DEG = 0.012, 0.6
"""Standard deviation of the hand's trembling, for each axis."""
SHAKE_FRAMES = 2.5
"""It is smooth over about this many frames."""


def handheld_cameras(
    actor_xz_m: Float[np.ndarray, "frames 2"], height_m: float, size: int, seed: int
) -> tuple[Camera, ...]:
    """One camera a frame, on an arc of `ARC_DEG` around the actor, the actor in the picture.

    Args:
        actor_xz_m: Where the actor stands on the floor (x, z), in each frame.
        height_m: How tall the actor is.
        size: Width of the pictures in pixels; the height is 9/16 of it.
        seed: Of the walk and the trembling.
    """
    frames = len(actor_xz_m)
    generator = np.random.default_rng([seed, 7])
    shake = _smooth_gaussian_noise(generator, frames, 6, SHAKE_FRAMES)
    slow = _smooth_gaussian_noise(generator, frames, 3, max(frames / 6.0, 1.0))
    share = np.linspace(0.0, 1.0, frames) + 0.02 * np.sin(2.0 * np.pi * np.linspace(0, 1, frames))
    angles = np.deg2rad(ARC_DEG) * (share - 0.5)
    steps = np.arange(frames) * (2.0 * np.pi / 16.0)  # a step lifts the hand, twice a second
    away = WALK_DISTANCE_HEIGHTS * height_m + 0.05 * np.tanh(slow[:, 0])
    eyes = np.column_stack(
        [away * np.sin(angles), np.full(frames, HANDHELD_HEIGHT_M), away * np.cos(angles)]
    )
    eyes[:, 1] += 0.03 * np.tanh(slow[:, 1]) + 0.012 * np.sin(steps)
    eyes += SHAKE_M * shake[:, :3]
    turned = np.deg2rad(SHAKE_DEG) * shake[:, 3:]
    turned[:, 2] += np.deg2rad(1.5) * np.tanh(slow[:, 2])
    return tuple(
        _aim_handheld_camera(eyes[i], actor_xz_m[i], height_m, size, turned[i])
        for i in range(frames)
    )


def standing_camera(height_m: float, size: int) -> Camera:
    """A camera that stands still in the middle of the arc, a step behind it."""
    eye = np.array([0.0, HANDHELD_HEIGHT_M, STANDING_DISTANCE_M])
    return _aim_handheld_camera(eye, np.zeros(2), height_m, size, np.zeros(3))


def wide_image_size(size: int) -> tuple[int, int]:
    """Width and height of the pictures whose longer side has `size` pixels."""
    return size, max(1, round(size * WALK_ASPECT[1] / WALK_ASPECT[0]))


def actor_height_m(actor: Actor) -> float:
    """How tall an actor stands, shoes and hair included, metres."""
    pose = BodyPose.rest()
    return float(actor.vertices(pose)[:, 1].max() - actor.sole_height_m(pose))


def _aim_handheld_camera(
    eye: Float[np.ndarray, "3"],
    actor_xz_m: Float[np.ndarray, "2"],
    height_m: float,
    size: int,
    shake_rotation: Float[np.ndarray, "3"],
) -> Camera:
    """A camera whose picture has the head as far from its middle as the feet, then turned."""
    across = np.array([actor_xz_m[0] - eye[0], 0.0, actor_xz_m[1] - eye[2]])
    away = float(np.linalg.norm(across))
    ends = np.arctan2(height_m - eye[1], away), np.arctan2(-eye[1], away - NEAR_FOOT_OFFSET_M)
    pitch = 0.5 * (ends[0] + ends[1]) + shake_rotation[0]
    yaw = np.arctan2(across[0], across[2]) + shake_rotation[1]
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    cosine, sine = np.cos(shake_rotation[2]), np.sin(shake_rotation[2])
    axes = np.stack([cosine * right + sine * down, cosine * down - sine * right, forward])
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = axes
    camera_from_world[:3, 3] = -axes @ eye
    width, height = wide_image_size(size)
    return Camera(
        focal_px=(FOCAL_SHARE * width, FOCAL_SHARE * width),
        center_px=(0.5 * width, 0.5 * height),
        size_px=(width, height),
        camera_from_world=camera_from_world,
    )


def _smooth_gaussian_noise(
    generator: np.random.Generator, frames: int, columns: int, over: float
) -> Float[np.ndarray, "frames columns"]:
    """Return Gaussian noise of unit variance, smoothed over a number of frames."""
    margin = int(4 * over) + 1
    white = generator.standard_normal((frames + 2 * margin, columns))
    smooth = gaussian_filter1d(white, over, axis=0)[margin : margin + frames]
    return smooth * np.sqrt(2.0 * np.sqrt(np.pi) * over)  # the power of a Gaussian filter
