"""Where a posed body lands in a small picture, and how well that agrees with a mask."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.camera import Camera
from preprocess.body import ShapedBody
from preprocess.pose import BodyPose

SKIN_POINTS = 8000
"""On the skin: about three on each pixel of a person who is `PERSON_PX` high."""
SILHOUETTE_PERSON_PX = 96
"""Height of a person in the small pictures, in pixels: one is about 2 cm."""
NEAR_PLANE_M = 0.05
"""Points nearer to the camera than this are not drawn."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinPoints:
    """Points all over one person's skin, evenly spread: enough to draw a silhouette from.

    Attributes:
        shaped: The person.
        rest: Where they lie at rest, metres.
        weights: Their skinning weights.
    """

    shaped: ShapedBody
    rest: Float32[np.ndarray, "points 3"]
    weights: Float32[np.ndarray, "points 24"]

    @classmethod
    def of(cls, shaped: ShapedBody, count: int = SKIN_POINTS) -> "SkinPoints":
        """Systematic samples of the surface: every `count`-th part of the area has its point.

        Within a triangle they follow the R2 sequence (the plane's golden ratio).
        """
        corners = shaped.vertices[shaped.body.faces]
        sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.cumsum(np.linalg.norm(sides, axis=1))
        places = (np.arange(count) + 0.5) / count * area[-1]
        face = np.minimum(np.searchsorted(area, places), len(area) - 1)
        u, v = np.modf(np.arange(1, count + 1)[:, None] * (0.7548776662, 0.5698402910))[0].T
        beyond = u + v > 1.0
        u, v = np.where(beyond, 1.0 - u, u), np.where(beyond, 1.0 - v, v)
        shares = np.stack([1.0 - u - v, u, v], axis=1)
        chosen = shaped.body.faces[face]
        return cls(
            shaped=shaped,
            rest=np.einsum("pc,pca->pa", shares, shaped.vertices[chosen]).astype(np.float32),
            weights=np.einsum("pc,pcj->pj", shares, shaped.body.weights[chosen]).astype(np.float32),
        )

    def posed(self, pose: BodyPose) -> Float32[np.ndarray, "points 3"]:
        """Where they are in the world, by linear blend skinning (without pose blend shapes)."""
        transforms = self.shaped.with_pose(pose).world_from_rest()[:, :3]
        blended = (self.weights @ transforms.reshape(24, 12).astype(np.float32)).reshape(-1, 3, 4)
        return np.einsum("pab,pb->pa", blended[:, :, :3], self.rest) + blended[:, :, 3]


def splat_silhouette(
    points_world: Float[np.ndarray, "points 3"], camera: Camera
) -> Bool[np.ndarray, "height width"]:
    """The pixels that dense points of a surface cover; nothing of what is behind the camera.

    Holes of a pixel or two between the points are closed.
    """
    width, height = camera.size_px
    drawn = np.zeros((height, width), dtype=np.uint8)
    x, y, depth = _project(points_world, camera)
    inside = (depth > NEAR_PLANE_M) & (x >= 0.0) & (x < width) & (y >= 0.0) & (y < height)
    drawn[y[inside].astype(np.int64), x[inside].astype(np.int64)] = 1
    return cv2.morphologyEx(drawn, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0


def _project(
    points_world: Float[np.ndarray, "points 3"], camera: Camera
) -> Float32[np.ndarray, "3 points"]:
    """x and y in pixels, and the depth; as `Camera.project`, but twice as fast without a lens.

    A hundredth of a pixel, which is what single precision costs, is enough here.
    """
    matrix = (camera.intrinsic @ camera.camera_from_world[:3]).astype(np.float32)
    projected = matrix[:, :3] @ points_world.T.astype(np.float32) + matrix[:, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        projected[:2] /= projected[2]
    if camera.distortion:
        before = projected[2] > NEAR_PLANE_M
        projected[:2, before] = camera.project(points_world[before].astype(np.float64)).T
    return projected


def soft_iou(
    body: Bool[np.ndarray, "height width"], alpha: Float32[np.ndarray, "height width"]
) -> float:
    """Intersection over union of a silhouette and a soft mask, in [0, 1].

    The soft kind: the sum of the smaller over the sum of the larger of each pixel's two.
    """
    both, either = float(alpha[body].sum()), float(alpha.sum() + body.sum())
    union = either - both
    return both / union if union > 0.0 else 0.0
