"""Hash-grid encoding, its gradients, and Adam's step on it, compiled for the CPU.

Points are worked on in blocks that stay in the nearest cache: first where all of a block's corners
lie, in loops over points that LLVM vectorises, then the entries themselves, four features at once.
A block of points or of Adam's numbers is one thread's or, where the table's gradient is summed, a
whole level, so that no two write to one place: sums are equal for any number of threads.
"""

import numpy as np

from avatar.kernels.kernel_compiler import (
    FAST_MATH,
    INLINED,
    INLINED_ALLOCATION,
    add4,
    claim,
    compile_kernel,
    dot4,
    load4,
    scale4,
    store4,
)
from avatar.kernels.operands import FEATURES_PER_LEVEL, PRIMES

POINTS_PER_BLOCK = 256
ENTRIES_PER_BLOCK = 4096
"""Numbers that one turn of Adam's loop over blocks works on."""
F32, I32, U32 = np.float32, np.int32, np.uint32
PRIME_Y, PRIME_Z = U32(PRIMES[1]), U32(PRIMES[2])


@compile_kernel(**INLINED)
def _box_coordinates(points, start, stop, low, places):
    """Offsets of a block's points from the box's corner, metres."""
    for i in range(stop - start):
        for axis in range(3):
            places[axis, i] = points[start + i, axis] - low[axis]


@compile_kernel(**INLINED)
def _box_coordinates_of_rows(points, rows, start, stop, low, places):
    """Offsets of the points in a block of `rows` from the box's corner, metres."""
    for i in range(stop - start):
        row = rows[start + i]
        for axis in range(3):
            places[axis, i] = points[row, axis] - low[axis]


@compile_kernel(**INLINED)
def _locate_cells(places, number, scale, counts, cells, within):
    """The cell of each place on one level, and the place's offset in it, in cells."""
    for axis in range(3):
        last = I32(counts[axis] - 2)
        for i in range(number):
            place = places[axis, i] * scale
            cell = min(max(I32(place), I32(0)), last)
            cells[axis, i] = cell
            within[axis, i] = place - F32(cell)


@compile_kernel(**INLINED)
def _corner_entries(cells, number, counts, dense, first, size, entries):
    """Entries of the corners of each cell, x fastest."""
    if dense == 1:
        along_y, along_z = counts[0], counts[0] * counts[1]
        for i in range(number):
            near = I32(first + cells[0, i] + along_y * cells[1, i] + along_z * cells[2, i])
            far = I32(near + along_z)
            entries[0, i], entries[1, i] = near, near + 1
            entries[2, i], entries[3, i] = near + along_y, near + along_y + 1
            entries[4, i], entries[5, i] = far, far + 1
            entries[6, i], entries[7, i] = far + along_y, far + along_y + 1
    else:
        mask = U32(size - 1)
        for i in range(number):
            x0, x1 = U32(cells[0, i]), U32(cells[0, i] + 1)
            y0, z0 = U32(U32(cells[1, i]) * PRIME_Y), U32(U32(cells[2, i]) * PRIME_Z)
            y1, z1 = U32(y0 + PRIME_Y), U32(z0 + PRIME_Z)
            a, b, c, d = U32(y0 ^ z0), U32(y1 ^ z0), U32(y0 ^ z1), U32(y1 ^ z1)
            entries[0, i], entries[1, i] = first + ((x0 ^ a) & mask), first + ((x1 ^ a) & mask)
            entries[2, i], entries[3, i] = first + ((x0 ^ b) & mask), first + ((x1 ^ b) & mask)
            entries[4, i], entries[5, i] = first + ((x0 ^ c) & mask), first + ((x1 ^ c) & mask)
            entries[6, i], entries[7, i] = first + ((x0 ^ d) & mask), first + ((x1 ^ d) & mask)


@compile_kernel(**INLINED)
def _trilinear_weights(within, number, weights):
    for i in range(number):
        x, y, z = within[0, i], within[1, i], within[2, i]
        u, v, w = F32(1) - x, F32(1) - y, F32(1) - z
        a, b, c, d = u * v, x * v, u * y, x * y
        weights[0, i], weights[1, i], weights[2, i], weights[3, i] = a * w, b * w, c * w, d * w
        weights[4, i], weights[5, i], weights[6, i], weights[7, i] = a * z, b * z, c * z, d * z


