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
    """

    graph: GraphBuilder
    tables: PlayerTables
    table_values: dict[str, GraphValue]
    settings: RenderSettings
    camera: CameraValues
    samples: GraphValue


VectorValue = list[GraphValue]
"""Three values: x, y, z of many vectors."""
MatrixValue = list[list[GraphValue]]
"""Rows of values: the entries of many matrices."""


def dot(a: Sequence[GraphValue], b: Sequence[GraphValue]) -> GraphValue:
    """Return dot products."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: VectorValue, b: VectorValue) -> VectorValue:
    """Return cross products."""
    return [a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3] for k in range(3)]


def adjugate(matrix: MatrixValue) -> MatrixValue:
    """Return the inverses of 3×3 matrices times their determinants."""
    rows: MatrixValue = []
    for i in range(3):
        row = []
        for j in range(3):
            a, b, c, d = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            row.append(matrix[a][c] * matrix[b][d] - matrix[a][d] * matrix[b][c])
        rows.append(row)
    return rows


def gather_vector(vector: Sequence[GraphValue], places: GraphValue) -> VectorValue:
    """Return `[component[places] for component in vector]`."""
    return [component.gather(places) for component in vector]


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinningCell:
    """Cells of the skinning grid about points: values of the graph, one entry a point.

    Attributes:
        rows: Rows of the four lower nodes along z of the cell about the point, in C order; the
            upper ones follow them.
        fraction: Position of the point in its cell along x, y, z, from 0 to 1.
    """

    rows: list[GraphValue]
    fraction: VectorValue


def pose_nodes(context: GraphContext) -> VectorValue:
    """Return the positions of skinning nodes in the camera's frame, one entry a node."""
    graph, columns = context.graph, context.table_values
    blended = context.camera.bones.transpose(1, 0).matmul(columns["node_weights"])
    positions = [columns[f"node_{letter}"] for letter in "xyz"]
    ones = positions[0] * 0.0 + 1.0
    homogeneous = graph.concatenate([p.reshape(1, -1) for p in [*positions, ones]])
    matrix = blended.reshape(3, 4, -1)
    return graph.split((matrix * homogeneous).reduce_sum(1), 3)


def skinning_nodes_per_m(context: GraphContext) -> list[float]:
    """Return the number of nodes per metre along x, y, z."""
    return [
        context.settings.skinning_subdivision / float(step)
        for step in context.tables.skinning.step_m
    ]


def locate_skinning_cell(context: GraphContext, canonical: VectorValue) -> SkinningCell:
    """Find the cells about canonical points."""
    skin = context.tables.skinning
    counts = [context.settings.skinning_subdivision * (count - 1) + 1 for count in skin.index.shape]
    number, fraction = None, []
    for axis, (point, per_m) in enumerate(
        zip(canonical, skinning_nodes_per_m(context), strict=True)
    ):
        place = point * per_m - float(skin.low[axis]) * per_m
        place = place.clip(0.0, counts[axis] - 1 - 1e-3)
        below = place.cast(np.int32)
        fraction.append(place - below.cast(np.float32))
        number = below if number is None else number * counts[axis] + below
    assert number is not None
    steps = (0, counts[2], counts[1] * counts[2], (counts[1] + 1) * counts[2])
    table = context.table_values["node"]
    return SkinningCell(rows=[table.gather(number + step) for step in steps], fraction=fraction)


def skin_points(
    context: GraphContext, posed: VectorValue, place: SkinningCell
) -> tuple[VectorValue, MatrixValue]:
    """Return trilinear positions in the camera's frame, and Jacobian rows, metres per node step."""
    rows = [row for lower in place.rows for row in (lower, lower + 1)]
    point, derivative = [], []
    for table in posed:
        value, slopes = _trilinear([table.gather(row) for row in rows], place.fraction)
        point.append(value)
        derivative.append(slopes)
    return point, derivative


def _trilinear(corners: list[GraphValue], fraction: VectorValue) -> tuple[GraphValue, VectorValue]:
    """Interpolate between eight corners; return the value and its slopes along x, y, z per cell."""
    x, y, z = fraction
    along_z = [corners[i + 1] - corners[i] for i in range(0, 8, 2)]
    on_z = [corners[2 * i] + z * slope for i, slope in enumerate(along_z)]
    along_y = [on_z[i + 1] - on_z[i] for i in (0, 2)]
    on_y = [on_z[2 * i] + y * slope for i, slope in enumerate(along_y)]
    z_on_y = [_lerp(along_z[i], along_z[i + 1], y) for i in (0, 2)]
    along_x = on_y[1] - on_y[0]
    slopes = [
        along_x,
        _lerp(along_y[0], along_y[1], x),
        _lerp(z_on_y[0], z_on_y[1], x),
    ]
    return on_y[0] + x * along_x, slopes


def _lerp(low: GraphValue, high: GraphValue, share: GraphValue) -> GraphValue:
    return low + share * (high - low)


