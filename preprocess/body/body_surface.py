"""The surface of a body: normals, areas, points on the skin, silhouettes, outlines."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.ndimage import minimum_filter
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu

from capture.camera import Camera
from capture.source import AlphaMask
from preprocess.body.body_pose import BodyPose
from preprocess.body.parametric_body import ShapedBody

Silhouette = Bool[np.ndarray, "height width"]
"""Pixels that a body covers."""

Faces = Int[np.ndarray, "faces 3"]
"""Vertices of each triangle."""

Vertices = Float[np.ndarray, "vertices 3"]
"""Places of a mesh, metres, or directions there."""


def vertex_normals(vertices: Vertices, faces: Faces) -> Vertices:
    """Outward unit normals, area-weighted over the triangles around each vertex."""
    doubled, corners = _doubled_area_vectors(vertices, faces), faces.ravel()
    normals = np.column_stack(
        [
            np.bincount(corners, np.repeat(doubled[:, axis], 3), minlength=len(vertices))
            for axis in range(3)
        ]
    )
    return normals / (np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12)


def vertex_areas(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "vertices"]:
    """Each vertex's share of the surface, m²: a third of every triangle around it."""
    thirds = np.linalg.norm(_doubled_area_vectors(vertices, faces), axis=1) / 6.0
    return np.bincount(faces.ravel(), np.repeat(thirds, 3), minlength=len(vertices))


def smooth_over_surface(
    vertices: Vertices, faces: Faces, values: Float[np.ndarray, "vertices channels"], sigma_m: float
) -> Float[np.ndarray, "vertices channels"]:
    """Averages values over about `sigma_m` metres of the surface.

    One implicit step of heat diffusion with the cotangent Laplacian (Desbrun et al. 1999, Implicit
    fairing of irregular meshes using diffusion and curvature flow).
    """
    count, corners = len(vertices), vertices[faces]
    edges = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)  # opposite to each corner
    doubled = np.linalg.norm(_doubled_area_vectors(vertices, faces), axis=1)
    before, after = np.roll(edges, 1, axis=1), np.roll(edges, -1, axis=1)
    cotangents = -(before * after).sum(axis=2) / np.maximum(doubled, 1e-12)[:, None]
    weights = 0.5 * np.clip(cotangents, 0.0, 10.0).ravel()  # slivers would dominate
    one, other = np.roll(faces, -1, axis=1).ravel(), np.roll(faces, 1, axis=1).ravel()
    links = coo_array((weights, (one, other)), shape=(count, count)).tocsc()
    links = links + links.T
    areas = np.maximum(vertex_areas(vertices, faces), 1e-12)
    share = 0.5 * sigma_m**2
    system = diags_array(areas + share * links.sum(axis=0)) - share * links
    return splu(system.tocsc()).solve(areas[:, None] * values)


