"""Fast-SNARF roots at the centers of a correspondence grid's cells, and culling, for the CPU.

The roots flood from the skin's seeds to neighboring cells: a root, moved by one cell along its own
inverse Jacobian, is so close to the neighbor's that one or two Broyden steps reach it. The kernel
is serial and releases the GIL, so that the ingest thread can run it beside the trainer. A rendering
culls cells, and leaves out spurious correspondences.
"""

import math

import numpy as np
from jaxtyping import Float32, Int32

from avatar.kernels.kernel_compiler import FAST_MATH, INLINED, NO_ALLOCATION, compile_kernel
from avatar.kernels.numba_rendering import canonical_point
from avatar.kernels.numba_skinning import (
    MATRIX_LANES,
    blend_nodes,
    interpolate_at,
    invert_rotation,
    probe_corners,
    probe_faces,
    rotate_vector,
    solve_root,
    transform_point,
)
from avatar.rig import Rig

F32, I32, I64, U32 = np.float32, np.int32, np.int64, np.uint32
FACE_DIRECTIONS = np.array(
    [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], dtype=np.int32
)
MAX_ROOTS = 3
"""Largest number of roots of a cell; two bits hold it."""
SAME_ROOT_M = 0.02
"""Distance below which two roots of a cell are the same, metres."""
PROBE_DISTANCE_CELLS = 0.375
"""Distance of the probes from a cell's center, in cells: three quarters of the way to a face."""
MIN_SECOND_ORDER_M = 5e-4
"""Deviation from an affine warp, at a cell's faces, from which the cell is bent, metres."""
SEARCH_MARGIN_M = 0.03
"""Margin about the band within which roots are searched, metres."""


TransformVolume = tuple[
    Float32[np.ndarray, "x y z lanes"], Float32[np.ndarray, "3"], Float32[np.ndarray, "3"]
]
"""Blended 3×4 transforms on the nodes of the weight volume, its corner, and nodes per metre."""


def solve_correspondences(
    rig: Rig, bones: Float32[np.ndarray, "24 12"], band_m: float, cell_m: float
) -> tuple[Float32[np.ndarray, "3"], Int32[np.ndarray, "gx gy gz"], Float32[np.ndarray, "rows 12"]]:
    """Corner, packed cells and roots of a pose's `CorrespondenceGrid`, whose cells are `cell_m`.

    `bones` are body-from-canonical transforms; skin is covered up to a distance of `band_m`.
    """
    volume = blended_transform_volume(rig, bones, band_m + SEARCH_MARGIN_M)
    posed, inverses = np.empty_like(rig.seeds), np.empty((len(rig.seeds), 9), np.float32)
    room = np.empty(MATRIX_LANES + 15, dtype=np.float32)
    pose_seeds(*volume, rig.seeds, posed, inverses, room)
    low = posed.min(axis=0) - np.float32(band_m)
    shape = np.ceil((posed.max(axis=0) + np.float32(band_m) - low) / cell_m).astype(int)
    index = np.empty(tuple(shape), dtype=np.int32)
    capacity = index.size
    while True:
        found = (  # untouched memory costs nothing
            np.empty(index.size, np.int32), np.empty(capacity, np.int32),
            np.empty((capacity, 3), np.int32), np.empty((capacity, 30), np.float32),
            np.empty(capacity, np.bool_),
        )  # fmt: skip
        count = flood_fill_roots(
            *volume, rig.seeds, posed, inverses,
            rig.skin_distance, rig.cells_per_m, np.float32(band_m + 0.5 * cell_m),
            low, np.float32(cell_m), index.shape, *found, room,
        )  # fmt: skip
        if count <= capacity:
            chains, following, _, warps, bent = found
            return low, index, pack_roots(chains, following, warps, bent, index.reshape(-1))
        capacity = count


def blended_transform_volume(
    rig: Rig, bones: Float32[np.ndarray, "24 12"], reach_m: float
) -> TransformVolume:
    """Blends bones on all nodes; those farther from the skin than `reach_m` are left at zero."""
    lanes = np.zeros((24, MATRIX_LANES), dtype=np.float32)
    lanes[:, :12] = bones
    transforms = np.zeros((*rig.weights.shape[:3], MATRIX_LANES), dtype=np.float32)
    blend_nodes(*rig.skinning_nodes_within(reach_m), lanes, transforms.reshape(-1, MATRIX_LANES))
    return transforms, rig.box_low, rig.nodes_per_m


