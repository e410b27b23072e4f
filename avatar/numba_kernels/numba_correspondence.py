"""Fast-SNARF roots at the centers of a correspondence grid's cells, compiled for the CPU.

The roots flood from the skin's seeds to neighboring cells: a root, moved by one cell along its own
inverse Jacobian, is so close to the neighbor's that one or two Broyden steps reach it. The kernel
is serial and releases the GIL, so that the ingest thread can run it beside the trainer.
"""

import math

import numpy as np
from jaxtyping import Float32, Int32

from avatar.deformation.rig import Rig
from avatar.kernels.torch_correspondence import (
    MAX_ROOTS,
    MIN_SECOND_ORDER_M,
    PROBE_DISTANCE_CELLS,
    SAME_ROOT_M,
)
from avatar.numba_kernels.kernel_compiler import FAST_MATH, NO_ALLOCATION, compile_kernel
from avatar.numba_kernels.numba_broyden import (
    invert_rotation,
    probe_corners,
    probe_faces,
    rotate_vector,
    solve_root,
)
from avatar.numba_kernels.numba_skinning import (
    MATRIX_LANES,
    blend_nodes,
    interpolate_at,
    transform_point,
)

F32, I32 = np.float32, np.int32
FACE_DIRECTIONS = np.array(
    [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], dtype=np.int32
)
SEARCH_MARGIN_M = 0.03
"""Margin about the band within which roots are searched, metres."""
MAX_PREDICTED_OVERSHOOT_M = 0.015
"""Distance beyond the band from which a predicted root is not searched, metres."""


def solve_correspondences(
    rig: Rig, bones: Float32[np.ndarray, "24 12"], band_m: float, cell_m: float
) -> tuple[Float32[np.ndarray, "3"], Int32[np.ndarray, "gx gy gz"], Float32[np.ndarray, "rows 12"]]:
    """Corner, packed cells and roots of one pose's `CorrespondenceGrid`."""
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
) -> tuple[Float32[np.ndarray, "x y z lanes"], Float32[np.ndarray, "3"], Float32[np.ndarray, "3"]]:
    """Blended transforms on the nodes of the weight volume, where these lie, and nodes per metre.

    Nodes farther from the skin than `reach_m` are left at zero.
    """
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


@compile_kernel(inline="always", **FAST_MATH)
def _skin_distance(x, y, z, distance, low, cells_per_m):
    """Distance of a canonical point's cell from the skin; far outside the box."""
    a = I32(math.floor((x - low[0]) * cells_per_m[0]))
    b = I32(math.floor((y - low[1]) * cells_per_m[1]))
    c = I32(math.floor((z - low[2]) * cells_per_m[2]))
    nx, ny, nz = distance.shape
    inside = a >= 0 and b >= 0 and c >= 0 and a < nx and b < ny and c < nz
    return distance[a, b, c] if inside else F32(1)


@compile_kernel(inline="always", **FAST_MATH)
def _is_known_root(chain, following, found, x, y, z):
    """Whether a cell's chain of roots holds one near a point, or holds no more."""
    count = 0
    while chain >= 0:
        dx, dy, dz = found[chain, 0] - x, found[chain, 1] - y, found[chain, 2] - z
        if dx * dx + dy * dy + dz * dz < F32(SAME_ROOT_M * SAME_ROOT_M):
            return True
        count += 1
        chain = following[chain]
    return count == MAX_ROOTS


@compile_kernel(inline="always", **FAST_MATH)
def _search_root(
    transforms, low, nodes_per_m, distance, cells_per_m, band_m, grid_low, cell_m,
    chains, following, cell_of, found, total, i, j, k, flat, x, inverse, p, blend,
):  # fmt: skip
    """Looks for a root of cell (i, j, k) near x, and takes it in; how many roots there are then."""
    if _is_known_root(chains[flat], following, found, x[0], x[1], x[2]):
        return total
    off = _skin_distance(x[0], x[1], x[2], distance, low, cells_per_m)
    if off > band_m + F32(MAX_PREDICTED_OVERSHOOT_M):
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
    """Finds all roots of one frame; returns how many there are.

    Args:
        transforms, low, nodes_per_m: Blended 3×4 transforms on the weight volume's nodes
            (x, y, z, `LANES`), zero on nodes too far from the skin to matter; where the nodes are.
        seeds, posed, seed_inverses: Where to start: canonical, posed, inverse 3×3 blends.
        distance, cells_per_m, band_m: Distance from the canonical skin in cells of the same box;
            roots farther from it than the band are dropped.
        grid_low, cell_m, shape: Low corner, edge of a cell and cells of the frame's grid.
        chains: (cells) the last root found in each cell, -1 where there is none.
        following: (capacity) the root of the same cell that was found before each.
        cell_of: (capacity, 3) the cell of each root.
        found: (capacity, 30) each root and what `probe_faces` and `probe_corners` say about it.
        bent: (capacity) whether the corners were asked.
        room: For `LANES` + 15 floats.

    The last six are written. A returned number above the capacity means that it did not do.
    """
    blend, inverse = room[:MATRIX_LANES], room[MATRIX_LANES : MATRIX_LANES + 9]
    x, p = room[MATRIX_LANES + 9 : MATRIX_LANES + 12], room[MATRIX_LANES + 12 : MATRIX_LANES + 15]
    t = F32(PROBE_DISTANCE_CELLS) * cell_m
    for cell in range(chains.shape[0]):
        chains[cell] = -1
    total, done = 0, 0
    for s in range(seeds.shape[0]):
        i = I32((posed[s, 0] - grid_low[0]) / cell_m)
        j = I32((posed[s, 1] - grid_low[1]) / cell_m)
        k = I32((posed[s, 2] - grid_low[2]) / cell_m)
        for n in range(9):
            inverse[n] = seed_inverses[s, n]
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
            i, j, k = cell_of[done, 0], cell_of[done, 1], cell_of[done, 2]
            p[0] = grid_low[0] + (F32(i) + F32(0.5)) * cell_m
            p[1] = grid_low[1] + (F32(j) + F32(0.5)) * cell_m
            p[2] = grid_low[2] + (F32(k) + F32(0.5)) * cell_m
            root = found[done]
            for n in range(3):
                x[n] = root[n]
            for n in range(9):
                inverse[n] = root[3 + n]
            bend = probe_faces(transforms, low, nodes_per_m, p, t, x, inverse, blend, root)
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
    """Writes `CorrespondenceGrid.index`, flat, and returns `CorrespondenceGrid.roots`."""
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
