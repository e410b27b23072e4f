"""Nodes that carry canonical points to the camera's frame, with the derivative."""

from dataclasses import dataclass

import numpy as np

from export.columns import Matrix, Vector, dot, moved
from export.nodes import Value
from export.scene import Scene


@dataclass(frozen=True, eq=False, kw_only=True)
class Posed:
    """The skin's nodes in the camera's frame: values of the graph, one entry a node."""

    camera: Vector


def pose_nodes(scene: Scene) -> Posed:
    """Linear blend skinning of every node, straight into the camera's frame."""
    columns = scene.columns
    blended = scene.view.bones.transposed(1, 0).matmul(columns["node_weights"])
    matrix = [[blended.row(4 * i + j) for j in range(4)] for i in range(3)]
    return Posed(camera=moved(matrix, [columns[f"node_{letter}"] for letter in "xyz"]))


def carried(scene: Scene, posed: Posed, canonical: Vector) -> tuple[Vector, Matrix]:
    """Where points are in the camera's frame, and how that changes with them.

    Trilinear between the eight nodes about each.

    Returns:
        The points, and the derivative's rows.
    """
    rows, fraction, per_m = _corners(scene, canonical)
    point, derivative = [], []
    for table in posed.camera:
        value, slopes = _trilinear([table.take(row) for row in rows], fraction)
        point.append(value)
        derivative.append([slope * scale for slope, scale in zip(slopes, per_m, strict=True)])
    return point, derivative


def _corners(scene: Scene, canonical: Vector) -> tuple[list[Value], Vector, list[float]]:
    """Rows of the eight nodes about points (z fastest), fractions between them, nodes a metre."""
    skin = scene.tables.skin
    counts = [2 * count - 1 for count in skin.index.shape]
    per_m = [2.0 / float(step) for step in skin.step_m]
    number, fraction = None, []
    for axis, point in enumerate(canonical):
        place = (point - float(skin.low[axis])) * per_m[axis]
        place = place.clipped(0.0, counts[axis] - 1 - 1e-3)
        below = place.floor()
        fraction.append(place - below)
        whole = below.cast(np.int32)
        number = whole if number is None else number * counts[axis] + whole
    assert number is not None
    rows = []
    for step in (0, counts[2], counts[1] * counts[2], (counts[1] + 1) * counts[2]):
        row = scene.columns["node"].take(number + step)
        rows += [row, row + 1]  # along z rows follow each other
    return rows, fraction, per_m


def _trilinear(corners: list[Value], fraction: Vector) -> tuple[Value, Vector]:
    """The value between eight corners, and its slopes along x, y, z, per cell."""
    x, y, z = fraction
    along_z = [corners[i + 1] - corners[i] for i in range(0, 8, 2)]
    on_z = [corners[2 * i] + z * slope for i, slope in enumerate(along_z)]
    along_y = [on_z[i + 1] - on_z[i] for i in (0, 2)]
    on_y = [on_z[2 * i] + y * slope for i, slope in enumerate(along_y)]
    z_on_y = [_between(along_z[i], along_z[i + 1], y) for i in (0, 2)]
    along_x = on_y[1] - on_y[0]
    slopes = [
        along_x,
        _between(along_y[0], along_y[1], x),
        _between(z_on_y[0], z_on_y[1], x),
    ]
    return on_y[0] + x * along_x, slopes


def _between(low: Value, high: Value, share: Value) -> Value:
    return low + share * (high - low)


def determinant(matrix: Matrix, cofactors: Matrix) -> Value:
    """Of 3×3 matrices, with their adjugates."""
    return dot(matrix[0], [row[0] for row in cofactors])


def sound(scene: Scene, volume: Value) -> Value:
    """Where a derivative may be inverted: the skin is neither folded over nor torn apart."""
    stretch = scene.rules.stretch
    return (volume > 1.0 / stretch) & (volume < stretch)