@compile_kernel(**NO_ALLOCATION)
def pose_seeds(transforms, low, nodes_per_m, seeds, posed, inverses, room):
    """Skins the seeds; `posed` (seeds, 3) and the inverse 3×3 blends (seeds, 9) are written."""
    blend = room[:MATRIX_LANES]
    for s in range(seeds.shape[0]):
        x, y, z = seeds[s, 0], seeds[s, 1], seeds[s, 2]
        interpolate_at(transforms, low, nodes_per_m, x, y, z, MATRIX_LANES, blend)
        posed[s, 0], posed[s, 1], posed[s, 2] = transform_point(blend, x, y, z)
        invert_rotation(blend, inverses[s])


@compile_kernel(**INLINED)
def _skin_distance(x, y, z, distance, low, cells_per_m):
    """Distance of a canonical point's cell from the skin; far outside the box."""
    a = I32(math.floor((x - low[0]) * cells_per_m[0]))
    b = I32(math.floor((y - low[1]) * cells_per_m[1]))
    c = I32(math.floor((z - low[2]) * cells_per_m[2]))
    nx, ny, nz = distance.shape
    inside = a >= 0 and b >= 0 and c >= 0 and a < nx and b < ny and c < nz
    return distance[a, b, c] if inside else F32(1)


@compile_kernel(**INLINED)
def _is_known_root(chain, following, found, x, y, z):
    """True if a cell's chain holds a root near a point, or is full."""
    count = 0
    while chain >= 0:
        dx, dy, dz = found[chain, 0] - x, found[chain, 1] - y, found[chain, 2] - z
        if dx * dx + dy * dy + dz * dz < F32(SAME_ROOT_M * SAME_ROOT_M):
            return True
        count += 1
        chain = following[chain]
    return count == MAX_ROOTS


@compile_kernel(**INLINED)
def _search_root(
    transforms, low, nodes_per_m, distance, cells_per_m, band_m, grid_low, cell_m,
    chains, following, cell_of, found, total, i, j, k, flat, x, inverse, p, blend,
):  # fmt: skip
    """Solves for a root of cell (i, j, k) from x and adds it if it is new; returns their count."""
    if _is_known_root(chains[flat], following, found, x[0], x[1], x[2]):
        return total
    off = _skin_distance(x[0], x[1], x[2], distance, low, cells_per_m)
    if off > band_m + F32(0.015):  # metres
        return total
    p[0] = grid_low[0] + (F32(i) + F32(0.5)) * cell_m
    p[1] = grid_low[1] + (F32(j) + F32(0.5)) * cell_m
    p[2] = grid_low[2] + (F32(k) + F32(0.5)) * cell_m
    if not solve_root(transforms, low, nodes_per_m, p, x, blend, inverse, False):
        return total
    if _skin_distance(x[0], x[1], x[2], distance, low, cells_per_m) > band_m:
        return total
    if _is_known_root(chains[flat], following, found, x[0], x[1], x[2]):
        return total
    if total < following.shape[0]:
        for n in range(3):
            found[total, n] = x[n]
        for n in range(9):
            found[total, 3 + n] = inverse[n]
        cell_of[total, 0], cell_of[total, 1], cell_of[total, 2] = i, j, k
        following[total] = chains[flat]
        chains[flat] = total
    return total + 1


