"""Forward and backward pass of a training step, compiled for the CPU: one kernel a thread.

A block of rays, or the points of one prior, passes through the whole step while it is in a core's
caches: field, light, composite and loss, the draw of the gradients to propagate, and backward
through the network, to the gradients of the samples' positions and to the wrenches on the bones.
Threads wait for one another once.

Threads claim block after block. Each block has sums of its own, which are added in the blocks'
order: a step is equal to the bit for any number of threads.
"""

import numpy as np

from avatar.kernels import numba_priors
from avatar.kernels.kernel_compiler import FAST_MATH, claim, compile_kernel
from avatar.kernels.numba_field import backward_passes, forward_block
from avatar.kernels.numba_hash_grid import POINTS_PER_BLOCK, encode_points_backward
from avatar.kernels.numba_pose import write_wrenches
from avatar.kernels.numba_priors import chance
from avatar.kernels.numba_rendering import composite_ray_loss
from avatar.kernels.numba_shading import light_factor, mean_normal
from avatar.kernels.operands import (
    CLOSE_PAIRS,
    EMPTY_SPACE,
    HEAD_INTERIOR,
    INTERIOR,
    OFF_SKIN,
    SOURCE_PAIRS,
    TV_PAIRS,
)

F32 = np.float32
RAYS_PER_BLOCK = 32
"""Rays that pass through the step together: about 200 samples, whose features fit a core's cache
beside the network."""


@compile_kernel(**FAST_MATH)
def _add_prior_gradients(kind, raw, points, pair_weights, weights, max_slope_per_m, grad):
    """Adds the gradients of the priors that hold at one kind of points; `weights` (kinds, 2)."""
    weight, other = weights[kind, 0], weights[kind, 1]
    if kind == EMPTY_SPACE:
        numba_priors.empty_space(raw, weight, grad)
    elif kind == TV_PAIRS:
        numba_priors.density_tv(raw, weight, grad)
        numba_priors.double_well(raw, other, grad)
    elif kind in (INTERIOR, HEAD_INTERIOR):
        numba_priors.interior(raw, weight, grad)
    elif kind == CLOSE_PAIRS:
        numba_priors.density_slope(raw, points, max_slope_per_m, weight, grad)
        numba_priors.color_tv(raw, other, grad)
    elif kind == OFF_SKIN:
        numba_priors.log_density_l1(raw, weight, grad)
    elif kind == SOURCE_PAIRS:
        numba_priors.toward_sources(raw, pair_weights, weight, grad)


@compile_kernel(**FAST_MATH)
def _draw_strong(grads, seed, first, faint, rows, drawn):
    """Draws points by the strength of their gradients; returns their number, and all strength.

    Gradients weaker than `faint` are drawn by chance, which depends on the seed and on the number
    of the point, counted from `first`. Rows and gradients, divided by the chance of each, are
    written from the front.
    """
    count, total = 0, F32(0)
    for n in range(grads.shape[0]):
        strength = abs(grads[n, 0]) + abs(grads[n, 1]) + abs(grads[n, 2]) + abs(grads[n, 3])
        total += strength
        if chance(seed, first + n) * faint < strength:
            rows[count] = n
            for q in range(4):
                drawn[count, q] = grads[n, q] * max(faint / strength, F32(1))
            count += 1
    return count, total


