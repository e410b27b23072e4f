"""Rig: joints, canonical pose, canonical box, and the volumes of skinning weights and distances."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, Int64
from scipy.ndimage import binary_fill_holes, distance_transform_edt, maximum_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import vertex_normals, visible_from_anywhere
from preprocess.body.kinematics import body_from_rest, world_from_body
from preprocess.body.parametric_body import BodyModel, ShapedBody

PART_OF_JOINT = np.array(
    [0, 1, 2, 0, 3, 4, 0, 5, 6, 0, 5, 6, 7, 0, 0, 7, 8, 9, 10, 11, 12, 13, 12, 13]
)
"""Body part, of 14, that each joint moves; root finding starts once in every near part."""
HEAD_PART = 7
"""The head among those parts."""
CLOTHING_BAND_M = 0.08
"""Distance from the skin within which clothes and hair lie, metres."""
BOX_MARGIN_M = 0.17
"""Margin of the canonical box about the skin, metres; clothes must fit into it."""
DISTANCE_CELL_M = 0.015
"""Cell size of the skin distance and the occupancy, metres."""


def canonical_rotations() -> Float[np.ndarray, "23 3"]:
    """The canonical A-pose: legs apart by 0.2 rad each, arms lowered by 0.8 rad.

    The paper's released configuration; the root stays at rest.
    """
    body_pose = np.zeros(69)
    body_pose[[2, 5, 47, 50]] = 0.2, -0.2, -0.8, 0.8
    return body_pose.reshape(23, 3)


class SparseSkinningNodes(NamedTuple):
    """Nodes of the skinning volume, by flat index, with their nonzero weights, packed.

    Joints and weights of the n-th node stand from `offsets[n]` to `offsets[n + 1]`.
    """

    node_indices: Int64[np.ndarray, "nodes"]
    offsets: Int64[np.ndarray, "nodes+1"]
    joints: Int32[np.ndarray, "moving"]
    weights: Float32[np.ndarray, "moving"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Rig:
    """Articulation of one person between the canonical and the body frame; immutable.

    Attributes:
        rest_joints: Joints in the rest pose, metres.
        parents: Parent of each joint, -1 for the root.
        canonical_rotations: Axis-angle rotations of joints 1 to 23 in the canonical pose.
        weights: Skinning weights at nodes `low + (i, j, k) / (count - 1) * (high - low)`.
        skin_distance: Distance from each occupancy cell's center to the body's skin, metres;
            `inside_skin` where that center lies under it.
        seeds: Canonical points of the skin at which root finding starts, metres; one per voxel of
            2 cm and body part.
        seed_normals: Outward unit normals of the skin at the seeds, canonical.
    """

    rest_joints: Float[np.ndarray, "24 3"]
    parents: Int[np.ndarray, "24"]
    canonical_rotations: Float[np.ndarray, "23 3"]
    box_low: Float32[np.ndarray, "3"]
    box_high: Float32[np.ndarray, "3"]
    weights: Float32[np.ndarray, "x y z 24"]
    skin_distance: Float32[np.ndarray, "cx cy cz"]
    inside_skin: Bool[np.ndarray, "cx cy cz"]
    seeds: Float32[np.ndarray, "seeds 3"]
    seed_parts: Int32[np.ndarray, "seeds"]
    seed_normals: Float32[np.ndarray, "seeds 3"]

    @classmethod
    def from_shaped_body(cls, shaped: ShapedBody, *, coarseness: float = 1.0) -> "Rig":
        """The rig of a shaped body; its pose blend shapes are ignored, as in the paper's code.

        Its cells are `coarseness` times as wide as those that are trained with.
        """
        rotations, body = canonical_rotations(), shaped.body
        transforms = body_from_rest(shaped.joints, body.parents, rotations)
        blended = np.einsum("vj,jab->vab", body.weights, transforms)
        vertices = np.einsum("vab,vb->va", blended[:, :3, :3], shaped.vertices) + blended[:, :3, 3]
        low = (vertices.min(axis=0) - BOX_MARGIN_M).astype(np.float32)
        high = (vertices.max(axis=0) + BOX_MARGIN_M).astype(np.float32)
        normals = vertex_normals(vertices, body.faces)
        outer = _outer_vertices(vertices, normals, body)
        vertices, normals, weights = vertices[outer], normals[outer], body.weights[outer]
        seeds = _seed_vertices(vertices, weights)
        distance, inside = skin_distance_volume(
            vertices, normals, low, high, coarseness * DISTANCE_CELL_M, BOX_MARGIN_M + 0.02
        )
        return cls(
            rest_joints=shaped.joints,
            parents=body.parents,
            canonical_rotations=rotations,
            box_low=low,
            box_high=high,
            weights=skinning_weight_volume(
                vertices, weights, low, high, coarseness * 0.023, BOX_MARGIN_M + 0.05
            ),
            skin_distance=distance,
            inside_skin=inside,
            seeds=vertices[seeds].astype(np.float32),
            seed_parts=PART_OF_JOINT[weights[seeds].argmax(axis=1)].astype(np.int32),
            seed_normals=normals[seeds].astype(np.float32),
        )

    @property
    def nodes_per_m(self) -> Float32[np.ndarray, "3"]:
        """Nodes of the skinning volume per metre along each axis."""
        nodes = np.array(self.weights.shape[:3], dtype=np.float32) - 1
        return nodes / (self.box_high - self.box_low)

    @property
    def cells_per_m(self) -> Float32[np.ndarray, "3"]:
        """Occupancy cells per metre along each axis."""
        cells = np.array(self.skin_distance.shape, dtype=np.float32)
        return cells / (self.box_high - self.box_low)

    def skinning_nodes_within(self, reach_m: float) -> SparseSkinningNodes:
        """Sparse weights of the nodes about all cells within a distance of the skin, metres."""
        if reach_m not in self._nodes_by_reach:
            shape, cells = np.array(self.weights.shape[:3]), np.array(self.skin_distance.shape)
            nearest = [
                np.minimum(np.linspace(0, cells[k], shape[k]).astype(int), cells[k] - 1)
                for k in range(3)
            ]
            near = maximum_filter(self.skin_distance[np.ix_(*nearest)] < reach_m, 3)
            nodes = np.flatnonzero(near)
            weights = self.weights.reshape(-1, 24)[nodes]
            moving = weights > 0.0
            first = np.concatenate([[0], moving.sum(axis=1).cumsum()])
            joints = moving.nonzero()[1].astype(np.int32)
            self._nodes_by_reach[reach_m] = SparseSkinningNodes(
                nodes, first, joints, weights[moving]
            )
        return self._nodes_by_reach[reach_m]

    @cached_property
    def _nodes_by_reach(self) -> dict[float, SparseSkinningNodes]:
        return {}

    @cached_property
    def clothing_cells(self) -> Int64[np.ndarray, "near"]:
        """Occupancy cells within the clothing band, by flat index."""
        return np.flatnonzero(self.skin_distance <= CLOTHING_BAND_M)

    @cached_property
    def seed_of_clothing_cell(self) -> Int64[np.ndarray, "near"]:
        """The seed nearest to the center of each of `clothing_cells`."""
        cells = np.stack(np.unravel_index(self.clothing_cells, self.skin_distance.shape), axis=1)
        tree = KDTree(self.seeds, leafsize=LEAF_VERTICES)
        centers = self.box_low + (cells + 0.5) / self.cells_per_m
        return np.asarray(tree.query(centers, workers=-1)[1])

    def body_from_canonical(
        self, joint_rotations: Float[np.ndarray, "23 3"]
    ) -> Float[np.ndarray, "24 4 4"]:
        """The matrices that linear blend skinning blends, from canonical to body frame."""
        posed = body_from_rest(self.rest_joints, self.parents, joint_rotations)
        return posed @ self._rest_from_canonical

    @cached_property
    def _rest_from_canonical(self) -> Float[np.ndarray, "24 4 4"]:
        canonical = body_from_rest(self.rest_joints, self.parents, self.canonical_rotations)
        return np.linalg.inv(canonical)

    def world_from_body(self, pose: BodyPose) -> Float[np.ndarray, "4 4"]:
        """The root's rigid motion."""
        return world_from_body(self.rest_joints[0], pose.root_rotation, pose.root_translation)

    def weights_at(self, points: Float[np.ndarray, "points 3"]) -> Float32[np.ndarray, "points 24"]:
        """Trilinear skinning weights at canonical points; the border's value outside the box."""
        last = np.array(self.weights.shape[:3]) - 1
        place = (points - self.box_low) / (self.box_high - self.box_low) * last
        place = np.clip(place, 0.0, last)
        base = np.minimum(place.astype(np.int64), last - 1)
        part = (place - base).astype(np.float32)
        weights = np.zeros((len(points), 24), dtype=np.float32)
        for corner in np.ndindex(2, 2, 2):  # all 24 weights of a node lie side by side
            share = np.where(corner, part, 1.0 - part).prod(axis=1, keepdims=True)
            weights += self.weights[tuple((base + corner).T)] * share
        return weights