@compile_kernel(**INLINED_ALLOCATION)
def encode_block(points, start, stop, low, cells_per_m, counts, dense, offsets, table, features):
    """Trilinear features, on all levels, of at most `POINTS_PER_BLOCK` points.

    Points outside the box extrapolate from its border.
    """
    number = stop - start
    places, within = np.empty((3, POINTS_PER_BLOCK), F32), np.empty((3, POINTS_PER_BLOCK), F32)
    cells = np.empty((3, POINTS_PER_BLOCK), I32)
    entries, weights = np.empty((8, POINTS_PER_BLOCK), I32), np.empty((8, POINTS_PER_BLOCK), F32)
    _box_coordinates(points, start, stop, low, places)
    for level in range(cells_per_m.shape[0]):
        first, size = offsets[level], offsets[level + 1] - offsets[level]
        _locate_cells(places, number, cells_per_m[level], counts[level], cells, within)
        _corner_entries(cells, number, counts[level], dense[level], first, size, entries)
        _trilinear_weights(within, number, weights)
        for i in range(number):
            total = scale4(weights[0, i], load4(table, entries[0, i], 0))
            for corner in range(1, 8):
                entry = load4(table, entries[corner, i], 0)
                total = add4(total, scale4(weights[corner, i], entry))
            store4(features, start + i, level * FEATURES_PER_LEVEL, total)


@compile_kernel(**FAST_MATH)
def encode_backward(
    thread, threads, points, rows, runs, low, cells_per_m, counts, dense, offsets, grad_features,
    grad_table,
):  # fmt: skip
    """Adds the gradient of the features, by the table, to `grad_table`, each thread on its levels.

    Args:
        points: All points.
        rows, grad_features: Those with a gradient, and the gradients of their features.
        runs: First place in these lists and length of each run that counts (runs, 2).
    """
    places, within = np.empty((3, POINTS_PER_BLOCK), F32), np.empty((3, POINTS_PER_BLOCK), F32)
    cells = np.empty((3, POINTS_PER_BLOCK), I32)
    entries, weights = (np.empty((8, POINTS_PER_BLOCK), I32), np.empty((8, POINTS_PER_BLOCK), F32))
    for run in range(runs.shape[0]):
        stop = runs[run, 0] + runs[run, 1]
        for start in range(runs[run, 0], stop, POINTS_PER_BLOCK):
            number = min(stop - start, POINTS_PER_BLOCK)
            _box_coordinates_of_rows(points, rows, start, start + number, low, places)
            for level in range(thread, cells_per_m.shape[0], threads):
                first, size = offsets[level], offsets[level + 1] - offsets[level]
                _locate_cells(places, number, cells_per_m[level], counts[level], cells, within)
                _corner_entries(cells, number, counts[level], dense[level], first, size, entries)
                _trilinear_weights(within, number, weights)
                for i in range(number):
                    grad = load4(grad_features, start + i, level * FEATURES_PER_LEVEL)
                    for corner in range(8):
                        entry = entries[corner, i]
                        added = scale4(weights[corner, i], grad)
                        store4(grad_table, entry, 0, add4(load4(grad_table, entry, 0), added))


@compile_kernel(**INLINED)
def _add_point_gradient(within, corner_gradients, number, scale, total):
    """Adds one level's gradient, from what pulls at the corners of each cell."""
    for i in range(number):
        x, y, z = within[0, i], within[1, i], within[2, i]
        u, v, w = F32(1) - x, F32(1) - y, F32(1) - z
        p0, p1, p2, p3 = (
            corner_gradients[0, i],
            corner_gradients[1, i],
            corner_gradients[2, i],
            corner_gradients[3, i],
        )
        p4, p5, p6, p7 = (
            corner_gradients[4, i],
            corner_gradients[5, i],
            corner_gradients[6, i],
            corner_gradients[7, i],
        )
        # ∂/∂x Σ weight · pull: differences along an axis, bilinear in the other two
        total[0, i] += scale * (
            v * w * (p1 - p0) + y * w * (p3 - p2) + v * z * (p5 - p4) + y * z * (p7 - p6)
        )
        total[1, i] += scale * (
            u * w * (p2 - p0) + x * w * (p3 - p1) + u * z * (p6 - p4) + x * z * (p7 - p5)
        )
        total[2, i] += scale * (
            u * v * (p4 - p0) + x * v * (p5 - p1) + u * y * (p6 - p2) + x * y * (p7 - p3)
        )