@compile_kernel(**FAST_MATH)
def _render_rays(
    first_ray, last_ray, raw, points, sample_offsets, sample_counts, root_rows, slots, roots,
    sample_step_m, skin, skin_low, skin_cells_per_m, world_from_body, light, min_length, least,
    most, target, alpha_weight, hard_weight, needs_normals, neutral, normals, rendered, loss,
    grad_raw,
):  # fmt: skip
    """Writes normals, shaded rendering and loss of rays, and the gradient of their raw outputs.

    `neutral` is scratch: the pixels without the light.
    """
    for ray in range(first_ray, last_ray):
        x, y, z = F32(0), F32(0), F32(0)
        if needs_normals:
            mean_normal(
                ray, raw, points, sample_offsets, sample_counts, root_rows, slots, roots,
                sample_step_m, skin, skin_low, skin_cells_per_m, normals,
            )  # fmt: skip
            x, y, z = normals[ray, 0], normals[ray, 1], normals[ray, 2]
        for i in range(3):
            normals[ray, i] = (
                world_from_body[ray, i, 0] * x + world_from_body[ray, i, 1] * y
                + world_from_body[ray, i, 2] * z
            )  # fmt: skip
        factor, _ = light_factor(normals, ray, light, min_length, (least, most))
        for q in range(3):
            neutral[ray, q] = target[ray, q] / factor
        neutral[ray, 3] = target[ray, 3]
        composite_ray_loss(
            ray, raw, sample_offsets, sample_counts, sample_step_m, neutral, alpha_weight,
            hard_weight, rendered, loss, grad_raw,
        )  # fmt: skip
        for q in range(3):
            rendered[ray, q] *= factor


@compile_kernel(**FAST_MATH)
def _clear(rows):
    """Sets all numbers to 0; a slice that is assigned takes numba far longer to compile."""
    for row in range(rows.shape[0]):
        for column in range(rows.shape[1]):
            rows[row, column] = F32(0)


@compile_kernel(**FAST_MATH)
def _block_range(block, kind_count, ends, sample_offsets, sample_count):
    """First and last point of a block, and its first ray; -1 if it has the points of a prior."""
    if block < kind_count:
        return ends[block], ends[block + 1], -1
    ray = (block - kind_count) * RAYS_PER_BLOCK
    after = ray + RAYS_PER_BLOCK
    stop = sample_offsets[after] if after < sample_offsets.shape[0] else sample_count
    return sample_offsets[ray], stop, ray


