"""Culls correspondence cells and finds spurious correspondences, compiled for the CPU."""

import numpy as np

from avatar.numba_kernels.kernel_compiler import FAST_MATH, NO_ALLOCATION, compile_kernel
from avatar.numba_kernels.numba_rendering import canonical_point
from avatar.numba_kernels.numba_skinning import MATRIX_LANES, interpolate_at, transform_point

F32, I32, U32 = np.float32, np.int32, np.uint32
CELL_SCALE_MARGIN = 1.001
"""Factor by which a cell is enlarged, so that samples on its walls are inside."""


@compile_kernel(inline="always")
def _cell_span(root, across, low, per_m, cells):
    """First and last canonical cell, on one axis, that a cell's image reaches."""
    first = I32(np.floor((root - across - low) * per_m))
    last = I32(np.floor((root + across - low) * per_m))
    return max(first, I32(0)), min(last, I32(cells - 1))


@compile_kernel(inline="always")
def _image_extent(roots, row, bent, half):
    """Bound of the extent of a cell's image about its root, along each canonical axis."""
    r = roots[row]
    x = half * (abs(r[3]) + abs(r[4]) + abs(r[5]))
    y = half * (abs(r[6]) + abs(r[7]) + abs(r[8]))
    z = half * (abs(r[9]) + abs(r[10]) + abs(r[11]))
    if bent:
        a, b = roots[row + 1], roots[row + 2]
        square = half * half
        x += square * (abs(a[0]) + abs(a[3]) + abs(a[6]) + abs(a[9]) + abs(b[0]) + abs(b[3]))
        y += square * (abs(a[1]) + abs(a[4]) + abs(a[7]) + abs(a[10]) + abs(b[1]) + abs(b[4]))
        z += square * (abs(a[2]) + abs(a[5]) + abs(a[8]) + abs(a[11]) + abs(b[2]) + abs(b[5]))
    return x, y, z


@compile_kernel(inline="always")
def _any_occupied(occupied, a0, a1, b0, b1, c0, c1):
    for a in range(a0, a1 + 1):
        for b in range(b0, b1 + 1):
            for c in range(c0, c1 + 1):
                if occupied[a, b, c] != 0:
                    return True
    return False


@compile_kernel(**FAST_MATH)
def cull_cells(packed_cells, roots, cell_m, occupied, low, cells_per_m, culled_cells):
    """Empties the cells whose samples cannot lie in an occupied canonical cell.

    A cell's warp is affine, or of second order in bent cells, so that a box bounds the image of all
    its samples; none is lost.
    """
    half = F32(0.5 * CELL_SCALE_MARGIN) * cell_m
    nx, ny, nz = occupied.shape
    for cell in range(packed_cells.shape[0]):
        packed = packed_cells[cell]
        culled_cells[cell] = 0
        rows = 3 if packed & 4 else 1
        for candidate in range(packed & 3):
            row = (packed >> 3) + candidate * rows
            x, y, z = _image_extent(roots, row, rows > 1, half)
            a0, a1 = _cell_span(roots[row, 0], x, low[0], cells_per_m[0], nx)
            b0, b1 = _cell_span(roots[row, 1], y, low[1], cells_per_m[1], ny)
            c0, c1 = _cell_span(roots[row, 2], z, low[2], cells_per_m[2], nz)
            if _any_occupied(occupied, a0, a1, b0, b1, c0, c1):
                culled_cells[cell] = packed
                break


@compile_kernel(**NO_ALLOCATION)
def find_unreliable_roots(
    packed_cells, roots, grid_low, cell_m, transforms, low, nodes_per_m, far_m, unreliable, room
):
    """Marks the roots whose warp is wrong at a corner of their cell.

    Args:
        packed_cells, roots, grid_low, cell_m: As in `CorrespondenceGrid`, with a leading axis of
            `roots`.
        transforms, low, nodes_per_m: Blended transforms as for `flood_fill_roots`.
        far_m: Largest distance between a corner and its skinned canonical point, metres.
        unreliable: Flag of each root row; written where true.
        room: Scratch for `MATRIX_LANES` floats.
    """
    half = F32(0.5) * cell_m
    for i in range(packed_cells.shape[0]):
        for j in range(packed_cells.shape[1]):
            for k in range(packed_cells.shape[2]):
                packed = packed_cells[i, j, k]
                if packed <= 0:
                    continue
                row, bent = U32(packed >> 3), packed & 4
                for _ in range(packed & 3):
                    for corner in range(8):
                        dx = half if corner & 1 else -half
                        dy = half if corner & 2 else -half
                        dz = half if corner & 4 else -half
                        x, y, z = canonical_point(roots, 0, row, bent, dx, dy, dz)
                        interpolate_at(transforms, low, nodes_per_m, x, y, z, MATRIX_LANES, room)
                        x, y, z = transform_point(room, x, y, z)
                        x -= grid_low[0] + (F32(i) + F32(0.5)) * cell_m + dx
                        y -= grid_low[1] + (F32(j) + F32(0.5)) * cell_m + dy
                        z -= grid_low[2] + (F32(k) + F32(0.5)) * cell_m + dz
                        if x * x + y * y + z * z > far_m * far_m:
                            unreliable[row] = True
                            break
                    row += U32(3) if bent else U32(1)


@compile_kernel(**NO_ALLOCATION)
def find_off_ray_points(
    points, origins, directions, transforms, low, nodes_per_m, far_m, spurious, room
):
    """Flags canonical points that skinning carries farther than `far_m` from their rays."""
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        interpolate_at(transforms, low, nodes_per_m, x, y, z, MATRIX_LANES, room)
        x, y, z = transform_point(room, x, y, z)
        x, y, z = x - origins[n, 0], y - origins[n, 1], z - origins[n, 2]
        along = x * directions[n, 0] + y * directions[n, 1] + z * directions[n, 2]
        x -= along * directions[n, 0]
        y -= along * directions[n, 1]
        z -= along * directions[n, 2]
        spurious[n] = x * x + y * y + z * z > far_m * far_m
