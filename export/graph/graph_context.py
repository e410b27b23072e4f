"""What every part of the player's graph looks at: inputs, tables and settings.

Vectors and matrices whose components are tensors of their own (no batched small products).
"""

from collections.abc import Sequence
from dataclasses import dataclass

from export.graph.onnx_builder import GraphBuilder, GraphValue
from export.package.player_tables import PlayerTables
from export.package.render_settings import RenderSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraValues:
    """Where a picture is taken from: values of the graph.

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

    @property
    def num_pixels(self) -> GraphValue:
        """How many there are, int64 scalar."""
        return self.height * self.width


@dataclass(frozen=True, eq=False, kw_only=True)
class GraphContext:
    """A graph being written, and what it draws.

    Attributes:
        graph: The graph.
        tables: What is drawn, for the sizes and scales that become constants.
        columns: The tables' contents as values of the graph (`export.package.player_tables.initialisers`).
        settings: How it is drawn.
        view: From where.
        samples: Along each ray and layer, int64 scalar.
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
    """Dot product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: VectorValue, b: VectorValue) -> VectorValue:
    """Cross product."""
    return [a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3] for k in range(3)]


def adjugate(matrix: MatrixValue) -> MatrixValue:
    """The inverse of 3×3 matrices times their determinant."""
    rows: MatrixValue = []
    for i in range(3):
        row = []
        for j in range(3):
            a, b, c, d = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            row.append(matrix[a][c] * matrix[b][d] - matrix[a][d] * matrix[b][c])
        rows.append(row)
    return rows


def gather_vector(vector: Sequence[GraphValue], places: GraphValue) -> VectorValue:
    """`[component[places] for component in vector]`."""
    return [component.gather(places) for component in vector]
