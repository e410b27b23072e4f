"""Vectors and matrices whose components are tensors of their own (no batched small products)."""

from collections.abc import Sequence

from export.nodes import Value

Vector = list[Value]
"""Three values: x, y, z of many vectors."""
Matrix = list[list[Value]]
"""Rows of values: the entries of many matrices."""


def dot(a: Sequence[Value], b: Sequence[Value]) -> Value:
    """Dot product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Cross product."""
    return [a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3] for k in range(3)]


def adjugate(matrix: Matrix) -> Matrix:
    """The inverse of 3×3 matrices times their determinant."""
    rows: Matrix = []
    for i in range(3):
        row = []
        for j in range(3):
            a, b, c, d = (j + 1) % 3, (j + 2) % 3, (i + 1) % 3, (i + 2) % 3
            row.append(matrix[a][c] * matrix[b][d] - matrix[a][d] * matrix[b][c])
        rows.append(row)
    return rows


def taken(vector: Sequence[Value], places: Value) -> Vector:
    """`[component[places] for component in vector]`."""
    return [component.take(places) for component in vector]
