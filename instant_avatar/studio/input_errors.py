"""Masks as a segmenter gives them, and poses as a tracker does: everything a little wrong.

A mask's border wanders in and out and has halos, holes and missing hands. Poses are the truth with
an error that wanders; like a tracker's, they are those of another body under another focal length.
Their errors of rotation are of the world: a tracker sees a limb's direction in the picture well,
and errs in depth. They are constant for a part, wander for another, and jitter a little.
"""

from dataclasses import replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from capture.camera import Camera
from capture.source import AlphaMask
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import signed_distance_px
from preprocess.body.kinematics import PARENTS, axis_angles_from_matrices, rotation_matrices
from preprocess.body.parametric_body import ShapedBody
from preprocess.poses.motion_builder import place_by_pixels, transform_motion

BORDER_NOISE_SCALE_PX = 6.0
"""Standard deviation of the blur that makes the wandering smooth along the border."""


def add_mask_noise(
    alpha: AlphaMask,
    noise_px: float,
    generator: np.random.Generator,
    *,
    grown_px: float = 0.0,
    soft_px: float = 1.0,
) -> AlphaMask:
    """Move the border of the exact mask in and out by smooth noise of this standard deviation.

    The whole border is moved outwards by `grown_px`; its ramp from 0 to 1 is `soft_px` wide.
    Without noise the mask is returned as it is.
    """
    if noise_px == 0.0:
        return alpha
    inside_px = -signed_distance_px(alpha >= 0.5)
    white = generator.standard_normal(alpha.shape).astype(np.float32)
    wander = cv2.GaussianBlur(
        white, (0, 0), BORDER_NOISE_SCALE_PX, borderType=cv2.BORDER_REFLECT_101
    )
    wander *= noise_px * 2.0 * np.sqrt(np.pi) * BORDER_NOISE_SCALE_PX  # a blur leaves 1 / (2 √π σ)
    moved = (inside_px + grown_px + wander) / soft_px
    return np.clip(moved + 0.5, 0.0, 1.0).astype(np.float32)


def add_pose_noise(motion: Motion, *, degrees: float, centimetres: float, seed: int) -> Motion:
    """Add smooth noise to rotations and place, as a tracker would.

    `degrees` and `centimetres` are standard deviations of each component of each axis-angle, and of
    the root's place.
    """
    if degrees == 0.0 and centimetres == 0.0:
        return motion
    generator = np.random.default_rng([seed, 3])
    frames = len(motion)
    # a tracker's errors wander over some frames rather than flicker
    turned = smooth_noise(generator, (frames, 24, 3)) * np.deg2rad(degrees)
    moved = smooth_noise(generator, (frames, 3)) * centimetres / 100.0
    return replace(
        motion,
        root_rotations=motion.root_rotations + turned[:, 0],
        root_translations=motion.root_translations + moved,
        joint_rotations=motion.joint_rotations + turned[:, 1:],
    )


def to_camera_space(
    motion: Motion, cameras: tuple[Camera, ...], pelvis: Float[np.ndarray, "3"]
) -> Motion:
    """Return the track of a tracker that knows no world: rows in their frames' cameras, with K."""
    views = np.stack([camera.camera_from_world for camera in cameras])
    return replace(
        transform_motion(motion, views, pelvis), space="camera", intrinsic=cameras[0].intrinsic
    )


def smooth_noise(
    generator: np.random.Generator, shape: tuple[int, ...], over: float = 3.0
) -> Float[np.ndarray, "frames *rest"]:
    """Return Gaussian noise of unit variance, smoothed by a Gaussian of width `over`, in frames."""
    margin = max(1, int(4 * over))
    white = generator.standard_normal((shape[0] + 2 * margin, *shape[1:]))
    smooth = gaussian_filter1d(white, over, axis=0)[margin : margin + shape[0]]
    # The power of a Gaussian filter: its variance falls to 1 / (2 √π σ).
    return smooth * np.sqrt(2.0 * np.sqrt(np.pi) * over)


HOLE_FRAMES, HAND_GAPS_PER_S = 0.12, 0.35
"""Share of frames with holes; lost hands a second."""


@final
class SegmenterErrors:
    """Errors of a segmenter in the masks of one video, frame by frame in order."""

    def __init__(self, frames: int, fps: float, seed: int) -> None:
        """Choose the frames in which hands get lost."""
        self._generator = np.random.default_rng([seed, 22])
        self._halo = np.tanh(smooth_noise(self._generator, (frames,), over=0.5 * fps))
        self._lost = np.zeros((frames, 2), dtype=bool)
        for _ in range(max(1, round(HAND_GAPS_PER_S * frames / fps))):
            start, side = self._generator.integers(frames), self._generator.integers(2)
            self._lost[start : start + int(self._generator.integers(2, 8)), side] = True

    def apply(
        self, alpha: AlphaMask, row: int, hands_px: Float[np.ndarray, "2 2"], px_per_m: float
    ) -> AlphaMask:
        """Return a frame's mask with errors.

        `hands_px` are the left and the right hand; `px_per_m` is the scale at the actor.
        """
        width = alpha.shape[1]
        wrong = add_mask_noise(
            alpha,
            0.0028 * width,  # 1.5 of 540 pixels
            self._generator,
            grown_px=0.0022 * width * (0.4 + float(self._halo[row])),
            soft_px=2.5,
        )
        for side in (0, 1):
            if self._lost[row, side]:
                wrong *= 1.0 - _disc(alpha.shape, hands_px[side], 0.11 * px_per_m)
        inside = np.argwhere(alpha > 0.99)
        if self._generator.random() < HOLE_FRAMES and len(inside):
            for _ in range(int(self._generator.integers(1, 4))):
                row_column = inside[self._generator.integers(len(inside))]
                radius = float(self._generator.uniform(0.01, 0.035)) * px_per_m
                wrong *= 1.0 - _disc(alpha.shape, row_column[::-1].astype(np.float64), radius)
        return wrong.astype(np.float32)


