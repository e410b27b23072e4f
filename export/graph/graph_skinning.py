"""Skinning in the graph: vectors and matrices as columns, posed nodes and surfels, Jacobians."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from export.graph.onnx_builder import GraphBuilder, GraphValue
from export.package.player_tables import PlayerTables, RenderSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraValues:
    """Inputs for a picture's pose and camera: values of the graph.

    Attributes:
        bones: Camera-from-canonical 3×4 matrices, one row of 12 a joint.
        focal, center: (x, y) in pixels.
        height, width: Scalars, int64.
    """

    bones: GraphValue
    focal: tuple[GraphValue, GraphValue]
    center: tuple[GraphValue, GraphValue]
    height: GraphValue
    width: GraphValue


@dataclass(frozen=True, eq=False, kw_only=True)
class GraphContext:
    """A graph being built, its tables and its inputs.

    Attributes:
        tables: Their sizes and scales become constants.
        table_values: Values of `export.player_inputs.graph_initializers`, by name.
        samples: Density samples along `RenderSettings.sample_span_m`, int64 scalar.
        traces: Whether the graph tells where rays sample the bricks, instead of a picture.
    """

    graph: GraphBuilder
    tables: PlayerTables
    table_values: dict[str, GraphValue]
    settings: RenderSettings
    camera: CameraValues
    samples: GraphValue
    traces: bool = False


# Vectors are values of three rows, x, y and z, and a column a point.
NEXT, AFTER_NEXT = (1, 2, 0), (2, 0, 1)
"""Axes that follow x, y and z, and those that follow these."""


def dot(a: GraphValue, b: GraphValue) -> GraphValue:
    """Return dot products of vectors."""
    return (a * b).weighted_sum(np.ones(3))


def cross(a: GraphValue, b: GraphValue) -> GraphValue:
    """Return cross products of vectors."""
    return a.take(NEXT) * b.take(AFTER_NEXT) - a.take(AFTER_NEXT) * b.take(NEXT)


def vector_table(context: GraphContext, name: str, places: GraphValue) -> GraphValue:
    """Return some rows of a table of vectors."""
    columns = [context.table_values[f"{name}_{letter}"] for letter in "xyz"]
    return context.graph.stack([values.gather(places) for values in columns])


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinningCell:
    """Cells of the skinning grid about points: values of the graph, one entry a point.

    Attributes:
        rows: Rows of the four lower nodes along z of the cell about the point, in C order; the
            upper ones follow them.
        fraction: Position of the point in its cell along x, y, z, from 0 to 1.
    """

    rows: list[GraphValue]
    fraction: list[GraphValue]


def pose_nodes(context: GraphContext) -> GraphValue:
    """Return the positions of skinning nodes in the camera's frame (3 × nodes)."""
    graph, columns = context.graph, context.table_values
    blended = context.camera.bones.transpose(1, 0).matmul(columns["node_weights"])
    positions = [columns[f"node_{letter}"] for letter in "xyz"]
    ones = positions[0] * 0.0 + 1.0
    homogeneous = graph.concatenate([p.reshape(1, -1) for p in [*positions, ones]])
    matrix = blended.reshape(3, 4, -1)
    return (matrix * homogeneous).reduce_sum(1)


def skinning_nodes_per_m(context: GraphContext) -> np.ndarray:
    """Return the number of nodes per metre along x, y, z."""
    return context.settings.skinning_subdivision / context.tables.skinning.step_m.astype(float)


def column(numbers: np.ndarray | Sequence[float]) -> np.ndarray:
    """Return the numbers as a column: one a row of a value."""
    return np.reshape(numbers, (-1, 1))


def locate_skinning_cell(context: GraphContext, canonical: GraphValue) -> SkinningCell:
    """Find the cells about canonical points."""
    skin, per_m = context.tables.skinning, skinning_nodes_per_m(context)
    counts = context.settings.skinning_subdivision * (np.array(skin.index.shape) - 1) + 1
    place = canonical * column(per_m) - column(skin.low * per_m)
    place = place.maximum(0.0).minimum(column(counts - 1 - 1e-3))
    below = place.floor()
    strides = np.array([counts[1] * counts[2], counts[2], 1])
    assert np.prod(counts) < 1 << 24  # integers below are exact as float32
    number = below.weighted_sum(strides).cast(np.int32)
    steps = (0, strides[1], strides[0], strides[0] + strides[1])
    table, fraction = context.table_values["node"], place - below
    return SkinningCell(
        rows=[table.gather(number + step) for step in steps],
        fraction=[fraction.row(axis) for axis in range(3)],
    )


