"""Nodes that carry canonical points to the camera's frame, with the derivative."""

from dataclasses import dataclass

import numpy as np

from export.columns import MatrixValue, VectorValue, dot
from export.nodes import GraphValue
from export.scene import GraphContext


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedNodeValues:
    """The skin's nodes in the camera's frame: values of the graph, one entry a node."""

    camera_positions: VectorValue


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinningCell:
    """Where points lie among the skin's nodes: values of the graph, one entry a point.

    Attributes:
        rows: Rows of the four lower nodes along z of the cell about the point, in C order; the
            upper ones follow them.
        fraction: How far the point is between the nodes along x, y, z.
    """

    rows: list[GraphValue]
    fraction: VectorValue


def pose_nodes(scene: GraphContext) -> PosedNodeValues:
    """Linear blend skinning of every node, straight into the camera's frame."""
    graph, columns = scene.graph, scene.table_values
    blended = scene.camera.bones.transpose(1, 0).matmul(columns["node_weights"])
    positions = [columns[f"node_{letter}"] for letter in "xyz"]
    ones = positions[0] * 0.0 + 1.0
    homogeneous = graph.concatenate([p.reshape(1, -1) for p in [*positions, ones]])
    matrix = blended.reshape(3, 4, -1)
    return PosedNodeValues(camera_positions=graph.split((matrix * homogeneous).reduce_sum(1), 3))


def skinning_nodes_per_m(scene: GraphContext) -> list[float]:
    """Along x, y, z."""
    return [scene.settings.skinning_subdivision / float(step) for step in scene.tables.skinning.step_m]


def locate_skinning_cell(scene: GraphContext, canonical: VectorValue) -> SkinningCell:
    """Where canonical points lie among the nodes."""
    skin = scene.tables.skinning
    counts = [scene.settings.skinning_subdivision * (count - 1) + 1 for count in skin.index.shape]
    number, fraction = None, []
    for axis, (point, per_m) in enumerate(zip(canonical, skinning_nodes_per_m(scene), strict=True)):
        place = point * per_m - float(skin.low[axis]) * per_m
        place = place.clip(0.0, counts[axis] - 1 - 1e-3)
        below = place.cast(np.int32)
        fraction.append(place - below.cast(np.float32))
        number = below if number is None else number * counts[axis] + below
    assert number is not None
    steps = (0, counts[2], counts[1] * counts[2], (counts[1] + 1) * counts[2])
    table = scene.table_values["node"]
    return SkinningCell(rows=[table.gather(number + step) for step in steps], fraction=fraction)


def skin_points(scene: GraphContext, posed: PosedNodeValues, place: SkinningCell) -> tuple[VectorValue, MatrixValue]:
    """Where points are in the camera's frame, and how that changes with them.

    Trilinear between the eight nodes about each.

    Returns:
        The points, and the derivative's rows, metres a step between nodes.
    """
    rows = [row for lower in place.rows for row in (lower, lower + 1)]
    point, derivative = [], []
    for table in posed.camera_positions:
        value, slopes = _trilinear([table.gather(row) for row in rows], place.fraction)
        point.append(value)
        derivative.append(slopes)
    return point, derivative


def _trilinear(corners: list[GraphValue], fraction: VectorValue) -> tuple[GraphValue, VectorValue]:
    """The value between eight corners, and its slopes along x, y, z, per cell."""
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
    """The inverse of derivatives: values of the graph, one entry a point.

    Attributes:
        cofactors: Of the derivative per step between nodes.
        scale: For each row of the cofactors, what makes it the inverse's, per metre; 0 where the
            derivative cannot be inverted.
        trusted: Where it can: the skin is neither folded over nor torn apart.
    """

    cofactors: MatrixValue
    scale: VectorValue
    trusted: GraphValue

    def apply(self, vector: VectorValue) -> VectorValue:
        """The inverse times a vector."""
        return [
            dot(row, vector) * scale for row, scale in zip(self.cofactors, self.scale, strict=True)
        ]


def invert_jacobian(scene: GraphContext, jacobian: MatrixValue, cofactors: MatrixValue) -> InverseJacobian:
    """Inverts derivatives (metres a step between nodes), given their adjugates."""
    per_m = skinning_nodes_per_m(scene)
    volume = dot(jacobian[0], [row[0] for row in cofactors]) * float(np.prod(per_m))
    stretch = scene.settings.max_volume_ratio
    trusted = (volume > 1.0 / stretch) & (volume < stretch)
    one = scene.graph.where(trusted, volume, 1e30).reciprocal()
    scale = [one * float(np.prod(per_m) / step) for step in per_m]
    return InverseJacobian(cofactors=cofactors, scale=scale, trusted=trusted)
