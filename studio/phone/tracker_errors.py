"""Poses as a monocular tracker gives them: another body, another focal length, slow errors.

Errors of rotation are of the world: a tracker sees a limb's direction in the picture well, and
errs in depth. They are constant for a part, wander for another, and jitter a little.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from capture.camera import Camera
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.kinematics import PARENTS, rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.body.rotations import axis_angles_from_matrices
from preprocess.poses.root_placement import place_by_pixels
from studio.input_noise import smooth_noise

TRUNK_DEG, LIMBS_DEG, ENDS_DEG = 1.3, 2.5, 3.5
"""Errors of direction: standard deviation of the wandering part and, each, of the constant one."""
WANDER_S = 0.3
"""The directions wander this slowly: correlated over about 0.7 s."""
JITTER_DEG = 0.5
ACROSS_VIEW, ALONG_VIEW = 1.0, 0.35
"""Errors that turn a limb towards the camera, and those that turn it within the picture."""
LEAN_DEG, LEAN_WANDER_DEG, FACING_DEG = 2.5, 1.2, 2.0
"""The whole body leans in the camera's depth direction, and faces a little elsewhere."""
DEPTH_M, DEPTH_WANDER_M = 0.04, 0.03
SLOW_S = 1.2
"""Lean and depth wander this slowly: correlated over seconds."""
PLACE_SHARE = 0.004
"""Error of the place in the picture, as a share of its height."""
FOCAL_ERROR = (0.08, 0.12)
"""How far the focal length is off, as a share: between these, in either direction."""
FACING_FLIPS, WRIST_FLIPS = 1, 2
"""Short mistakes of a film: front taken for back, and a hand turned over."""

TRUNK, ENDS = (0, 3, 6, 9, 12, 13, 14, 15), (7, 8, 10, 11, 20, 21, 22, 23)
MIRRORED = (0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20, 23, 22)
"""The joint on the other side of each."""


def mistake_focal_length(camera: Camera, amount: float, seed: int) -> Camera:
    """The camera with the focal length that a user would guess.

    Args:
        camera: The true one.
        amount: 1: as `FOCAL_ERROR` says; 0: exact.
        seed: Of the error.
    """
    generator = np.random.default_rng([seed, 23])
    sign = 1.0 if generator.random() < 0.5 else -1.0
    factor = 1.0 + amount * sign * generator.uniform(*FOCAL_ERROR)
    fx, fy = camera.focal_px
    return replace(camera, focal_px=(fx * factor, fy * factor))


def track_poses(
    truth: Motion,
    true_body: ShapedBody,
    body: ShapedBody,
    cameras: tuple[Camera, Camera],
    *,
    amount: float,
    fps: float,
    seed: int,
) -> Motion:
    """What a tracker would say of a film by a static camera.

    Args:
        truth: The true poses.
        true_body: The person.
        body: What the tracker takes the person for: poses are placed so that its joints appear
            about where the person's do.
        cameras: The true one, and the one that the tracker assumes; they differ in focal length.
        amount: Factor of all errors of rotation and depth; 1: as trackers'.
        fps: Frames per second.
        seed: Of the errors.
    """
    generator = np.random.default_rng([seed, 24])
    count = len(truth)
    directions = _world_rotations(truth)
    view = cameras[0].camera_from_world[:3, :3]
    erring = _direction_errors(generator, count, fps, amount) @ view  # row vectors: Rᵀ each
    constant = np.deg2rad(amount * _sizes_deg()[:, None] / np.sqrt(3.0))
    constant = rotation_matrices(generator.standard_normal((24, 3)) * constant)
    lean = _lean_errors(generator, count, fps, amount) @ view
    directions = (
        rotation_matrices(lean)[:, None] @ rotation_matrices(erring) @ directions @ constant
    )
    motion = _from_world_rotations(truth, directions)
    moved = _place_in_picture(generator, motion, truth, (true_body, body), cameras)
    if amount > 0.0:
        moved = _flip_some(generator, moved, view[2])
    depth_m = DEPTH_M * generator.choice([-1.0, 1.0])
    depth_m = depth_m + DEPTH_WANDER_M * smooth_noise(generator, (count,), over=SLOW_S * fps)
    return _shift_in_depth(moved, body, cameras[1], amount * depth_m)


def _sizes_deg() -> Float[np.ndarray, "24"]:
    sizes = np.full(24, LIMBS_DEG)
    sizes[list(TRUNK)] = TRUNK_DEG
    sizes[list(ENDS)] = ENDS_DEG
    return sizes