def _disc(shape: tuple[int, int], middle_px: Float[np.ndarray, "2"], radius_px: float) -> AlphaMask:
    """1 inside a circle, 0 outside, a pixel soft."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]] + 0.5
    away = np.hypot(x - middle_px[0], y - middle_px[1])
    return np.clip(radius_px - away + 0.5, 0.0, 1.0).astype(np.float32)


TRUNK_DEG, LIMBS_DEG, ENDS_DEG = 1.3, 2.5, 3.5
"""Errors of direction: standard deviation of the wandering part and, each, of the constant one."""
ACROSS_VIEW, ALONG_VIEW = 1.0, 0.35
"""Factors of errors that turn a limb towards the camera, and of those within the picture."""
LEAN_DEG, LEAN_WANDER_DEG, FACING_DEG = 2.5, 1.2, 2.0
"""The whole body leans in the camera's depth direction, and faces a little elsewhere."""
DEPTH_M, DEPTH_WANDER_M = 0.04, 0.03
SLOW_S = 1.2
"""Standard deviation of the smoothing of lean and depth: correlated over seconds."""
FACING_FLIPS, WRIST_FLIPS = 1, 2
"""Short mistakes of a film: front taken for back, and a hand turned over."""
TRUNK, ENDS = (0, 3, 6, 9, 12, 13, 14, 15), (7, 8, 10, 11, 20, 21, 22, 23)
MIRRORED = (0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20, 23, 22)
"""The joint on the other side of each."""


def mistake_focal_length(camera: Camera, amount: float, seed: int) -> Camera:
    """Return the camera with the focal length that a user would guess; 0 for `amount` is exact."""
    generator = np.random.default_rng([seed, 23])
    sign = 1.0 if generator.random() < 0.5 else -1.0
    factor = 1.0 + amount * sign * generator.uniform(0.08, 0.12)
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
    """Return the poses of a tracker, with its errors, for a film by a static camera.

    Args:
        true_body: The person.
        body: Body that the tracker assumes: poses are placed so that its joints appear about where
            the person's do.
        cameras: The true one, and the one that the tracker assumes; they differ in focal length.
        amount: Factor of all errors of rotation and depth; 1: as trackers'.
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
    # correlated over about 0.7 s
    slow = smooth_noise(generator, (count, 24, 3), over=max(0.3 * fps, 0.5))
    parts = np.array([ACROSS_VIEW, ACROSS_VIEW, ALONG_VIEW]) / np.hypot(1.0, 1.0)
    slow *= _sizes_deg()[:, None] * parts
    jitter = 0.5 * generator.standard_normal((count, 24, 3)) / np.sqrt(3.0)
    errors = np.deg2rad(amount * (slow + jitter))
    errors[:, [22, 23]] = errors[:, [20, 21]]  # a tracker of bodies sees no fingers
    return errors


def _lean_errors(
    generator: np.random.Generator, count: int, fps: float, amount: float
) -> Float[np.ndarray, "poses 3"]:
    """Return rotation vectors of the whole body in the camera's axes (x: leaning in depth)."""
    slow = smooth_noise(generator, (count, 2), over=max(SLOW_S * fps, 0.5))
    lean = LEAN_DEG * generator.choice([-1.0, 1.0]) + LEAN_WANDER_DEG * slow[:, 0]
    return np.deg2rad(amount * np.stack([lean, FACING_DEG * slow[:, 1], 0.0 * lean], axis=1))


def _world_rotations(motion: Motion) -> Float[np.ndarray, "poses 24 3 3"]:
    local = rotation_matrices(
        np.concatenate([motion.root_rotations[:, None], motion.joint_rotations], axis=1)
    )
    world = local.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            world[:, joint] = world[:, parent] @ local[:, joint]
    return world


def _from_world_rotations(motion: Motion, world: Float[np.ndarray, "poses 24 3 3"]) -> Motion:
    local = world.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            local[:, joint] = np.swapaxes(world[:, parent], -1, -2) @ world[:, joint]
    vectors = axis_angles_from_matrices(local)
    return replace(motion, root_rotations=vectors[:, 0], joint_rotations=vectors[:, 1:])


def _flip_some(
    generator: np.random.Generator, motion: Motion, forward: Float[np.ndarray, "3"]
) -> Motion:
    """Take front for back and turn hands over, for 2 to 4 frames each."""
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
    """Move the body so that its joints appear about where the person's do."""
    true_body, body = bodies
    true_camera, assumed = cameras
    view = assumed.camera_from_world
    wander = smooth_noise(generator, (len(motion), 2), over=10.0)
    wander *= 0.004 * true_camera.size_px[1]
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
    """Move the body away from the camera along the ray through the pelvis."""
    pelvis = body.joints[0] + motion.root_translations
    rays = pelvis - camera.center_world
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return replace(motion, root_translations=motion.root_translations + depth_m[:, None] * rays)
