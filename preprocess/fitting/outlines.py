"""Outline residuals: how far a posed person's outline lies from a mask's, and the Jacobian.

Points of the skin that lie on the silhouette's border are compared with the mask's signed distance,
and points of the mask's border with the nearest of these skin points along the border's normal.
Both are linearised in the frame's pose, the proportions and the focal length.
"""

from dataclasses import dataclass
from typing import NamedTuple, final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int
from scipy.spatial import KDTree

from capture.camera import Camera
from preprocess.body.body_surface import (
    SkinPoints,
    signed_distance_px,
    splat_silhouette,
    vertex_normals,
)
from preprocess.body.kinematics import descendant_matrix
from preprocess.body.proportion_space import ProportionSpace

OUTLINE_PERSON_PX = 128
"""Height of a person in the reduced masks, px: a pixel is about 1.4 cm."""
OUTLINE_SKIN_POINTS = 7000
"""Points on the skin: about one per pixel of a person `OUTLINE_PERSON_PX` high."""
BORDER_POINTS = 160
"""Points of the borders of mask and skin that are compared."""
IMAGE_BORDER_PX = 2.0
"""Distance from the image's border within which a mask's border is no outline, px."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutlineDistances:
    """The outline of one reduced mask, seen by `camera`.

    Attributes:
        distance: Signed distance from the outline, negative inside, px.
        border, normals: Points of the outline, px, and its outward unit normals there.
    """

    camera: Camera
    distance: Float32[np.ndarray, "height width"]
    border: Float[np.ndarray, "points 2"]
    normals: Float[np.ndarray, "points 2"]

    @classmethod
    def of(cls, alpha: Float32[np.ndarray, "height width"], camera: Camera) -> "OutlineDistances":
        """The outline of a reduced mask, in [0, 1], seen by a camera of its size."""
        hard = (alpha > 0.5).astype(np.uint8)
        distance = cv2.GaussianBlur(signed_distance_px(hard > 0), (0, 0), 0.7)
        found, _ = cv2.findContours(hard, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        border = np.concatenate([np.zeros((0, 2)), *(each[:, 0] + 0.5 for each in found)])
        height, width = alpha.shape
        away = np.minimum(border, (width, height) - border).min(axis=1)
        border = border[away > IMAGE_BORDER_PX]
        border = border[np.linspace(0, len(border), BORDER_POINTS, endpoint=False).astype(int)]
        value, slope = _sample(distance, border)
        return cls(
            camera=camera, distance=distance, border=border - value[:, None] * slope, normals=slope
        )


class OutlineRows(NamedTuple):
    """Residuals of one frame and their derivatives.

    Attributes:
        residuals: Distances along the outline's normals, px.
        weights: Robust weight of each residual, in [0, 1].
        pose_jacobian: By root rotation, 23 joint rotations (radians, each in its joint's axes,
            applied before the present rotation) and root translation (camera axes, metres).
        shape_jacobian: By the proportions' coefficients.
        focal_jacobian: By the logarithm of the focal length.
    """

    residuals: Float[np.ndarray, "rows"]
    weights: Float[np.ndarray, "rows"]
    pose_jacobian: Float[np.ndarray, "rows 75"]
    shape_jacobian: Float[np.ndarray, "rows coefficients"]
    focal_jacobian: Float[np.ndarray, "rows"]


@final
class OutlineModel:
    """A person of given proportions, whose outline is compared with masks."""

    def __init__(self, space: ProportionSpace) -> None:
        """Samples the skin of the shape at the space's origin."""
        self.space = space
        self._skin = SkinPoints.of(space.shaped, OUTLINE_SKIN_POINTS)
        self._weights = self._skin.weights
        self._rest_directions = self._skin.interpolate(space.vertex_directions).astype(np.float32)
        self._below = descendant_matrix(space.shaped.body.parents)
        self.set_proportions(np.zeros(space.count))

    def set_proportions(self, coefficients: Float[np.ndarray, "coefficients"]) -> None:
        """Gives the person other proportions."""
        shaped = self.space.shape(coefficients)
        self.joints = shaped.joints
        self._rest = self._skin.interpolate(shaped.vertices).astype(np.float32)
        normals = self._skin.interpolate(vertex_normals(shaped.vertices, shaped.body.faces))
        self._normals = normals.astype(np.float32)

    def compare(
        self,
        transforms: Float[np.ndarray, "24 4 4"],
        mask: OutlineDistances,
        *,
        proportions: bool = True,
    ) -> OutlineRows | None:
        """Residuals of a pose before a mask; None where the silhouette cannot be compared.

        `transforms` are world from rest of each joint, for the present proportions; the derivatives
        by these are left at 0 if `proportions` is false.
        """
        points, normals = self._posed(transforms)
        chosen, matched = self._match(points, normals, mask)
        if not len(matched.normals):
            return None
        rows = chosen[matched.index]
        return self._linearise(
            points[rows], rows, transforms, mask.camera, matched, proportions=proportions
        )

    def _posed(
        self, transforms: Float[np.ndarray, "24 4 4"]
    ) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3"]]:
        """The skin and its normals in the world, by linear blend skinning."""
        flat = transforms[:, :3].reshape(24, 12).astype(np.float32)
        blended = (self._weights @ flat).reshape(-1, 3, 4)
        points, normals = blended[:, :, 3].copy(), np.zeros_like(self._normals)
        for axis in range(3):  # faster than one einsum
            points += blended[:, :, axis] * self._rest[:, axis, None]
            normals += blended[:, :, axis] * self._normals[:, axis, None]
        return points, normals

    def _match(
        self,
        points: Float32[np.ndarray, "points 3"],
        normals: Float32[np.ndarray, "points 3"],
        mask: OutlineDistances,
    ) -> tuple[Int[np.ndarray, "rim"], "_Matches"]:
        """Rim points of the skin, and residuals between them and the mask's outline."""
        camera = mask.camera
        view = points - camera.center_world.astype(np.float32)
        towards, lengths, distances = (
            np.einsum("pa,pa->p", one, other)
            for one, other in ((normals, view), (normals, normals), (view, view))
        )
        near = np.flatnonzero(towards**2 < 0.2**2 * lengths * distances)  # |cosine| below 0.2
        pixels = camera.project(points[near].astype(np.float64))
        depth_px, _ = _sample(signed_distance_px(splat_silhouette(points, camera)), pixels)
        outer = np.abs(depth_px) < 2.0  # from the silhouette's border
        chosen, pixels = near[outer], pixels[outer]
        within = depth_px[outer] + 0.5  # rim points lie a little inside the outline
        if len(chosen) < 16:
            return chosen, _Matches.none()
        some = np.linspace(0, len(chosen), min(BORDER_POINTS, len(chosen)), endpoint=False)
        some = some.astype(int)
        value, slope = _sample(mask.distance, pixels[some])
        height, width = mask.distance.shape
        inside = (np.minimum(pixels[some], (width, height) - pixels[some]) > IMAGE_BORDER_PX).all(1)
        some, value, slope = some[inside], value[inside], slope[inside]
        value = value - within[some]
        tree = KDTree(pixels, compact_nodes=False, balanced_tree=False)  # half the time
        _, nearest = tree.query(mask.border)
        back = ((pixels[nearest] - mask.border) * mask.normals).sum(axis=1) - within[nearest]
        return chosen, _Matches(
            index=np.concatenate([some, nearest]),
            residuals=np.concatenate([value, back]),
            normals=np.concatenate([slope, mask.normals]),
        )

    def _linearise(
        self,
        points: Float32[np.ndarray, "rows 3"],
        rows: Int[np.ndarray, "rows"],
        transforms: Float[np.ndarray, "24 4 4"],
        camera: Camera,
        matched: "_Matches",
        *,
        proportions: bool = True,
    ) -> OutlineRows:
        """Residuals with their derivatives, by the chain rule through projection and skinning."""
        rotation = camera.camera_from_world[:3, :3]
        inside = points @ rotation.T + camera.camera_from_world[:3, 3]
        depth = inside[:, 2]
        focal = matched.normals * np.array(camera.focal_px)
        plane = inside[:, :2] / depth[:, None]
        # n · derivative of a pixel by its point: (n_x f/z, n_y f/z, -(n_x f x + n_y f y)/z²)
        in_camera = np.column_stack([focal, -(focal * plane).sum(axis=1)]) / depth[:, None]
        in_world = in_camera @ rotation
        weights = self._weights[rows].T.astype(np.float64)
        turns = transforms[:, :3, :3]
        places = np.einsum("jab,jb->ja", turns, self.joints) + transforms[:, :3, 3]
        # each bone's part of the points, summed over the bones that a joint moves
        by_bone = (
            self._rest[rows].astype(np.float64) @ turns.swapaxes(1, 2) + transforms[:, None, :3, 3]
        )
        parts = weights[..., None] * by_bone
        moved = (self._below @ parts.reshape(24, -1)).reshape(parts.shape)
        lever = moved - (self._below @ weights)[..., None] * places[:, None]
        (x, y, z), (a, b, c) = np.moveaxis(lever, -1, 0), in_world.T
        wrench = np.empty_like(lever)  # n·(ω × l) = ω·(l × n)
        for axis, part in enumerate((y * c - z * b, z * a - x * c, x * b - y * a)):
            wrench[..., axis] = part
        wrench = wrench @ turns
        pose = wrench.swapaxes(0, 1).reshape(len(rows), 72)
        size = np.abs(matched.residuals)
        # Geman-McClure: a match 3 px off counts a quarter; beyond 24 px there is none
        robust = 1.0 / (1.0 + (matched.residuals / 3.0) ** 2) ** 2
        return OutlineRows(
            residuals=matched.residuals,
            weights=np.where(size < 24.0, robust, 0.0),
            pose_jacobian=np.column_stack([pose, in_camera]),
            shape_jacobian=(
                self._shape_jacobian(rows, weights, turns, in_world)
                if proportions
                else np.zeros((len(rows), self.space.count))
            ),
            focal_jacobian=(focal * plane).sum(axis=1),
        )

    def _shape_jacobian(
        self,
        rows: Int[np.ndarray, "rows"],
        weights: Float[np.ndarray, "24 rows"],
        turns: Float[np.ndarray, "24 3 3"],
        in_world: Float[np.ndarray, "rows 3"],
    ) -> Float[np.ndarray, "rows coefficients"]:
        """Derivatives of the distances by the proportions, which move the skin and its joints."""
        parents, moved = self.space.shaped.body.parents, self.space.joint_directions
        # where a joint goes, minus what its own bone does to it
        offset = np.zeros_like(moved)
        placed = np.zeros_like(moved)
        for joint, parent in enumerate(parents):
            if parent < 0:
                placed[joint] = moved[joint]
            else:
                placed[joint] = placed[parent] + turns[parent] @ (moved[joint] - moved[parent])
            offset[joint] = placed[joint] - turns[joint] @ moved[joint]
        mixed = (weights[..., None] * (in_world @ turns)).sum(axis=0)
        own = (mixed[:, None] @ self._rest_directions[rows])[:, 0]
        lifted = (weights.T[:, :, None] * in_world[:, None]).reshape(len(rows), 72)
        return own + lifted @ offset.reshape(72, -1)


class _Matches(NamedTuple):
    """Skin points and the distances that they should move along 2-D normals to vanish, px."""

    index: Int[np.ndarray, "rows"]
    residuals: Float[np.ndarray, "rows"]
    normals: Float[np.ndarray, "rows 2"]

    @classmethod
    def none(cls) -> "_Matches":
        return cls(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 2)))


def _sample(
    distance: Float32[np.ndarray, "height width"], pixels: Float[np.ndarray, "points 2"]
) -> tuple[Float[np.ndarray, "points"], Float[np.ndarray, "points 2"]]:
    """Signed distance at points, bilinear, and its unit gradient."""
    height, width = distance.shape
    x = np.clip(pixels[:, 0] - 0.5, 0.0, width - 1.001)
    y = np.clip(pixels[:, 1] - 0.5, 0.0, height - 1.001)
    i, j = y.astype(int), x.astype(int)
    u, v = x - j, y - i
    a, b = distance[i, j].astype(float), distance[i, j + 1].astype(float)
    c, d = distance[i + 1, j].astype(float), distance[i + 1, j + 1].astype(float)
    value = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    slope = np.column_stack([(1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)])
    return value, slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 0.3)