@compile_kernel(**NO_ALLOCATION)
def flood_fill_roots(
    transforms, low, nodes_per_m, seeds, posed, seed_inverses, distance, cells_per_m, band_m,
    grid_low, cell_m, shape, chains, following, cell_of, found, bent, room,
):  # fmt: skip
    """Finds all roots of one frame; returns their number, which above the capacity is too many.

    Args:
        transforms, low, nodes_per_m: Blended 3×4 transforms on the weight volume's nodes (x, y, z,
            `MATRIX_LANES`), zero on nodes too far from the skin to matter.
        seeds, posed, seed_inverses: Starting points: canonical, posed, inverse 3×3 blends.
        distance, cells_per_m, band_m: Distance from the canonical skin in cells of the same box;
            roots farther from it than the band are dropped.
        grid_low, cell_m, shape: Low corner, edge of a cell and cells of the frame's grid.
        chains: (cells) the last root of each cell, -1 where there is none; written, as the next
            four.
        following: (capacity) the root of the same cell that was found before each.
        cell_of: (capacity, 3) the cell of each root.
        found: (capacity, 30) each root and its derivatives by `probe_faces` and `probe_corners`.
        bent: (capacity) whether the corners were probed.
        room: Scratch for `MATRIX_LANES` + 15 floats.
    """
    blend, inverse = room[:MATRIX_LANES], room[MATRIX_LANES : MATRIX_LANES + 9]
    x, p = room[MATRIX_LANES + 9 : MATRIX_LANES + 12], room[MATRIX_LANES + 12 : MATRIX_LANES + 15]
    t = F32(PROBE_DISTANCE_CELLS) * cell_m
    for cell in range(chains.shape[0]):
        chains[cell] = -1
    total, done = I64(0), I64(0)  # 64 bits everywhere: a kernel is compiled for each type
    for s in range(seeds.shape[0]):
        i = I64((posed[s, 0] - grid_low[0]) / cell_m)
        j = I64((posed[s, 1] - grid_low[1]) / cell_m)
        k = I64((posed[s, 2] - grid_low[2]) / cell_m)
        for n in range(9):
            inverse[n] = seed_inverses[s, n]
        # first guess: x = seed + B⁻¹ (center - posed seed), with B the blended 3×3 matrix
        ux, uy, uz = rotate_vector(
            inverse,
            grid_low[0] + (F32(i) + F32(0.5)) * cell_m - posed[s, 0],
            grid_low[1] + (F32(j) + F32(0.5)) * cell_m - posed[s, 1],
            grid_low[2] + (F32(k) + F32(0.5)) * cell_m - posed[s, 2],
        )
        x[0], x[1], x[2] = seeds[s, 0] + ux, seeds[s, 1] + uy, seeds[s, 2] + uz
        total = _search_root(
            transforms, low, nodes_per_m, distance, cells_per_m, band_m, grid_low, cell_m,
            chains, following, cell_of, found, total, i, j, k, (i * shape[1] + j) * shape[2] + k,
            x, inverse, p, blend,
        )  # fmt: skip
        while done < min(total, following.shape[0]):
            i, j, k = I64(cell_of[done, 0]), I64(cell_of[done, 1]), I64(cell_of[done, 2])
            p[0] = grid_low[0] + (F32(i) + F32(0.5)) * cell_m
            p[1] = grid_low[1] + (F32(j) + F32(0.5)) * cell_m
            p[2] = grid_low[2] + (F32(k) + F32(0.5)) * cell_m
            root = found[done]
            for n in range(3):
                x[n] = root[n]
            for n in range(9):
                inverse[n] = root[3 + n]
            bend = probe_faces(transforms, low, nodes_per_m, p, t, x, inverse, blend, root)
            # at a face, d = cell_m / 2, the warp is about |c_ii| d² from affine
            bent[done] = bend * F32(0.25) * cell_m * cell_m > F32(MIN_SECOND_ORDER_M)
            if bent[done]:
                for n in range(9):
                    inverse[n] = root[3 + n]
                probe_faces(transforms, low, nodes_per_m, p, t, x, inverse, blend, root)
                probe_corners(transforms, low, nodes_per_m, p, t, x, inverse, blend, root)
            for side in range(6):
                a, b, c = (
                    i + FACE_DIRECTIONS[side, 0],
                    j + FACE_DIRECTIONS[side, 1],
                    k + FACE_DIRECTIONS[side, 2],
                )
                if a < 0 or b < 0 or c < 0 or a >= shape[0] or b >= shape[1] or c >= shape[2]:
                    continue
                # guess of the neighbor's root: x ± cell_m A e, along a column of A
                axis, step_m = side // 2, cell_m * F32(1 - 2 * (side % 2))
                x[0] = root[0] + step_m * root[3 + axis]
                x[1] = root[1] + step_m * root[6 + axis]
                x[2] = root[2] + step_m * root[9 + axis]
                for n in range(9):
                    inverse[n] = root[3 + n]
                total = _search_root(
                    transforms, low, nodes_per_m, distance, cells_per_m, band_m, grid_low, cell_m,
                    chains, following, cell_of, found, total, a, b, c,
                    (a * shape[1] + b) * shape[2] + c, x, inverse, p, blend,
                )  # fmt: skip
            done += 1
    return total