def _direction_errors(
    generator: np.random.Generator, count: int, fps: float, amount: float
) -> Float[np.ndarray, "poses 24 3"]:
    """Rotation vectors in the camera's axes, of all joints."""
    slow = smooth_noise(generator, (count, 24, 3), over=max(WANDER_S * fps, 0.5))
    parts = np.array([ACROSS_VIEW, ACROSS_VIEW, ALONG_VIEW]) / np.hypot(1.0, 1.0)
    slow *= _sizes_deg()[:, None] * parts
    jitter = JITTER_DEG * generator.standard_normal((count, 24, 3)) / np.sqrt(3.0)
    errors = np.deg2rad(amount * (slow + jitter))
    errors[:, [22, 23]] = errors[:, [20, 21]]  # a tracker of bodies sees no fingers
    return errors


def _lean_errors(
    generator: np.random.Generator, count: int, fps: float, amount: float
) -> Float[np.ndarray, "poses 3"]:
    """Rotation vectors of the whole body in the camera's axes (x: leaning in depth)."""
    slow = smooth_noise(generator, (count, 2), over=max(SLOW_S * fps, 0.5))
    lean = LEAN_DEG * generator.choice([-1.0, 1.0]) + LEAN_WANDER_DEG * slow[:, 0]
    return np.deg2rad(amount * np.stack([lean, FACING_DEG * slow[:, 1], 0.0 * lean], axis=1))


def _world_rotations(motion: Motion) -> Float[np.ndarray, "poses 24 3 3"]:
    """Rotation of every joint relative to the rest pose, in the world."""
    local = rotation_matrices(
        np.concatenate([motion.root_rotations[:, None], motion.joint_rotations], axis=1)
    )
    world = local.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ local[:, joint]
    return world


def _from_world_rotations(motion: Motion, world: Float[np.ndarray, "poses 24 3 3"]) -> Motion:
    """The motion with other rotations of its joints in the world."""
    local = world.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            local[:, joint] = np.swapaxes(world[:, parent], -1, -2) @ world[:, joint]
    vectors = axis_angles_from_matrices(local)
    return replace(motion, root_rotations=vectors[:, 0], joint_rotations=vectors[:, 1:])


def _flip_some(
    generator: np.random.Generator, motion: Motion, forward: Float[np.ndarray, "3"]
) -> Motion:
    """Front taken for back and hands turned over, for 2 to 4 frames each.

    Args:
        generator: Chooses when.
        motion: Without these mistakes.
        forward: Where the camera looks, in the world.
    """
    world = _world_rotations(motion)
    in_depth, left_right = np.eye(3) - 2.0 * np.outer(forward, forward), np.diag([-1.0, 1.0, 1.0])
    wrist_turn = rotation_matrices(np.array([0.8 * np.pi, 0.0, 0.0]))
    for kind in ["facing"] * FACING_FLIPS + ["wrist"] * WRIST_FLIPS:
        start = int(generator.integers(len(motion)))
        rows = slice(start, start + int(generator.integers(2, 5)))
        if kind == "facing":
            world[rows] = in_depth @ world[rows][:, list(MIRRORED)] @ left_right
        else:
            wrist = int(generator.choice([20, 21]))
            for joint in (wrist, wrist + 2):
                world[rows, joint] = world[rows, joint] @ wrist_turn
    return _from_world_rotations(motion, world)


def _place_in_picture(
    generator: np.random.Generator,
    motion: Motion,
    truth: Motion,
    bodies: tuple[ShapedBody, ShapedBody],
    cameras: tuple[Camera, Camera],
) -> Motion:
    """The motion with its body's joints about where the picture shows the person's."""
    true_body, body = bodies
    true_camera, assumed = cameras
    view = assumed.camera_from_world
    wander = smooth_noise(generator, (len(motion), 2), over=10.0)
    wander *= PLACE_SHARE * true_camera.size_px[1]
    places = []
    for row in range(len(motion)):
        pixels = true_camera.project(true_body.with_pose(truth[row]).joints()) + wander[row]
        joints = body.with_pose(motion[row]).joints() @ view[:3, :3].T + view[:3, 3]
        shift = place_by_pixels(joints, pixels, assumed)
        places.append(motion.root_translations[row] + view[:3, :3].T @ shift)
    return replace(motion, root_translations=np.stack(places))


def _shift_in_depth(
    motion: Motion, body: ShapedBody, camera: Camera, depth_m: Float[np.ndarray, "poses"]
) -> Motion:
    """The motion moved away from the camera along the ray through the pelvis."""
    pelvis = body.joints[0] + motion.root_translations
    rays = pelvis - camera.center_world
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return replace(motion, root_translations=motion.root_translations + depth_m[:, None] * rays)


def mean_joint_error_deg(one: BodyPose, other: BodyPose) -> float:
    """Mean angle between the local rotations of joints 1 … 21 of two poses, degrees."""
    a = rotation_matrices(one.joint_rotations[:21])
    b = rotation_matrices(other.joint_rotations[:21])
    vectors = axis_angles_from_matrices(np.swapaxes(a, -1, -2) @ b)
    return float(np.rad2deg(np.linalg.norm(vectors, axis=-1)).mean())
