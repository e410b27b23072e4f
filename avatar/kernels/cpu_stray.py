"""Which samples of a frame's warp cells skinning carries elsewhere, compiled for the CPU."""

import numpy as np

from avatar.kernels.cpu_march import canonical_point
from avatar.kernels.cpu_skin import MATRIX_LANES, interpolate_at, transform_point
from avatar.kernels.jit import NO_ALLOCATION, compile_kernel

F32, U32 = np.float32, np.uint32


@compile_kernel(**NO_ALLOCATION)
def find_unreliable_roots(packed_cells, roots, grid_low, cell_m, transforms, low, nodes_per_m, far_m, unreliable, room):
    """Marks the roots whose warp is wrong at a corner of their cell.

    Args:
        index, roots, grid_low, cell_m: As in `CorrespondenceGrid`; `roots` with one more axis before it.
        transforms, low, nodes_per_m: Blended transforms as for `cpu_cells.flood`.
        far_m: How far from its corner a canonical point may be carried.
        doubtful: Of each row of the roots; written where true.
        room: For `LANES` floats.
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
def find_off_ray_points(points, origins, directions, transforms, low, nodes_per_m, far_m, spurious, room):
    """Which canonical points are carried farther than so much from the ray that they are for."""
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
