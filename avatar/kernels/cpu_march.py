"""Ray marching through warp cells and canonical occupancy, compiled for the CPU."""

import numpy as np
from numba import prange

from avatar.kernels.jit import FAST, compile_kernel
from avatar.kernels.reference import MAX_LOG_DENSITY, OPAQUE_DEPTH

F32, I32, I64 = np.float32, np.int32, np.int64


@compile_kernel(inline="always")
def _safe(x):
    return x if abs(x) > F32(1e-7) else F32(1e-7)


@compile_kernel(inline="always")
def _exit(position, low, cell, index, direction, wide):
    """Distance along the ray, on one axis, to the far wall of the cells less than `wide` away."""
    wall = low + F32(index + (wide if direction > 0 else I32(1) - wide)) * cell
    return abs((wall - position) / _safe(direction))


@compile_kernel(parallel=True, **FAST)
def march(
    origins, directions, slots, jitter, step_m,
    cell_index, cell_roots, cell_low, cell_shape, cell_m,
    occupied, density, low, cells_per_m, grace_steps, points, rows, counts, reached,
):  # fmt: skip
    """Canonical sample points along rays of the body frame, and the root each was warped with.

    Samples lie on the lattice `t = entry + (k + jitter) step_m`. One is kept where its warp cell
    has a root whose canonical cell is occupied; of several roots the one of highest cached density
    counts. A ray ends `grace_steps` samples after its cached optical depth has passed
    `OPAQUE_DEPTH`, or when `points` holds no more; `reached` is where it would go on.
    """
    most = points.shape[1]
    for ray in prange(origins.shape[0]):
        slot = slots[ray]
        kept = 0
        ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        lx, ly, lz = cell_low[slot, 0], cell_low[slot, 1], cell_low[slot, 2]
        nx, ny, nz = cell_shape[slot, 0], cell_shape[slot, 1], cell_shape[slot, 2]
        enter, leave = F32(0), F32(1e9)
        for axis in range(3):
            towards = _safe(directions[ray, axis])
            near = (cell_low[slot, axis] - origins[ray, axis]) / towards
            far = near + F32(cell_shape[slot, axis]) * cell_m / towards
            enter = max(enter, min(near, far))
            leave = min(leave, max(near, far))
        optical = F32(0)
        left = grace_steps
        step = I32(0)
        while True:
            t = enter + (F32(step) + jitter[ray]) * step_m
            if t >= leave or kept >= most:
                break
            px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
            i = min(max(I32((px - lx) / cell_m), I32(0)), nx - I32(1))
            j = min(max(I32((py - ly) / cell_m), I32(0)), ny - I32(1))
            k = min(max(I32((pz - lz) / cell_m), I32(0)), nz - I32(1))
            packed = cell_index[slot, (i * ny + j) * nz + k]
            if packed <= 0:
                wide = max(I32(1), -packed)
                beyond = min(
                    _exit(px, lx, cell_m, i, dx, wide),
                    min(_exit(py, ly, cell_m, j, dy, wide), _exit(pz, lz, cell_m, k, dz, wide)),
                )
                step += max(I32(1), I32(np.ceil(beyond / step_m)))
                continue
            ex = px - (lx + (F32(i) + F32(0.5)) * cell_m)
            ey = py - (ly + (F32(j) + F32(0.5)) * cell_m)
            ez = pz - (lz + (F32(k) + F32(0.5)) * cell_m)
            best = F32(-1)
            row = I32(0)
            bx, by, bz = F32(0), F32(0), F32(0)
            for candidate in range(packed >> 2, (packed >> 2) + (packed & 3)):
                r = cell_roots[slot, candidate]
                x = r[0] + r[3] * ex + r[4] * ey + r[5] * ez
                y = r[1] + r[6] * ex + r[7] * ey + r[8] * ez
                z = r[2] + r[9] * ex + r[10] * ey + r[11] * ez
                a = I32(np.floor((x - low[0]) * cells_per_m[0]))
                b = I32(np.floor((y - low[1]) * cells_per_m[1]))
                c = I32(np.floor((z - low[2]) * cells_per_m[2]))
                if a < 0 or b < 0 or c < 0:
                    continue
                if a >= occupied.shape[0] or b >= occupied.shape[1] or c >= occupied.shape[2]:
                    continue
                if occupied[a, b, c] != 0 and density[a, b, c] > best:
                    best = density[a, b, c]
                    bx, by, bz = x, y, z
                    row = I32(candidate)
            if best >= F32(0):
                points[ray, kept, 0] = bx
                points[ray, kept, 1] = by
                points[ray, kept, 2] = bz
                rows[ray, kept] = row
                kept += 1
                optical += best * step_m
                if optical > F32(OPAQUE_DEPTH):
                    left -= 1
                    if left < 0:
                        break
            step += I32(1)
        counts[ray] = kept
        reached[ray] = step


@compile_kernel(parallel=True, nogil=True)
def pack(padded, padded_rows, first, counts, points, rows):
    """Copies each ray's samples from its own line to one list without gaps."""
    for ray in prange(counts.shape[0]):
        for n in range(counts[ray]):
            rows[first[ray] + n] = padded_rows[ray, n]
            for axis in range(3):
                points[first[ray] + n, axis] = padded[ray, n, axis]


@compile_kernel(nogil=True, fastmath=True)
def keep_highest(points, log_density, low, cells_per_m, density):
    """Raises the cached density of each sample's cell to the sample's own."""
    nx, ny, nz = density.shape
    for i in range(points.shape[0]):
        a = I32((points[i, 0] - low[0]) * cells_per_m[0])
        b = I32((points[i, 1] - low[1]) * cells_per_m[1])
        c = I32((points[i, 2] - low[2]) * cells_per_m[2])
        if 0 <= a < nx and 0 <= b < ny and 0 <= c < nz:
            here = np.exp(min(log_density[i], F32(MAX_LOG_DENSITY)))
            if here > density[a, b, c]:
                density[a, b, c] = here