@dataclass(frozen=True, eq=False, kw_only=True)
class InverseJacobian:
    """Inverse Jacobians of skinning: values of the graph, one entry a point.

    Attributes:
        cofactors: Adjugate of the Jacobian per step between nodes.
        scale: Factor from each row of the adjugate to the inverse's, per metre; almost 0 where the
            Jacobian is not inverted.
        ray: Canonical metres per metre along each point's ray.
        trusted: Whether it is inverted: the skin is neither folded nor torn apart.
    """

    cofactors: MatrixValue
    scale: VectorValue
    ray: VectorValue
    trusted: GraphValue

    def apply(self, vector: VectorValue) -> VectorValue:
        """Multiply vectors by the inverse."""
        return _apply_inverse(self.cofactors, self.scale, vector)


def _apply_inverse(cofactors: MatrixValue, scale: VectorValue, vector: VectorValue) -> VectorValue:
    return [dot(row, vector) * factor for row, factor in zip(cofactors, scale, strict=True)]


def invert_jacobian(
    context: GraphContext, jacobian: MatrixValue, ray: VectorValue
) -> InverseJacobian:
    """Invert Jacobians (metres per step between nodes); apply them to unit directions of rays."""
    cofactors = adjugate(jacobian)
    per_m = skinning_nodes_per_m(context)
    volume = dot(jacobian[0], [row[0] for row in cofactors]) * float(np.prod(per_m))
    stretch = context.settings.max_volume_ratio
    trusted = (volume > 1.0 / stretch) & (volume < stretch)
    one = context.graph.where(trusted, volume, 1e30).reciprocal()
    scale = [one * float(np.prod(per_m) / step) for step in per_m]
    direction = _apply_inverse(cofactors, scale, ray)
    return InverseJacobian(cofactors=cofactors, scale=scale, ray=direction, trusted=trusted)


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedSurfels:
    """Surfels of the proxy surface: values of the graph, one entry a surfel.

    Attributes:
        rows: Rows of the four nodes of each surfel's tetrahedron, the same in all poses.
        normal: Normals per step along the edges of these, the same in all poses.
        camera_positions: Positions in the camera's frame, linear in tetrahedra.
    """

    cell: SkinningCell
    rows: list[GraphValue]
    normal: VectorValue
    camera_positions: VectorValue


def pose_surfels(context: GraphContext, posed: VectorValue) -> PosedSurfels:
    """Pose surfels as weighted sums of four nodes each, as most of them are never seen.

    All but the nodes' posed positions is constant: onnxruntime computes it once.
    """
    columns = context.table_values
    place = locate_skinning_cell(context, [columns[f"position_{letter}"] for letter in "xyz"])
    rows, shares, normal = _surfel_tetrahedra(context, place)
    corners = [gather_vector(posed, row) for row in rows]
    camera = []
    for axis in range(3):
        parts = [corner[axis] * share for corner, share in zip(corners, shares, strict=True)]
        camera.append(parts[0] + parts[1] + parts[2] + parts[3])
    return PosedSurfels(cell=place, rows=rows, normal=normal, camera_positions=camera)


def _tetrahedron_edges(corners: Sequence[VectorValue]) -> list[VectorValue]:
    """Return the three edges from each corner to the next."""
    return [[b - a for a, b in zip(*pair, strict=True)] for pair in pairwise(corners)]


def faces_camera(
    context: GraphContext, posed: VectorValue, surfels: PosedSurfels, number: GraphValue
) -> GraphValue:
    """Tell which surfels face the camera: n · J⁻¹ c < 0, J the Jacobian in the tetrahedron.

    J's columns are the edges between the four nodes, so J⁻¹ consists of their cross products.
    """
    settings, rows = context.settings, gather_vector(surfels.rows, number)
    edges = _tetrahedron_edges([gather_vector(posed, row) for row in rows])
    across = [cross(edges[(k + 1) % 3], edges[(k + 2) % 3]) for k in range(3)]
    volume = dot(edges[0], across[0])
    camera = gather_vector(surfels.camera_positions, number)
    facing = dot(gather_vector(surfels.normal, number), [dot(vector, camera) for vector in across])
    # the edges may be left- or right-handed, so the volume may have either sign
    return facing * volume < camera[2] * volume * volume * -settings.min_facing_cosine


def _surfel_tetrahedra(
    context: GraphContext, place: SkinningCell
) -> tuple[list[GraphValue], list[GraphValue], VectorValue]:
    """Return rows of the four nodes about surfels, their weights, and the normal along their edges.

    Tetrahedra are walked as in `BrickTetrahedra`.
    """
    graph, (x, y, z) = context.graph, place.fraction
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
        context.table_values[f"normal_{letter}"] * (1.0 / per_m)
        for letter, per_m in zip("xyz", skinning_nodes_per_m(context), strict=True)
    )
    one = graph.where(x_over_y, graph.where(x_over_z, nx, nz), graph.where(y_over_z, ny, nz))
    three = graph.where(x_over_y, graph.where(y_over_z, nz, ny), graph.where(x_over_z, nz, nx))
    normal = [one, (nx + ny + nz) - one - three, three]
    return [low, first, second, along_both + 1], shares, normal
