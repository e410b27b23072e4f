"""Vectors and matrices whose components are tensors of their own (no batched small products)."""

from collections.abc import Sequence

from export.nodes import GraphValue

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