def _doubled_area_vectors(vertices: Vertices, faces: Faces) -> Float[np.ndarray, "faces 3"]:
    """Normal of each triangle, twice its area long."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


def visible_points(
    image_points: Float[np.ndarray, "points 2"],
    depth: Float[np.ndarray, "points"],
    cosine: Float[np.ndarray, "points"],
    *,
    cell_m: float = 0.03,
    tolerance_m: float = 0.03,
    margin_cells: int = 0,
) -> Bool[np.ndarray, "points"]:
    """Points that face the camera unoccluded, by a depth buffer of coarse cells.

    Args:
        image_points: Image coordinates, scaled to metres at the body.
        depth: Distance from the camera along its axis, metres.
        cosine: Of the angle between normal and view; points that face away occlude nothing.
        cell_m: Edge of a cell: no less than the points' spacing.
        tolerance_m: Largest distance behind the nearest point of its cell, beyond its own slope.
        margin_cells: Cells by which clothes and errors of the pose may widen limbs: what lies 0.1 m
            behind another point so near in the image is hidden, too.
    """
    cell = np.floor((image_points - image_points.min(axis=0)) / cell_m).astype(np.int64)
    columns = int(cell[:, 1].max()) + 1
    flat = cell[:, 0] * columns + cell[:, 1]
    nearest = np.full(int(flat.max()) + 1, np.inf)
    faces = cosine > 0.0
    np.minimum.at(nearest, flat[faces], depth[faces])
    steep = np.clip(cosine, 0.1, 1.0)
    slope = cell_m * np.sqrt(1.0 - steep**2) / steep
    shown = faces & (depth <= nearest[flat] + tolerance_m + slope)
    if margin_cells:
        image = np.append(nearest, np.full(-len(nearest) % columns, np.inf)).reshape(-1, columns)
        around = minimum_filter(image, 2 * margin_cells + 1, mode="constant", cval=np.inf)
        shown &= depth <= around.reshape(-1)[flat] + 0.1
    return shown


def visible_from_anywhere(
    points: Float[np.ndarray, "points 3"],
    normals: Float[np.ndarray, "points 3"],
    *,
    cell_m: float,
    tolerance_m: float,
    min_cosine: float,
) -> Bool[np.ndarray, "points"]:
    """Points of a closed surface that are seen from afar, from one of 26 directions around.

    `min_cosine` is that of the angle to the normal, below which a view does not count; the others
    are as in `visible_points`.
    """
    shown = np.zeros(len(points), dtype=bool)
    for direction in np.ndindex(3, 3, 3):
        to_eye = np.array(direction, dtype=np.float64) - 1.0
        if not to_eye.any():
            continue
        to_eye /= np.linalg.norm(to_eye)
        right = np.cross(to_eye, [0.0, 1.0, 0.0] if abs(to_eye[1]) < 0.9 else [1.0, 0.0, 0.0])
        plane = points @ np.column_stack([right, np.cross(right, to_eye)])
        cosine = normals @ to_eye
        found = visible_points(
            plane, -points @ to_eye, cosine, cell_m=cell_m, tolerance_m=tolerance_m
        )
        shown |= found & (cosine > min_cosine)
    return shown


DENSE_SKIN_POINTS = 40_000
"""Points on the skin for a person of 200 px, three per pixel; higher ones get holes."""
SILHOUETTE_PERSON_PX = 96
"""Height of a person in small images, px: a pixel is about 2 cm."""
NEAR_PLANE_M = 0.05
"""Least depth of a point that is drawn, metres."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinPoints:
    """Points spread evenly over one person's skin, dense enough to draw a silhouette.

    Attributes:
        corners: The three vertices that each point lies between.
        shares: Barycentric coordinates of each point between them.
    """

    shaped: ShapedBody
    rest: Float32[np.ndarray, "points 3"]
    weights: Float32[np.ndarray, "points 24"]
    corners: Int[np.ndarray, "points 3"]
    shares: Float[np.ndarray, "points 3"]

    @classmethod
    def of(cls, shaped: ShapedBody, count: int = 8000) -> "SkinPoints":
        """Sample the surface systematically: one point per equal share of the area.

        Within a triangle points follow the R2 sequence (the plane's golden ratio). 8000 are about
        three per pixel of a person `SILHOUETTE_PERSON_PX` high.
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
            corners=chosen,
            shares=shares,
        )

    def interpolate(
        self, values: Float[np.ndarray, "vertices *rest"]
    ) -> Float[np.ndarray, "points *rest"]:
        """Values of the vertices at the points."""
        return np.einsum("pc,pc...->p...", self.shares, values[self.corners])

    def posed(self, pose: BodyPose) -> Float32[np.ndarray, "points 3"]:
        """World positions by linear blend skinning (without pose blend shapes), metres."""
        transforms = self.shaped.with_pose(pose).world_from_rest()[:, :3]
        blended = (self.weights @ transforms.reshape(24, 12).astype(np.float32)).reshape(-1, 3, 4)
        return np.einsum("pab,pb->pa", blended[:, :, :3], self.rest) + blended[:, :, 3]

    def draw(self, pose: BodyPose, camera: Camera) -> Silhouette:
        """The pixels that the body covers (`splat_silhouette`)."""
        return splat_silhouette(self.posed(pose), camera)


def splat_silhouette(points_world: Float[np.ndarray, "points 3"], camera: Camera) -> Silhouette:
    """The pixels that dense points of a surface in front of the camera cover.

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
    """x and y, px, and depth, metres, in single precision (errors of 0.01 px).

    Twice as fast as `Camera.project` where the lens has no distortion.
    """
    matrix = (camera.intrinsic @ camera.camera_from_world[:3]).astype(np.float32)
    projected = matrix[:, :3] @ points_world.T.astype(np.float32) + matrix[:, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        projected[:2] /= projected[2]
    if camera.distortion:
        before = projected[2] > NEAR_PLANE_M
        projected[:2, before] = camera.project(points_world[before].astype(np.float64)).T
    return projected


def soft_iou(body: Silhouette, alpha: AlphaMask) -> float:
    """Soft intersection over union of a silhouette and a mask, in [0, 1].

    The sum over the pixels of the smaller value over the sum of the larger.
    """
    both, either = float(alpha[body].sum()), float(alpha.sum() + body.sum())
    union = either - both
    return both / union if union > 0.0 else 0.0


def signed_distance_px(mask: Silhouette) -> AlphaMask:
    """Distance of each pixel's center from a shape's border, px; negative inside."""
    hard = mask.astype(np.uint8)
    outside = cv2.distanceTransform(1 - hard, cv2.DIST_L2, 5)
    inside = cv2.distanceTransform(hard, cv2.DIST_L2, 5)
    return np.asarray(outside - inside + np.where(mask, 0.5, -0.5), dtype=np.float32)
