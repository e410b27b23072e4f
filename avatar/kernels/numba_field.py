"""The field: hash grid and a network of one hidden layer, forward and backward, for the CPU.

A block of points passes from the grid's entries to the outputs while it is in the nearest cache. A
product keeps its sums in registers: of four points in sixteen units, say, so that each number that
is loaded is used two or four times.

    h = relu(f W₁ + b₁),  y = h W₂ + b₂
    g_h = (g_y W₂ᵀ) ⊙ [h > 0],  g_f = g_h W₁ᵀ,  g_W₁ = fᵀ g_h,  g_W₂ = hᵀ g_y

The backward pass computes h again, which takes less time than to store and to load it. Each thread
adds up the gradients of its own points, and the threads' sums are added in their order: the result
is the same in every run with as many threads, and differs by rounding between numbers of threads.
"""

import numpy as np

from avatar.kernels.kernel_compiler import (
    FAST_MATH,
    INLINED,
    add4,
    compile_kernel,
    load4,
    load8,
    multiply_add8,
    repeat8,
    store4,
    store8,
    sum8,
    where_positive8,
    zeros8,
)
from avatar.kernels.numba_hash_grid import POINTS_PER_BLOCK, encode_block
from avatar.kernels.operands import HIDDEN_WIDTH

F32, I32 = np.float32, np.int32
POINTS_PER_PASS = 32
"""Points whose features, hidden units and gradients fit the nearest cache beside the weights; a
multiple of eight."""
OUTPUTS = 4


@compile_kernel(**INLINED)
def _hidden_units(features, first, number, weights, bias, hidden):
    """Writes relu(f W₁ + b₁) of rows from `first` on, four at a time, to the front of `hidden`."""
    for p in range(0, number, 4):
        i = first + p
        for j in range(0, HIDDEN_WIDTH, 16):
            a0, b0 = load8(bias, 0, j), load8(bias, 0, j + 8)
            a1, a2, a3, b1, b2, b3 = a0, a0, a0, b0, b0, b0
            for k in range(weights.shape[0]):
                one, two = load8(weights, k, j), load8(weights, k, j + 8)
                f = repeat8(features, i, k)
                a0, b0 = multiply_add8(f, one, a0), multiply_add8(f, two, b0)
                f = repeat8(features, i + 1, k)
                a1, b1 = multiply_add8(f, one, a1), multiply_add8(f, two, b1)
                f = repeat8(features, i + 2, k)
                a2, b2 = multiply_add8(f, one, a2), multiply_add8(f, two, b2)
                f = repeat8(features, i + 3, k)
                a3, b3 = multiply_add8(f, one, a3), multiply_add8(f, two, b3)
            store8(hidden, p, j, where_positive8(a0, a0))
            store8(hidden, p, j + 8, where_positive8(b0, b0))
            store8(hidden, p + 1, j, where_positive8(a1, a1))
            store8(hidden, p + 1, j + 8, where_positive8(b1, b1))
            store8(hidden, p + 2, j, where_positive8(a2, a2))
            store8(hidden, p + 2, j + 8, where_positive8(b2, b2))
            store8(hidden, p + 3, j, where_positive8(a3, a3))
            store8(hidden, p + 3, j + 8, where_positive8(b3, b3))


@compile_kernel(**INLINED)
def _write_outputs(hidden, number, weights, bias, raw, first):
    """Writes h W₂ + b₂ to rows of `raw` from `first` on; `weights` are W₂ᵀ (4, hidden)."""
    for p in range(number):
        q0, q1, q2, q3 = zeros8(), zeros8(), zeros8(), zeros8()
        for j in range(0, HIDDEN_WIDTH, 8):
            h = load8(hidden, p, j)
            q0 = multiply_add8(h, load8(weights, 0, j), q0)
            q1 = multiply_add8(h, load8(weights, 1, j), q1)
            q2 = multiply_add8(h, load8(weights, 2, j), q2)
            q3 = multiply_add8(h, load8(weights, 3, j), q3)
        raw[first + p, 0], raw[first + p, 1] = sum8(q0) + bias[0], sum8(q1) + bias[1]
        raw[first + p, 2], raw[first + p, 3] = sum8(q2) + bias[2], sum8(q3) + bias[3]


@compile_kernel(**FAST_MATH)
def forward_block(
    block, points, low, cells_per_m, counts, dense, offsets, table, weights, bias, output_weights,
    output_bias, features, raw,
):  # fmt: skip
    """Writes features and raw outputs of one block of points."""
    start = block * POINTS_PER_BLOCK
    stop = min(start + POINTS_PER_BLOCK, points.shape[0])
    encode_block(points, start, stop, low, cells_per_m, counts, dense, offsets, table, features)
    hidden = np.empty((POINTS_PER_PASS, HIDDEN_WIDTH), F32)
    for first in range(start, stop, POINTS_PER_PASS):
        number = min(stop - first, POINTS_PER_PASS)
        _hidden_units(features, first, number, weights, bias, hidden)
        _write_outputs(hidden, number, output_weights, output_bias, raw, first)


