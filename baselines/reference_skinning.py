"""Skinning of canonical points in the reference player, and inverses of its Jacobians; compiled."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from avatar.kernels.kernel_compiler import compile_kernel
from export.player_inputs import SkinningNodes

F32, F64 = np.float32, np.float64
MIN_VOLUME = 1e-12
"""Least magnitude of a determinant whose matrix is inverted."""


class PosedNodes(NamedTuple):
    """Nodes of the skinning grid and their posed positions in the camera's frame, metres."""

    nodes: SkinningNodes
    camera: Float32[np.ndarray, "rows 3"]


def skin_trilinear(
    posed: PosedNodes, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3 3"]]:
    """Return camera positions and Jacobians of canonical points, trilinear between posed nodes.

    The Jacobian is 0, so that it is never inverted, where one of the eight nodes is not stored.
    """
    return _run_skinning(_skin_trilinear, posed, points)


def skin_tetrahedral(
    posed: PosedNodes, points: Float32[np.ndarray, "points 3"]
) -> tuple[Float32[np.ndarray, "points 3"], Float32[np.ndarray, "points 3 3"]]:
    """Skin canonical points, linear in the six tetrahedra of each cell; as `skin_trilinear`."""
    return _run_skinning(_skin_tetrahedral, posed, points)


def _run_skinning(kernel, posed: PosedNodes, points: Float32[np.ndarray, "points 3"]):
    moved = np.zeros((len(points), 3), dtype=np.float32)
    jacobian = np.zeros((len(points), 3, 3), dtype=np.float32)
    nodes = posed.nodes
    given = nodes.index, nodes.low, nodes.step_m, posed.camera, points
    kernel(*map(np.ascontiguousarray, given), moved, jacobian)
    return moved, jacobian


def invert_matrices(
    matrices: Float32[np.ndarray, "matrices 3 3"],
) -> tuple[Float32[np.ndarray, "matrices 3 3"], Float32[np.ndarray, "matrices"]]:
    """Return inverses and determinants; the identity where the determinant is about 0."""
    inverse = np.empty((len(matrices), 3, 3), dtype=np.float32)
    volume = np.empty(len(matrices), dtype=np.float32)
    _invert(np.ascontiguousarray(matrices), inverse, volume)
    return inverse, volume


@compile_kernel(nogil=True, error_model="numpy")
def _place_in_grid(point, low, step_m, count):
    """Return a point's place along an axis, in nodes, within the grid."""
    return min(max(F64((point - low) / step_m), 0.0), count - 1 - 1e-3)


@compile_kernel(nogil=True, error_model="numpy")
def _skin_trilinear(index, low, step_m, camera, points, moved, jacobian):
    # Σ w(x, y, z) · node over eight corners, w = x y z of their shares; the Jacobian is its slope
    base, shares = np.zeros(3, dtype=np.int64), np.zeros((2, 3), dtype=np.float32)
    for p in range(len(points)):
        for axis in range(3):
            place = _place_in_grid(points[p, axis], low[axis], step_m[axis], index.shape[axis])
            base[axis] = int(np.floor(place))
            shares[1, axis] = F32(place - base[axis])
            shares[0, axis] = F32(1) - shares[1, axis]
        stored = True
        for a, b, c in np.ndindex(2, 2, 2):
            below = index[base[0] + a, base[1] + b, base[2]]
            stored = stored and below > 0
            x, y, z = shares[a, 0], shares[b, 1], shares[c, 2]
            slope_x = y * z * (F32(2 * a - 1) / step_m[0])
            slope_y = x * z * (F32(2 * b - 1) / step_m[1])
            slope_z = x * y * (F32(2 * c - 1) / step_m[2])
            for k in range(3):
                there = camera[below + c, k]
                moved[p, k] += there * (x * y * z)
                jacobian[p, k, 0] += there * slope_x
                jacobian[p, k, 1] += there * slope_y
                jacobian[p, k, 2] += there * slope_z
        if not stored:
            jacobian[p] = F32(0)


@compile_kernel(nogil=True, error_model="numpy")
def _skin_tetrahedral(index, low, step_m, camera, points, moved, jacobian):
    """Walk from the lower to the upper corner of each cell along a point's tetrahedron.

    Six tetrahedra share a cell's diagonal. Steps along the axes in descending order of the point's
    fractions visit the four corners of its tetrahedron.
    """
    base, corner = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    order, part = np.zeros(3, dtype=np.int64), np.zeros(3)
    before = np.zeros(3, dtype=np.float32)
    for p in range(len(points)):
        for axis in range(3):
            place = F32(_place_in_grid(points[p, axis], low[axis], step_m[axis], index.shape[axis]))
            base[axis] = int(np.floor(place))
            part[axis] = F64(place) - base[axis]
            order[axis], corner[axis] = axis, 0
        for last in (1, 2, 1):  # sorts three fractions; equal ones stay in order
            if part[order[last]] > part[order[last - 1]]:
                order[last], order[last - 1] = order[last - 1], order[last]
        # with fractions f0 ≥ f1 ≥ f2 the four corners weigh 1 - f0, f0 - f1, f1 - f2 and f2; the
        # difference between consecutive ones is the Jacobian's column of the axis stepped along
        for turn in range(4):
            row = index[base[0] + corner[0], base[1] + corner[1], base[2]] + corner[2]
            share = 1.0 if turn == 0 else part[order[turn - 1]]
            share -= part[order[turn]] if turn < 3 else 0.0
            for k in range(3):
                there = camera[row, k]
                moved[p, k] = F32(moved[p, k] + there * share)
                if turn > 0:
                    axis = order[turn - 1]
                    jacobian[p, k, axis] = (there - before[k]) / step_m[axis]
                before[k] = there
            if turn < 3:
                corner[order[turn]] += 1


@compile_kernel(nogil=True, error_model="numpy")
def _invert(matrices, inverse, volume):
    """Invert by cofactors, in double precision."""
    cofactor = np.zeros((3, 3))
    for p in range(len(matrices)):
        matrix, determinant = matrices[p], 0.0
        for i in range(3):
            for j in range(3):
                a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
                cofactor[i, j] = F64(matrix[a, c]) * matrix[b, d] - F64(matrix[a, d]) * matrix[b, c]
        for j in range(3):
            determinant += matrix[0, j] * cofactor[0, j]
        volume[p] = F32(determinant)
        flat = abs(determinant) < MIN_VOLUME
        for i in range(3):
            for j in range(3):
                identity = F32(1) if i == j else F32(0)
                inverse[p, i, j] = identity if flat else F32(cofactor[j, i] / determinant)