@compile_kernel(**FAST_MATH)
def pack_roots(chains, following, found, bent, index):
    """Writes `CorrespondenceGrid.packed_cells`, flat, and returns `CorrespondenceGrid.roots`."""
    rows = 1  # row 0 stays unused, so that no packed index is 0
    for cell in range(index.shape[0]):
        count, bends, chain = 0, False, chains[cell]
        while chain >= 0:
            count, bends, chain = count + 1, bends or bent[chain], following[chain]
        index[cell] = rows * 8 + 4 * bends + count if count > 0 else 0
        rows += count * (3 if bends else 1)
    roots = np.zeros((rows, 12), np.float32)
    for cell in range(index.shape[0]):
        row, chain, bends = index[cell] >> 3, chains[cell], index[cell] & 4
        while chain >= 0:
            root = found[chain]
            for n in range(12):
                roots[row, n] = root[n]
            if bends and bent[chain]:
                for n in range(12):
                    roots[row + 1, n] = root[12 + n]
                for n in range(6):
                    roots[row + 2, n] = root[24 + n]
            row, chain = row + (3 if bends else 1), following[chain]
    return roots


@compile_kernel(**INLINED)
def _cell_span(root, across, low, per_m, cells):
    """First and last canonical cell, on one axis, that a cell's image reaches."""
    first = I32(np.floor((root - across - low) * per_m))
    last = I32(np.floor((root + across - low) * per_m))
    return max(first, I32(0)), min(last, I32(cells - 1))


@compile_kernel(**INLINED)
def _image_extent(roots, row, bent, half):
    """Bound of the extent of a cell's image about its root, along each canonical axis."""
    r = roots[row]
    # for |d_i| ≤ h on axis k: |A d|_k ≤ h Σ |A_ki|, and |Σ c_ij d_i d_j| ≤ h² Σ |c_ij|
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


@compile_kernel(**INLINED)
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
    half = F32(0.5 * 1.001) * cell_m  # samples on its walls are inside
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
    """Marks the rows of roots whose warp is wrong at a corner of their cell.

    The grid is a `CorrespondenceGrid` with a leading axis of `roots`; transforms are as for
    `flood_fill_roots`. A corner's canonical point may be skinned up to `far_m` metres away from it.
    `room` is scratch for `MATRIX_LANES` floats.
    """
    half = F32(0.5) * cell_m
    for i in range(packed_cells.shape[0]):
        for j in range(packed_cells.shape[1]):
            for k in range(packed_cells.shape[2]):
                packed = packed_cells[i, j, k]
                if packed <= 0:
                    continue
                row, bent = U32(packed >> 3), packed & 4 != 0
                for _ in range(packed & 3):
                    for corner in range(8):
                        dx = half if corner & 1 else -half
                        dy = half if corner & 2 else -half
                        dz = half if corner & 4 else -half
                        x, y, z = canonical_point(roots, U32(0), row, bent, dx, dy, dz)
                        interpolate_at(transforms, low, nodes_per_m, x, y, z, MATRIX_LANES, room)
                        x, y, z = transform_point(room, x, y, z)
                        # LBS(x) - p, with p the corner
                        x -= grid_low[0] + (F32(i) + F32(0.5)) * cell_m + dx
                        y -= grid_low[1] + (F32(j) + F32(0.5)) * cell_m + dy
                        z -= grid_low[2] + (F32(k) + F32(0.5)) * cell_m + dz
                        if x * x + y * y + z * z > far_m * far_m:
                            unreliable[row] = True
                            break
                    row = U32(row + (U32(3) if bent else U32(1)))


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
        # the part of LBS(x) - o across the ray: its length is the distance from the ray
        along = x * directions[n, 0] + y * directions[n, 1] + z * directions[n, 2]
        x -= along * directions[n, 0]
        y -= along * directions[n, 1]
        z -= along * directions[n, 2]
        spurious[n] = x * x + y * y + z * z > far_m * far_m