@compile_kernel(**FAST_MATH)
def forward(
    thread, threads, points, low, cells_per_m, counts, dense, offsets, table,
    weights, bias, output_weights, output_bias, features, raw,
):  # fmt: skip
    """Features and raw outputs of points.

    Args:
        points: Canonical points; they and all of `HashLevels` as in `numba_hash_grid.encode_block`.
        weights, bias: W₁ (width, hidden) and b₁ (1, hidden).
        output_weights, output_bias: W₂ᵀ (4, hidden) and b₂ (4).
        features, raw: (points, width) and (points, 4); written. `features` has as many rows as the
            next multiple of four.
    """
    blocks = (points.shape[0] + POINTS_PER_BLOCK - 1) // POINTS_PER_BLOCK
    for block in range(thread, blocks, threads):
        forward_block(
            block, points, low, cells_per_m, counts, dense, offsets, table, weights,
            bias, output_weights, output_bias, features, raw,
        )  # fmt: skip


@compile_kernel(**INLINED)
def _gather(features, rows, grad_raw, first, number, f, g):
    """Copies a pass's features and output gradients; the rows up to a multiple of 8 become zero."""
    for p in range(number):
        row = rows[first + p]
        for k in range(0, features.shape[1], 4):
            store4(f, p, k, load4(features, row, k))
        store4(g, p, 0, load4(grad_raw, first + p, 0))
    for p in range(number, (number + 7) // 8 * 8):
        for k in range(features.shape[1]):
            f[p, k] = F32(0)
        for k in range(OUTPUTS):
            g[p, k] = F32(0)


@compile_kernel(**INLINED)
def _hidden_gradients(hidden, g, number, output_weights, grad_hidden):
    """Writes (g_y W₂ᵀ) ⊙ [h > 0]."""
    for p in range(number):
        g0, g1, g2, g3 = repeat8(g, p, 0), repeat8(g, p, 1), repeat8(g, p, 2), repeat8(g, p, 3)
        for j in range(0, HIDDEN_WIDTH, 8):
            total = multiply_add8(g0, load8(output_weights, 0, j), zeros8())
            total = multiply_add8(g1, load8(output_weights, 1, j), total)
            total = multiply_add8(g2, load8(output_weights, 2, j), total)
            total = multiply_add8(g3, load8(output_weights, 3, j), total)
            store8(grad_hidden, p, j, where_positive8(load8(hidden, p, j), total))


@compile_kernel(**INLINED)
def _feature_gradients(grad_hidden, number, transposed, out):
    """Writes g_h W₁ᵀ of eight points at a time; `transposed` is W₁ᵀ (hidden, width)."""
    for p in range(0, number, 8):
        for k in range(0, transposed.shape[1], 8):
            a0, a1, a2, a3, a4, a5, a6, a7 = (
                zeros8(), zeros8(), zeros8(), zeros8(), zeros8(), zeros8(), zeros8(), zeros8()
            )  # fmt: skip
            for j in range(HIDDEN_WIDTH):
                w = load8(transposed, j, k)
                a0 = multiply_add8(repeat8(grad_hidden, p, j), w, a0)
                a1 = multiply_add8(repeat8(grad_hidden, p + 1, j), w, a1)
                a2 = multiply_add8(repeat8(grad_hidden, p + 2, j), w, a2)
                a3 = multiply_add8(repeat8(grad_hidden, p + 3, j), w, a3)
                a4 = multiply_add8(repeat8(grad_hidden, p + 4, j), w, a4)
                a5 = multiply_add8(repeat8(grad_hidden, p + 5, j), w, a5)
                a6 = multiply_add8(repeat8(grad_hidden, p + 6, j), w, a6)
                a7 = multiply_add8(repeat8(grad_hidden, p + 7, j), w, a7)
            store8(out, p, k, a0)
            store8(out, p + 1, k, a1)
            store8(out, p + 2, k, a2)
            store8(out, p + 3, k, a3)
            store8(out, p + 4, k, a4)
            store8(out, p + 5, k, a5)
            store8(out, p + 6, k, a6)
            store8(out, p + 7, k, a7)


@compile_kernel(**INLINED)
def _add_weight_gradients(f, grad_hidden, number, total):
    """Adds fᵀ g_h of a pass to `total` (width, hidden), four rows of it at a time."""
    for k in range(0, total.shape[0], 4):
        for j in range(0, HIDDEN_WIDTH, 16):
            a0, b0 = load8(total, k, j), load8(total, k, j + 8)
            a1, b1 = load8(total, k + 1, j), load8(total, k + 1, j + 8)
            a2, b2 = load8(total, k + 2, j), load8(total, k + 2, j + 8)
            a3, b3 = load8(total, k + 3, j), load8(total, k + 3, j + 8)
            for p in range(number):
                one, two = load8(grad_hidden, p, j), load8(grad_hidden, p, j + 8)
                factor = repeat8(f, p, k)
                a0, b0 = multiply_add8(factor, one, a0), multiply_add8(factor, two, b0)
                factor = repeat8(f, p, k + 1)
                a1, b1 = multiply_add8(factor, one, a1), multiply_add8(factor, two, b1)
                factor = repeat8(f, p, k + 2)
                a2, b2 = multiply_add8(factor, one, a2), multiply_add8(factor, two, b2)
                factor = repeat8(f, p, k + 3)
                a3, b3 = multiply_add8(factor, one, a3), multiply_add8(factor, two, b3)
            store8(total, k, j, a0)
            store8(total, k, j + 8, b0)
            store8(total, k + 1, j, a1)
            store8(total, k + 1, j + 8, b1)
            store8(total, k + 2, j, a2)
            store8(total, k + 2, j + 8, b2)
            store8(total, k + 3, j, a3)
            store8(total, k + 3, j + 8, b3)


@compile_kernel(**INLINED)
def _add_output_gradients(hidden, grad_hidden, g, number, total, bias_total):
    """Adds the gradients of W₂ᵀ to `total` (4, hidden), and of b₁ and b₂ to rows of the other."""
    for j in range(0, HIDDEN_WIDTH, 8):
        q0, q1, q2, q3 = (
            load8(total, 0, j),
            load8(total, 1, j),
            load8(total, 2, j),
            load8(total, 3, j),
        )
        for p in range(number):
            h = load8(hidden, p, j)
            q0 = multiply_add8(repeat8(g, p, 0), h, q0)
            q1 = multiply_add8(repeat8(g, p, 1), h, q1)
            q2 = multiply_add8(repeat8(g, p, 2), h, q2)
            q3 = multiply_add8(repeat8(g, p, 3), h, q3)
        store8(total, 0, j, q0)
        store8(total, 1, j, q1)
        store8(total, 2, j, q2)
        store8(total, 3, j, q3)
    for p in range(number):
        for j in range(HIDDEN_WIDTH):
            bias_total[0, j] += grad_hidden[p, j]
        store4(bias_total, 1, 0, add4(load4(bias_total, 1, 0), load4(g, p, 0)))


@compile_kernel(**FAST_MATH)
def backward_passes(
    first_pass, passes_apart, features, rows, grad_raw, weights, bias, output_weights, transposed,
    grad_features, weight_sum, output_sum, bias_sum,
):  # fmt: skip
    """Writes the gradients of every `passes_apart`-th pass over `rows`, and adds them up.

    Args:
        first_pass, passes_apart: The first pass, and the way to the next, in `POINTS_PER_PASS`.
        features: Of all points (points, width).
        rows: Those of them that have a gradient.
        grad_raw: Gradient of each of these points' outputs (rows, 4).
        weights, bias, output_weights: As in `forward`.
        transposed: W₁ᵀ, its width padded with zeros to a multiple of eight.
        grad_features: (rows, width); written.
        weight_sum, output_sum, bias_sum: Sums (width, hidden), (4, hidden) and, of b₁ and of b₂,
            (2, hidden). Without rows, the gradients of a frozen network are left out.
    """
    width = features.shape[1]
    f, g = np.empty((POINTS_PER_PASS, width), F32), np.empty((POINTS_PER_PASS, OUTPUTS), F32)
    hidden = np.empty((POINTS_PER_PASS, HIDDEN_WIDTH), F32)
    grad_hidden = np.empty((POINTS_PER_PASS, HIDDEN_WIDTH), F32)
    grad_f = np.empty((POINTS_PER_PASS, transposed.shape[1]), F32)
    step = passes_apart * POINTS_PER_PASS
    for first in range(first_pass * POINTS_PER_PASS, rows.shape[0], step):
        number = min(rows.shape[0] - first, POINTS_PER_PASS)
        padded = (number + 7) // 8 * 8
        _gather(features, rows, grad_raw, first, number, f, g)
        _hidden_units(f, 0, padded, weights, bias, hidden)
        _hidden_gradients(hidden, g, padded, output_weights, grad_hidden)
        _feature_gradients(grad_hidden, padded, transposed, grad_f)
        if output_sum.shape[0] > 0:
            _add_weight_gradients(f, grad_hidden, padded, weight_sum)
            _add_output_gradients(hidden, grad_hidden, g, padded, output_sum, bias_sum)
        for p in range(number):
            for k in range(0, width, 4):
                store4(grad_features, first + p, k, load4(grad_f, p, k))
