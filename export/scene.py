"""What every part of the player's graph looks at: inputs, tables and rules."""

from dataclasses import dataclass

from export.nodes import Graph, Value
from export.rules import DrawingRules
from export.tables import Tables


@dataclass(frozen=True, eq=False, kw_only=True)
class View:
    """Where a picture is taken from: values of the graph.

    Attributes:
        bones: Camera-from-canonical 3×4 matrices, one row of 12 a joint.
        focal, center: (x, y) in pixels.
        height, width: Scalars, int64.
    """

    bones: Value
    focal: tuple[Value, Value]
    center: tuple[Value, Value]
    height: Value
    width: Value

    @property
    def pixels(self) -> Value:
        """How many there are, int64 scalar."""
        return self.height * self.width


@dataclass(frozen=True, eq=False, kw_only=True)
class Scene:
    """A graph being written, and what it draws.

    Attributes:
        graph: The graph.
        tables: What is drawn, for the sizes and scales that become constants.
        columns: The tables' contents as values of the graph (`export.tables.initialisers`).
        rules: How it is drawn.
        view: From where.
        samples: Along each ray and layer, int64 scalar.
    """

    graph: Graph
    tables: Tables
    columns: dict[str, Value]
    rules: DrawingRules
    view: View
    samples: Value
