"""What all parts of the player's graph share: inputs, tables and vectors of values.

Components of vectors and matrices are tensors of their own: batched small products are slow.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from export.graph.onnx_builder import GraphBuilder, GraphValue
from export.package.player_tables import PlayerTables
from export.package.render_settings import RenderSettings


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

    @property
    def num_pixels(self) -> GraphValue:
        """Number of pixels, int64 scalar."""
        return self.height * self.width


@dataclass(frozen=True, eq=False, kw_only=True)
class GraphContext:
    """A graph being built, its tables and its inputs.

    Attributes:
        graph: The graph.
        tables: Their sizes and scales become constants.
        table_values: Values of `export.package.graph_tables.graph_initializers`, by name.
        settings: How the tables are drawn.
        camera: Pose and camera.
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
