"""Nodes that carry the hull's surfels into the camera's frame, cheaply: most are never seen."""

from dataclasses import dataclass

from export.columns import Vector
from export.nodes import Value
from export.posing import Place, Posed, place_of
from export.scene import Scene


@dataclass(frozen=True, eq=False, kw_only=True)
class Surfels:
    """The hull: values of the graph, one entry a surfel.

    Attributes:
        place: Where they lie among the skin's nodes, the same in all poses.
        camera: Positions in the camera's frame, linear in tetrahedra.
    """

    place: Place
    camera: Vector


def pose_surfels(scene: Scene, posed: Posed) -> Surfels:
    """Positions as sums over four nodes each.

    All but the nodes' posed places is the same in every pose: onnxruntime computes it once.
    """
    columns = scene.columns
    place = place_of(scene, [columns[f"position_{letter}"] for letter in "xyz"])
    rows, shares = _tetrahedra(scene, place)
    camera = []
    for table in posed.camera:
        total = None
        for row, share in zip(rows, shares, strict=True):
            part = table.take(row) * share
            total = part if total is None else total + part
        assert total is not None
        camera.append(total)
    return Surfels(place=place, camera=camera)


def _tetrahedra(scene: Scene, place: Place) -> tuple[list[Value], list[Value]]:
    """Rows of four nodes, and their shares in a surfel's position.

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
    return [low, first, second, along_both + 1], shares
