"""Fits the pose of a scored frame to its picture, in one way and with one budget for all systems.

A system only renders: no derivatives of its own are used. Between two pictures that differ by a
pose, colors move with the surface of the body, so the pictures' gradients tell the step of the pose
(Lucas and Kanade 1981, of an articulated body: Bregler and Malik 1998), by Gauss-Newton.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32
from scipy.ndimage import distance_transform_edt

from avatar.evaluation.image_metrics import composite_on_white, ground_truth_on_white
from instant_avatar.studio.lighting import NO_FACE, rasterize
from preprocess.body.kinematics import descendant_matrix
from preprocess.body.parametric_body import ShapedBody
from preprocess.fitting.clip_poses import POSE_SIGMA, ClipPoses
from preprocess.observation import Observation

Renderer = Callable[[Observation], Float32[np.ndarray, "height width 4"]]
"""What draws an observation's pose for its camera: a premultiplied RGBA image in [0, 1]."""
Colors = Float32[np.ndarray, "height width 3"]

ALIGNED_PX = 128
"""Longer side of the pictures that are compared; larger ones are reduced."""
RENDERINGS = 6
"""Pictures that a system renders of a frame; the first is of the pose given."""
BLURS_PX = (2.5, 2.0, 1.5, 1.0)
"""Blur of both pictures at the first steps; the last one's stays."""
SCORED_BLUR_PX = 0.7
"""Blur of both pictures when poses are compared."""
BODY_MARGIN_PX = 6.0
"""Distance from the body up to which pixels move with it: clothes and hair."""
COLOR_SIGMA = 0.2
"""Standard deviation of a color's error that no pose explains; neighboring pixels err alike."""
ROBUST_COLOR = 0.25
"""Error at which a color counts a quarter (Geman-McClure)."""
DAMPING = (0.02, 10.0)
"""Least share of the curvature that is added to it, and its factor after a step that was none."""
MAX_TURN_RAD, MAX_SHIFT_M = 0.15, 0.15
"""Largest change of a rotation's component, and of the root's place, in one step."""


def align_pose(
    render: Renderer, seen: Observation, person: ShapedBody, *, renderings: int = RENDERINGS
) -> Observation:
    """The observation in the pose in which a renderer's picture is nearest to it.

    The pose moves within the priors of a tracker's errors, from the one given; that one stays if
    none is nearer.

    Args:
        render: System whose picture is compared; its parameters stay.
        seen: With the pose to start from.
        person: Whose pose it is.
        renderings: Pictures to spend.
    """
    small = _reduce(seen)
    whole = cv2.resize(ground_truth_on_white(seen), small.camera.size_px, interpolation=_AREA)
    truth = np.asarray(whole, dtype=np.float32)
    surface, view = _BodySurface(person), seen.camera.camera_from_world
    found, moved, step = seen.pose, np.zeros(75), np.zeros(75)
    picture, least, damping = truth, np.inf, DAMPING[0]
    for turn in range(renderings):
        pose = ClipPoses.stack([found]).moved(step[None], view[None, :3, :3])[0]
        drawn = composite_on_white(render(replace(small, pose=pose)))
        error = float(np.square(_blur(drawn - truth, SCORED_BLUR_PX)).mean())
        if error < least:
            found, moved, picture, least = pose, moved + step, drawn, error
            damping = max(damping / DAMPING[1], DAMPING[0])
        else:
            damping *= DAMPING[1]
        blur = BLURS_PX[min(turn, len(BLURS_PX) - 1)]
        there = replace(small, pose=found)
        step = surface.step(there, _blur(picture, blur), _blur(truth, blur), moved, damping)
    return replace(seen, pose=found)


_AREA = cv2.INTER_AREA


def _reduce(seen: Observation) -> Observation:
    """The observation at no more than `ALIGNED_PX`."""
    if max(seen.camera.size_px) <= ALIGNED_PX:
        return seen
    camera = seen.camera.resize_longer_side(ALIGNED_PX)
    rgb = cv2.resize(seen.frame.rgb, camera.size_px, interpolation=_AREA)
    alpha = cv2.resize(seen.alpha, camera.size_px, interpolation=_AREA)
    frame = replace(seen.frame, rgb=np.asarray(rgb, dtype=np.uint8), alpha=None)
    return replace(seen, frame=frame, alpha=np.asarray(alpha, dtype=np.float32), camera=camera)


def _blur(colors: Colors, sigma_px: float) -> Colors:
    return np.asarray(cv2.GaussianBlur(colors, (0, 0), sigma_px), dtype=np.float32)