def _outer_vertices(
    vertices: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    body: BodyModel,
) -> Int[np.ndarray, "outer"]:
    """Vertices without a head's eyeballs, tongue and mouth: what is behind them is not outside.

    Of a head's vertices, these are the largest connected part of those that are seen from afar.
    """
    head = np.flatnonzero(PART_OF_JOINT[body.weights.argmax(axis=1)] == HEAD_PART)
    shown = visible_from_anywhere(
        vertices[head], normals[head], cell_m=DISTANCE_CELL_M, tolerance_m=0.002, min_cosine=0.6
    )
    is_shown = np.zeros(len(vertices), dtype=bool)
    is_shown[head[shown]] = True
    faces = body.faces[is_shown[body.faces].all(axis=1)]
    links = faces.ravel(), np.roll(faces, 1, axis=1).ravel()
    shape = (len(vertices), len(vertices))
    _, part = connected_components(coo_array((np.ones(faces.size), links), shape=shape))
    sizes = np.bincount(part, weights=is_shown)
    return np.delete(np.arange(len(vertices)), head[part[head] != sizes.argmax()])


def _seed_vertices(
    vertices: Float[np.ndarray, "vertices 3"], weights: Float[np.ndarray, "vertices 24"]
) -> Int[np.ndarray, "seeds"]:
    """Vertices to start from: the first of each 2-cm voxel and body part."""
    voxels = np.floor(vertices / 0.02).astype(np.int64)
    keys = np.column_stack([voxels, PART_OF_JOINT[weights.argmax(axis=1)]])
    return np.unique(keys, axis=0, return_index=True)[1]