@compile_kernel(**FAST_MATH)
def encode_points_backward(
    points, rows, low, cells_per_m, counts, dense, offsets, table, grad_features, factor,
    grad_points,
):  # fmt: skip
    """Gradient of `encode_block` times a factor, by the points in `rows`, written to `grad_points`.

    `grad_features` has the features of these points, and may have more levels than `cells_per_m`.
    """
    places, within = np.empty((3, POINTS_PER_BLOCK), F32), np.empty((3, POINTS_PER_BLOCK), F32)
    cells, entries = np.empty((3, POINTS_PER_BLOCK), I32), np.empty((8, POINTS_PER_BLOCK), I32)
    pulls, total = np.empty((8, POINTS_PER_BLOCK), F32), np.empty((3, POINTS_PER_BLOCK), F32)
    for start in range(0, rows.shape[0], POINTS_PER_BLOCK):
        number = min(rows.shape[0] - start, POINTS_PER_BLOCK)
        total[:] = F32(0)
        _box_coordinates_of_rows(points, rows, start, start + number, low, places)
        for level in range(cells_per_m.shape[0]):
            first, size = offsets[level], offsets[level + 1] - offsets[level]
            _locate_cells(places, number, cells_per_m[level], counts[level], cells, within)
            _corner_entries(cells, number, counts[level], dense[level], first, size, entries)
            for i in range(number):
                grad = load4(grad_features, start + i, level * FEATURES_PER_LEVEL)
                for corner in range(8):
                    pulls[corner, i] = dot4(load4(table, entries[corner, i], 0), grad)
            _add_point_gradient(within, pulls, number, cells_per_m[level], total)
        for i in range(number):
            row = rows[start + i]
            for axis in range(3):
                grad_points[row, axis] = factor * total[axis, i]


@compile_kernel(**INLINED)
def _adam_block(g, m, v, p, rates):
    rate, new_share, new_square_share, scale, eps = rates
    for i in range(p.shape[0]):
        here = g[i]
        m[i] += (here - m[i]) * new_share
        v[i] += (here * here - v[i]) * new_square_share
        p[i] -= rate * m[i] / (np.sqrt(v[i]) * scale + eps)
        g[i] = F32(0)


@compile_kernel(**FAST_MATH)
def adam_step(claimed, parameters):
    """Adam's step on flat arrays; the gradients are zeroed in the same pass over the memory.

    Blocks are slices, because LLVM vectorises only loops that begin at 0. A parameter has its
    gradient, mean, mean square and numbers, and its rates: the learning rate, the shares of the new
    gradient and of its square in their means, the scale of the squares' root, and epsilon.
    """
    passed, claimed_block = 0, claim(claimed)
    for (grad, mean, square, numbers), rates in parameters:
        blocks = (numbers.shape[0] + ENTRIES_PER_BLOCK - 1) // ENTRIES_PER_BLOCK
        while claimed_block < passed + blocks:
            start = (claimed_block - passed) * ENTRIES_PER_BLOCK
            part = slice(start, start + ENTRIES_PER_BLOCK)
            _adam_block(grad[part], mean[part], square[part], numbers[part], rates)
            claimed_block = claim(claimed)
        passed += blocks


@compile_kernel(**FAST_MATH)
def move_toward(thread, threads, pairs, share):
    """Moves means (numbers) by a share of the way to values, for each pair of both."""
    for mean, value in pairs:
        count = mean.shape[0]
        part = slice(count * thread // threads, count * (thread + 1) // threads)
        _move_block(mean[part], value[part], share)


@compile_kernel(**INLINED)
def _move_block(mean, value, share):
    for i in range(mean.shape[0]):
        mean[i] += share * (value[i] - mean[i])