@final
class _BodySurface:
    """The skin that each pixel near a person sees, and how it moves with the pose."""

    def __init__(self, person: ShapedBody) -> None:
        self._person = person
        self._faces = person.body.faces.astype(np.int32)
        self._below = descendant_matrix(person.body.parents)

    def step(
        self, seen: Observation, picture: Colors, truth: Colors, moved: Float[np.ndarray, "75"],
        damping: float,
    ) -> Float[np.ndarray, "75"]:  # fmt: skip
        """Gauss-Newton step of the observation's pose, as `ClipPoses.moved` takes it.

        Args:
            seen: With the pose that the picture shows.
            picture, truth: What is compared.
            moved: Corrections up to now, which the prior draws back.
            damping: Share of the curvature that is added to it.
        """
        both = 0.5 * (picture + truth)
        slopes = np.stack([np.gradient(both, axis=1), np.gradient(both, axis=0)], axis=-1)
        jacobian, rows, columns = self._jacobian(seen, slopes)
        away = (truth - picture)[rows, columns].astype(np.float64).ravel()
        weights = 1.0 / (1.0 + (away / ROBUST_COLOR) ** 2) ** 2 / COLOR_SIGMA**2
        scaled = jacobian.reshape(-1, 75) * POSE_SIGMA
        curvature = (scaled * weights[:, None]).T @ scaled + np.eye(75)
        wanted = (scaled * weights[:, None]).T @ away - moved / POSE_SIGMA
        curvature[np.diag_indices(75)] *= 1.0 + damping
        step = np.linalg.solve(curvature, wanted) * POSE_SIGMA
        bound = np.where(np.arange(75) < 72, MAX_TURN_RAD, MAX_SHIFT_M)
        return np.clip(step, -bound, bound)

    def _jacobian(
        self, seen: Observation, slopes: Float32[np.ndarray, "height width 3 2"]
    ) -> tuple[Float[np.ndarray, "pixels 3 75"], np.ndarray, np.ndarray]:
        """Derivatives of the colors near the body by the pose, and the pixels' rows and columns."""
        posed, camera = self._person.with_pose(seen.pose), seen.camera
        drawn = rasterize(posed.vertices(), self._faces, camera, supersampling=1)
        outside = drawn.face == NO_FACE
        if outside.all():
            none = np.zeros(0, dtype=np.int64)
            return np.zeros((0, 3, 75)), none, none
        distance, nearest = distance_transform_edt(outside, return_indices=True)  # pyright: ignore[reportGeneralTypeIssues]
        rows, columns = np.nonzero(distance <= BODY_MARGIN_PX)
        on_body = nearest[0][rows, columns], nearest[1][rows, columns]
        corners = self._faces[drawn.face[on_body]]
        shares = drawn.barycentric[on_body].astype(np.float64)
        shares = np.concatenate([1.0 - shares.sum(axis=1, keepdims=True), shares], axis=1)
        weights = np.einsum("pc,pcj->jp", shares, self._person.body.weights[corners])
        rest = np.einsum("pc,pca->pa", shares, self._person.vertices[corners])
        transforms = posed.world_from_rest()
        turns = transforms[:, :3, :3]
        by_bone = rest @ turns.swapaxes(1, 2) + transforms[:, None, :3, 3]
        parts = weights[..., None] * by_bone
        # each bone's part of the points, summed over the bones that a joint moves
        carried = (self._below @ parts.reshape(24, -1)).reshape(parts.shape)
        lever = carried - (self._below @ weights)[..., None] * posed.joints()[:, None]
        in_camera = _by_place(parts.sum(axis=0), seen, -slopes[rows, columns])
        in_world = in_camera @ camera.camera_from_world[:3, :3]
        turned = np.cross(lever[:, :, None], in_world[None])  # n·(ω × l) = ω·(l × n)
        by_turn = (turned.reshape(24, -1, 3) @ turns).reshape(24, len(rows), 3, 3)
        by_turn = np.moveaxis(by_turn, 0, 2).reshape(len(rows), 3, 72)
        return np.concatenate([by_turn, in_camera], axis=2), rows, columns


def _by_place(
    points: Float[np.ndarray, "pixels 3"],
    seen: Observation,
    slopes: Float32[np.ndarray, "pixels 3 2"],
) -> Float[np.ndarray, "pixels 3 3"]:
    """Derivatives of each pixel's colors by its point's place in the camera's axes."""
    view = seen.camera.camera_from_world
    inside = points @ view[:3, :3].T + view[:3, 3]
    focal = slopes.astype(np.float64) * np.array(seen.camera.focal_px)
    plane = inside[:, None, :2] / inside[:, None, 2:]
    along = -(focal * plane).sum(axis=2, keepdims=True)
    return np.concatenate([focal, along], axis=2) / inside[:, None, 2:]