BLENDED_VERTICES = 10
"""Vertices whose weights are blended at each node; 1 is the paper's variant."""
MIN_VERTEX_DISTANCE_M = 2e-3
"""Smallest vertex distance in the blend, metres, so that one vertex cannot dominate a node."""
SEARCHED_WITHIN_M = 0.12
"""Distance from the skin within which each cell's own distance is searched, metres."""
LEAF_VERTICES = 32
"""Vertices in a leaf of their tree; 10 take 1.7 times as long."""


def volume_shape(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], cell_m: float
) -> tuple[int, int, int]:
    """Number of cells of about `cell_m` metres that a box needs along each axis."""
    x, y, z = np.ceil((high - low) / cell_m).astype(int)
    return int(x), int(y), int(z)


def skinning_weight_volume(
    vertices: Float[np.ndarray, "vertices 3"],
    vertex_weights: Float[np.ndarray, "vertices 24"],
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    cell_m: float,
    reach_m: float,
) -> Float32[np.ndarray, "x y z 24"]:
    """Skinning weights on the nodes of a grid, corner to corner of the box [low, high].

    Fast-SNARF (Chen et al. 2022) reads weights from voxels; InstantAvatar takes those of the
    nearest vertex. Blending the 10 nearest by inverse squared distance, smoothed far off, keeps
    the warp invertible near creases. More of either pulls clothes off the body that they move
    with: 30 neighbors and smoothing everywhere cost 0.65 dB in poses never filmed.

    Nodes farther than `reach_m` from every canonical vertex all take the root's weight: nothing is
    rendered there, but the values must be finite.
    """
    shape = tuple(n + 1 for n in volume_shape(low, high, cell_m))
    axes = [np.linspace(low[k], high[k], shape[k]) for k in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    spacing = (high - low) / (np.array(shape) - 1.0)
    is_free = np.ones(shape, dtype=bool)
    places = np.round((vertices - low) / spacing).astype(int).clip(0, np.array(shape) - 1)
    is_free[tuple(places.T)] = False
    roughly_m = np.asarray(distance_transform_edt(is_free, sampling=spacing.tolist()))
    near = np.flatnonzero(roughly_m < reach_m + 0.51 * np.linalg.norm(spacing))

    tree = KDTree(vertices, leafsize=LEAF_VERTICES)
    far = np.ones(len(nodes), dtype=bool)
    weights = np.zeros((len(nodes), 24), dtype=np.float32)
    weights[:, 0] = 1.0
    of_vertex = vertex_weights.astype(np.float32)
    for chunk in np.array_split(near, max(1, len(near) // 8192)):
        distance_m, index = tree.query(nodes[chunk], k=BLENDED_VERTICES, workers=-1)
        # clothes hang nearer than 3 cm
        within, far[chunk] = distance_m[:, 0] < reach_m, distance_m[:, 0] > 0.03
        share = 1.0 / np.maximum(distance_m[within], MIN_VERTEX_DISTANCE_M) ** 2
        share /= share.sum(axis=1, keepdims=True)
        mixed = share[:, None].astype(np.float32) @ of_vertex[np.asarray(index)[within]]
        weights[chunk[within]] = mixed[:, 0]
    return _smooth_far_weights(weights.reshape(*shape, 24), far.reshape(*shape, 1))


def _smooth_far_weights(
    weights: Float32[np.ndarray, "x y z 24"], far: Bool[np.ndarray, "x y z 1"]
) -> Float32[np.ndarray, "x y z 24"]:
    mean = np.empty_like(weights)  # new memory costs more than the sums
    rows = mean.reshape(len(mean), -1)
    for _ in range(2):
        for part, smoothed in zip(weights, mean, strict=True):
            cv2.blur(part, (3, 3), dst=smoothed, borderType=cv2.BORDER_REFLECT)
        cv2.blur(rows, (1, 3), dst=rows, borderType=cv2.BORDER_REFLECT)
        np.copyto(weights, mean, where=far)
    weights[weights < 1e-4] = 0.0
    weights /= weights.sum(axis=-1, keepdims=True)
    return weights


def skin_distance_volume(
    vertices: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    low: Float[np.ndarray, "3"],
    high: Float[np.ndarray, "3"],
    cell_m: float,
    reach_m: float,
) -> tuple[Float32[np.ndarray, "x y z"], Bool[np.ndarray, "x y z"]]:
    """Distance of each cell's center from the skin, metres, and whether it lies under it.

    The distance is to the nearest vertex, unsigned, and interpolated between every second cell
    beyond `SEARCHED_WITHIN_M`; cells farther than `reach_m` count as 1 m away. Which side of that
    vertex a center is on is right wherever it is farther off than vertices are from each other;
    holes that are left inside are filled.
    """
    shape = volume_shape(low, high, cell_m)
    size = (high - low) / shape
    axes = [low[k] + (np.arange(shape[k]) + 0.5) * size[k] for k in range(3)]
    tree = KDTree(vertices, leafsize=LEAF_VERTICES)
    searched_m = reach_m + 4.0 * float(size.max())  # no cell within reach borders on one beyond

    def search(points: Float[np.ndarray, "points 3"]) -> Float32[np.ndarray, "points 2"]:
        """Distance, and 1 under the skin."""
        distance_m, nearest = tree.query(points, distance_upper_bound=searched_m, workers=-1)
        near = np.flatnonzero(np.isfinite(distance_m))
        closest = np.asarray(nearest)[near]
        values = np.stack([np.minimum(distance_m, searched_m), np.zeros(len(points))], axis=1)
        away = points[near] - vertices[closest]
        values[near, 1] = np.einsum("ca,ca->c", away, normals[closest]) < 0.0
        return values.astype(np.float32)

    distance_m, under = np.moveaxis(_exact_near_skin(axes, search, SEARCHED_WITHIN_M), -1, 0)
    within = distance_m < reach_m
    inside = np.asarray(binary_fill_holes(within & (under > 0.5)))
    return np.where(within, distance_m, np.float32(1.0)), inside


def _exact_near_skin(
    axes: list[Float[np.ndarray, "nodes"]],
    evaluate: Callable[[Float[np.ndarray, "points 3"]], Float32[np.ndarray, "points values"]],
    within_m: float,
) -> Float32[np.ndarray, "x y z values"]:
    """Evaluate a function of canonical points on a grid, and interpolate it far from the skin.

    Its first value is the distance from the skin, metres. It is evaluated on every second node
    along each axis, and on all nodes that are nearer to the skin than `within_m`.
    """
    coarse = [np.append(axis[:-1:2], axis[-1]) for axis in axes]
    points = np.stack(np.meshgrid(*coarse, indexing="ij"), axis=-1)
    values = evaluate(points.reshape(-1, 3)).reshape(*points.shape[:3], -1)
    for k in range(3):
        hats = [np.interp(axes[k], coarse[k], hat) for hat in np.eye(len(coarse[k]))]
        matrix = np.stack(hats, axis=1).astype(np.float32)
        values = np.moveaxis(np.tensordot(matrix, values, (1, k)), 0, k)
    values = np.ascontiguousarray(values)
    near = values[..., 0] < within_m
    places = near.nonzero()
    values[near] = evaluate(np.stack([axes[k][places[k]] for k in range(3)], axis=1))
    return values