def skin_points(
    context: GraphContext, posed: GraphValue, place: SkinningCell
) -> tuple[GraphValue, list[GraphValue]]:
    """Interpolate trilinearly between posed nodes.

    Returns:
        Positions in the camera's frame (3 × points), and their derivatives, metres per step
        between nodes along each axis of the grid (3 × points each).
    """
    graph, (x, y, z) = context.graph, place.fraction
    low, along_y, along_x, along_both = place.rows
    lower = graph.concatenate([low, along_x, along_y, along_both])
    nodes = graph.concatenate([lower, lower + 1])
    corners = posed.gather_columns(nodes.repeat_rows(3))  # the halves along z, then y, then x
    y_twice = graph.concatenate([y, y])
    on_z, along_z = _lerp_halves(corners, graph.concatenate([z, z, z, z]))
    on_y, along_y = _lerp_halves(on_z, y_twice)
    z_on_y, _ = _lerp_halves(along_z, y_twice)
    position, along_x = _lerp_halves(on_y, x)
    slopes = [_lerp_halves(halves, x)[0] for halves in (along_y, z_on_y)]
    return position, [along_x, *slopes]


def _lerp_halves(halves: GraphValue, share: GraphValue) -> tuple[GraphValue, GraphValue]:
    """Interpolate from the first half of the columns to the second; return the slope, too."""
    low, high = halves.graph.halve_columns(halves, halves.graph.size(share))
    slope = high - low
    return low + share * slope, slope


@dataclass(frozen=True, eq=False, kw_only=True)
class InverseJacobian:
    """Inverse Jacobians of skinning: values of the graph, one column a point.

    Attributes:
        cofactors: Rows of the Jacobian's adjugate, per step between nodes (3 × points each).
        scale: Factor from each row of the adjugate to the inverse's, per metre; almost 0 where the
            Jacobian is not inverted (3 × points).
        trusted: Whether it is inverted: the skin is neither folded nor torn apart.
    """

    cofactors: list[GraphValue]
    scale: GraphValue
    trusted: GraphValue

    def apply(self, vector: GraphValue) -> GraphValue:
        """Multiply vectors by the inverse."""
        products = [dot(row, vector) for row in self.cofactors]
        return self.scale.graph.stack(products) * self.scale


def invert_jacobian(context: GraphContext, derivative: list[GraphValue]) -> InverseJacobian:
    """Invert derivatives of `skin_points`."""
    turned = [(each.take(NEXT), each.take(AFTER_NEXT)) for each in derivative]
    cofactors = []
    for i, j in zip(NEXT, AFTER_NEXT, strict=True):
        (a, b), (c, d) = turned[i], turned[j]
        cofactors.append(a * d - b * c)
    per_m = skinning_nodes_per_m(context)
    volume = dot(derivative[0], cofactors[0]) * float(np.prod(per_m))
    stretch = context.settings.max_volume_ratio
    trusted = (volume > 1.0 / stretch) & (volume < stretch)
    one = context.graph.where(trusted, volume, 1e30).reciprocal()
    scale = one * column(np.prod(per_m) / per_m)
    return InverseJacobian(cofactors=cofactors, scale=scale, trusted=trusted)


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedSurfels:
    """Surfels of the proxy surface: values of the graph, one entry a surfel.

    Attributes:
        cell: Their cells, the same in all poses.
        rows: Rows of the four nodes of each surfel's tetrahedron, the same in all poses.
        camera_positions: Positions in the camera's frame along x, y, z, linear in tetrahedra.
    """

    cell: SkinningCell
    rows: list[GraphValue]
    camera_positions: list[GraphValue]


def pose_surfels(context: GraphContext, posed: GraphValue) -> PosedSurfels:
    """Pose surfels as weighted sums of four nodes each, as most of them are never seen."""
    columns = context.table_values
    cell = SkinningCell(
        rows=[columns[f"cell_{i}"] for i in range(4)],
        fraction=[columns[f"fraction_{letter}"] for letter in "xyz"],
    )
    rows = [cell.rows[0], *(columns[f"tetrahedron_{i}"] for i in (1, 2, 3))]
    shares = [columns[f"share_{i}"] for i in range(4)]
    camera = []
    for axis in range(3):
        table = posed.row(axis)
        parts = [table.gather(row) * share for row, share in zip(rows, shares, strict=True)]
        camera.append(parts[0] + parts[1] + parts[2] + parts[3])
    return PosedSurfels(cell=cell, rows=rows, camera_positions=camera)


def faces_camera(
    context: GraphContext, posed: GraphValue, surfels: PosedSurfels, number: GraphValue
) -> GraphValue:
    """Tell which surfels face the camera: n · J⁻¹ c < 0, J the Jacobian in the tetrahedron.

    J's columns are the edges between the four nodes, so J⁻¹ consists of their cross products.
    """
    graph = context.graph
    corners = [posed.gather_columns(row.gather(number).repeat_rows(3)) for row in surfels.rows]
    edges = [b - a for a, b in pairwise(corners)]
    across = [cross(edges[1], edges[2]), cross(edges[2], edges[0]), cross(edges[0], edges[1])]
    volume = dot(edges[0], across[0])
    camera = graph.stack([each.gather(number) for each in surfels.camera_positions])
    normal = [context.table_values[f"edge_normal_{i}"].gather(number) for i in range(3)]
    parts = [n * dot(vector, camera) for n, vector in zip(normal, across, strict=True)]
    facing = parts[0] + parts[1] + parts[2]
    # the edges may be left- or right-handed, so the volume may have either sign
    least = -context.settings.min_facing_cosine
    return facing * volume < camera.row(2) * volume * volume * least
