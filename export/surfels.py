"""Nodes that carry the hull's surfels into the camera's frame, cheaply: most are never seen."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from export.columns import VectorValue, cross, dot, gather_vector
from export.nodes import GraphValue
from export.posing import SkinningCell, PosedNodeValues, skinning_nodes_per_m, locate_skinning_cell
from export.scene import GraphContext


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedSurfels:
    """The hull: values of the graph, one entry a surfel.

    Attributes:
        place: Where they lie among the skin's nodes, the same in all poses.
        rows: Of the four nodes about each, and
        normal: its normal per step along the edges between these, also the same in all poses.
        camera: Positions in the camera's frame, linear in tetrahedra.
        folded: Whether the posed tetrahedron has less than `fold_volume_ratio` of its canonical volume;
            inside out counts as negative.
    """

    cell: SkinningCell
    rows: list[GraphValue]
    normal: VectorValue
    camera_positions: VectorValue
    folded: GraphValue


def pose_surfels(scene: GraphContext, posed: PosedNodeValues) -> PosedSurfels:
    """Positions as sums over four nodes each.

    All but the nodes' posed places is the same in every pose: onnxruntime computes it once.
    """
    columns = scene.table_values
    place = locate_skinning_cell(scene, [columns[f"position_{letter}"] for letter in "xyz"])
    rows, shares, normal, handed = _surfel_tetrahedra(scene, place)
    corners = [gather_vector(posed.camera_positions, row) for row in rows]
    camera = []
    for axis in range(3):
        parts = [corner[axis] * share for corner, share in zip(corners, shares, strict=True)]
        camera.append(parts[0] + parts[1] + parts[2] + parts[3])
    edges = _tetrahedron_edges(corners)
    volume = dot(edges[0], cross(edges[1], edges[2])) * handed
    least = scene.settings.fold_volume_ratio / float(np.prod(skinning_nodes_per_m(scene)))
    return PosedSurfels(cell=place, rows=rows, normal=normal, camera_positions=camera, folded=volume < least)


def _tetrahedron_edges(corners: Sequence[VectorValue]) -> list[VectorValue]:
    """The three edges from each corner to the next."""
    return [[b - a for a, b in zip(*pair, strict=True)] for pair in pairwise(corners)]


def faces_camera(scene: GraphContext, posed: PosedNodeValues, surfels: PosedSurfels, number: GraphValue) -> GraphValue:
    """Which of some surfels face the camera: n · J⁻¹ c, J the derivative in the tetrahedron.

    J's columns are the edges between the four nodes, so J⁻¹ is made of their cross products.
    """
    rules, rows = scene.settings, gather_vector(surfels.rows, number)
    edges = _tetrahedron_edges([gather_vector(posed.camera_positions, row) for row in rows])
    across = [cross(edges[(k + 1) % 3], edges[(k + 2) % 3]) for k in range(3)]
    volume = dot(edges[0], across[0])
    camera = gather_vector(surfels.camera_positions, number)
    facing = dot(gather_vector(surfels.normal, number), [dot(vector, camera) for vector in across])
    # the way along the edges turns left or right, so the volume may have either sign
    return facing * volume < camera[2] * volume * volume * -rules.min_facing_cosine


def _surfel_tetrahedra(scene: GraphContext, place: SkinningCell) -> tuple[list[GraphValue], list[GraphValue], VectorValue, GraphValue]:
    """Rows of four nodes, their shares in a surfel's position, and its normal along their edges.

    The last value is 1 where these edges are right-handed in canonical space, and -1 elsewhere.

    The way from the lower to the upper corner of a cell takes the axis of the largest fraction
    first (as `lookup.Cell`).
    """
    graph, (x, y, z) = scene.graph, place.fraction
    low, along_y, along_x, along_both = place.rows
    x_over_y, x_over_z, y_over_z = x > y, x > z, y > z
    first = graph.where(
        x_over_y, graph.where(x_over_z, along_x, low + 1), graph.where(y_over_z, along_y, low + 1)
    )
    second = graph.where(
        x_over_y,
        graph.where(y_over_z, along_both, along_x + 1),
        graph.where(x_over_z, along_both, along_y + 1),
    )
    largest, smallest = x.maximum(y, z), x.minimum(y, z)
    middle = (x + y + z) - largest - smallest
    shares = [1.0 - largest, largest - middle, middle - smallest, smallest]
    nx, ny, nz = (
        scene.table_values[f"normal_{letter}"] * (1.0 / per_m)
        for letter, per_m in zip("xyz", skinning_nodes_per_m(scene), strict=True)
    )
    one = graph.where(x_over_y, graph.where(x_over_z, nx, nz), graph.where(y_over_z, ny, nz))
    three = graph.where(x_over_y, graph.where(y_over_z, nz, ny), graph.where(x_over_z, nz, nx))
    normal = [one, (nx + ny + nz) - one - three, three]
    right, left = (graph.constant(np.float32(sign)) for sign in (1.0, -1.0))
    handed = graph.where(
        x_over_y,
        graph.where(x_over_z, graph.where(y_over_z, right, left), right),
        graph.where(y_over_z, graph.where(x_over_z, left, right), left),
    )
    return [low, first, second, along_both + 1], shares, normal, handed