@compile_kernel(**FAST_MATH)
def learn(
    claimed, settings, samples, rays, surface, priors, field, levels, pose_levels, pose,
    outputs, backward, sums,
):  # fmt: skip
    """Renders rays and propagates the gradients of their mean loss and of the priors.

    Args:
        claimed: Counter of the blocks that threads claim: first the priors' points, then the rays.
        settings: Distance between samples, metres; weights of the losses of alpha and of the hard
            surface; strength below which a gradient is drawn by chance, and a seed of the draw;
            whether normals are needed.
        samples: Canonical points, those of the rays and then those of the priors (points, 3); of
            the rays' samples offsets, counts and root rows.
        rays: Slots, pixels (rays, 4), world-from-body rotations (rays, 3, 3), and the roots of all
            slots (slots, rows, 12).
        surface: Normals of the skin's volume, its corner and resolution; coefficients of the light;
            least length of a normal, and least and largest factor of the light.
        priors: End of the samples, and of each kind of points (kinds + 1); weight of each source
            pair; weights of each kind's terms (kinds, 2); largest slope of log density, 1/m.
        field: Table, W₁, b₁ (1, hidden), W₂ᵀ, b₂ and padded W₁ᵀ, as in `numba_field`.
        levels: As in `numba_hash_grid.encode`.
        pose_levels: Number of levels whose gradient reaches the poses.
        pose: Skinning weights (nodes, 24), their shape, corner and resolution; bones of all slots.
        outputs: Raw outputs and their gradients (points, 4); of the rays shaded rendering, loss,
            world normals, wrenches (rays, 24, 6); written. No wrenches are computed for zero rays.
        backward: Points that have a gradient, the gradients of their features, and the first place
            and number of those of each block (blocks, 2); written.
        sums: Of each block the sums of the gradients of W₁, W₂ᵀ, b₁ and b₂ (blocks, width + 6,
            hidden; or no rows), and the sum of the gradients' strengths; written.
    """
    points, sample_offsets, sample_counts, root_rows = samples
    slots, target, world_from_body, roots = rays
    skin, skin_low, skin_cells_per_m, light, min_length, least, most = surface
    ends, pair_weights, weights, max_slope_per_m = priors
    table, first, bias, second, second_bias, transposed = field
    low, cells_per_m, vertex_counts, dense, level_offsets = levels
    skinning, skinning_shape, skinning_low, nodes_per_m, bones = pose
    raw, grad_raw, rendered, loss, normals, wrenches = outputs
    rows, grad_features, runs = backward
    network_sums, strengths = sums
    sample_step_m, alpha_weight, hard_weight, faint, seed, needs_normals = settings

    ray_count, kind_count = slots.shape[0], weights.shape[0]
    ray_blocks = (ray_count + RAYS_PER_BLOCK - 1) // RAYS_PER_BLOCK
    sample_count = ends[0]
    longest = 0
    for block in range(kind_count + ray_blocks):
        start, stop, _ = _block_range(block, kind_count, ends, sample_offsets, sample_count)
        longest = max(longest, stop - start)
    features = np.empty((longest + 4, grad_features.shape[1]), F32)
    drawn = np.empty((longest, 4), F32)
    neutral = np.empty((ray_count, 4), F32)
    grad_points = np.empty((sample_count if wrenches.shape[0] > 0 else 0, 3), F32)
    block = claim(claimed)
    while block < kind_count + ray_blocks:
        own_sums = network_sums[block]
        _clear(own_sums)
        start, stop, ray = _block_range(block, kind_count, ends, sample_offsets, sample_count)
        last_ray, count = min(ray + RAYS_PER_BLOCK, ray_count), stop - start
        part, raw_part, grad_part = points[start:stop], raw[start:stop], grad_raw[start:stop]
        for chunk in range((count + POINTS_PER_BLOCK - 1) // POINTS_PER_BLOCK):
            forward_block(
                chunk, part, low, cells_per_m, vertex_counts, dense, level_offsets, table, first,
                bias, second, second_bias, features, raw_part,
            )  # fmt: skip
        if ray < 0:
            _clear(grad_part)
            _add_prior_gradients(
                block, raw_part, part, pair_weights, weights, max_slope_per_m, grad_part
            )
        else:
            _render_rays(
                ray, last_ray, raw, points, sample_offsets, sample_counts, root_rows, slots,
                roots, sample_step_m, skin, skin_low, skin_cells_per_m, world_from_body, light,
                min_length, least, most, target, alpha_weight, hard_weight, needs_normals,
                neutral, normals, rendered, loss, grad_raw,
            )  # fmt: skip
        row_part, feature_part = rows[start:stop], grad_features[start:stop]
        kept, strength = _draw_strong(grad_part, seed, start, faint, row_part, drawn)
        strengths[block], runs[block, 0], runs[block, 1] = strength, start, kept
        row_part, feature_part = row_part[:kept], feature_part[:kept]
        backward_passes(
            0, 1, features, row_part, drawn[:kept], first, bias, second, transposed,
            feature_part, own_sums[:-6], own_sums[-6:-2], own_sums[-2:],
        )  # fmt: skip
        if ray >= 0 and wrenches.shape[0] > 0:
            _clear(grad_points[start:stop])
            # undo the mean over rays: a pose is judged by the loss of each of its rays
            encode_points_backward(
                part, row_part, low, cells_per_m[:pose_levels], vertex_counts, dense,
                level_offsets, table, feature_part, F32(ray_count), grad_points[start:stop],
            )  # fmt: skip
            write_wrenches(
                ray, last_ray, points, grad_points, root_rows, sample_offsets, sample_counts,
                slots, roots, skinning, skinning_shape, skinning_low, nodes_per_m, bones,
                wrenches,
            )  # fmt: skip
        for n in range(kept):
            row_part[n] += start
        block = claim(claimed)
