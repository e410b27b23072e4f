"""What every part of the player's graph looks at: inputs, tables and rules."""

from dataclasses import dataclass

from export.nodes import GraphBuilder, GraphValue
from export.rules import RenderSettings
from export.tables import PlayerTables


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
        columns: The tables' contents as values of the graph (`export.tables.initialisers`).
        rules: How it is drawn.
        view: From where.
        samples: Along each ray and layer, int64 scalar.
    """

    graph: GraphBuilder
    tables: PlayerTables
    table_values: dict[str, GraphValue]
    settings: RenderSettings
    camera: CameraValues
    samples: GraphValue
