"""The player's compositing, compiled, and by how much its bricks are wrong: the loops of tuning."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32

from avatar.numba_kernels.kernel_compiler import compile_kernel
from export.package.player_tables import BRICK_SIZE, LOG_DENSITY_RANGE
from export.package.render_settings import RenderSettings
from export.reference.ray_segments import RaySegments

F32 = np.float32
VOXELS_PER_BRICK = BRICK_SIZE**3
LOG_DENSITY_PER_CODE = F32((LOG_DENSITY_RANGE[1] - LOG_DENSITY_RANGE[0]) / 255.0)
"""Logarithm of the density, per code."""
MIN_LOG_DENSITY = F32(LOG_DENSITY_RANGE[0])


class SirtUpdate(NamedTuple):
    """What rays would change in voxels, and how much they have to do with each.

    One update is `codes - push / (share + damping)`: each ray shares its error among its samples
    (SIRT), so nothing overshoots, however many rays see a voxel. Per voxel, the empty brick first.

    Attributes:
        color, color_share: Codes × shares, and squared shares of a colour.
        density, density_share: The same of the density code, in squared colours.
    """

    color: Float32[np.ndarray, "voxels 3"]
    color_normalizer: Float32[np.ndarray, "voxels"]
    density: Float32[np.ndarray, "voxels"]
    density_normalizer: Float32[np.ndarray, "voxels"]

    @classmethod
    def zeros(cls, voxels: int) -> "SirtUpdate":
        """Nothing yet."""
        sizes = ((voxels, 3), (voxels,), (voxels,), (voxels,))
        return cls(*(np.zeros(size, dtype=np.float32) for size in sizes))


def composite_segments(
    pieces: RaySegments,
    rules: RenderSettings,
    index: Int32[np.ndarray, "bx by bz"],
    density: Float32[np.ndarray, "voxels"],
    color: Float32[np.ndarray, "voxels 3"],
) -> Float32[np.ndarray, "rays 4"]:
    """What the player shows: premultiplied colour and alpha of each ray.

    Args:
        pieces: Where it samples.
        rules: When a ray ends, and which of them have a second layer.
        index: As in `BrickTable`.
        density, color: Codes of every brick's own voxels, the empty brick first.
    """
    out = np.zeros((pieces.num_rays, 4), dtype=np.float32)
    _run_kernel(pieces, rules, index, density, color, out, out, None)
    return out


def back_project(
    pieces: RaySegments,
    rules: RenderSettings,
    index: Int32[np.ndarray, "bx by bz"],
    density: Float32[np.ndarray, "voxels"],
    color: Float32[np.ndarray, "voxels 3"],
    target_colors: Float32[np.ndarray, "rays 4"],
) -> SirtUpdate:
    """Where and how far the codes are from showing what is wanted. The rest as for `shown`."""
    push = SirtUpdate.zeros(len(density))
    _run_kernel(
        pieces, rules, index, density, color, target_colors, np.zeros_like(target_colors), push
    )
    return push


def _run_kernel(
    pieces: RaySegments,
    rules: RenderSettings,
    index: Int32[np.ndarray, "bx by bz"],
    density: Float32[np.ndarray, "voxels"],
    color: Float32[np.ndarray, "voxels 3"],
    wanted: Float32[np.ndarray, "rays 4"],
    out: Float32[np.ndarray, "rays 4"],
    push: SirtUpdate | None,
) -> None:
    """Shows every ray in `out`, and adds to `push` what it would change, if there is one."""
    samples = np.concatenate([[0], np.cumsum(pieces.count, dtype=np.int64)])[pieces.ray_offsets]
    most = int(np.diff(samples).max(initial=0)) + 1
    blocks = int(np.diff(pieces.ray_offsets).max(initial=0)) + 1
    sampled = (
        np.zeros((most, 4), dtype=np.int32), np.zeros((most, 4), dtype=np.float32),
        np.zeros(most, dtype=np.float32), np.ones(most + 1, dtype=np.float32),
    )  # fmt: skip
    gathered = (
        np.zeros((blocks, 4), dtype=np.int32), np.zeros((blocks, 4), dtype=np.float32),
        np.zeros((blocks, 3), dtype=np.float32), np.zeros(blocks, dtype=np.float32),
        np.zeros(blocks + 1, dtype=np.int64),
    )  # fmt: skip
    moves = (np.zeros(most, dtype=np.float32), np.zeros(most, dtype=np.float32))
    descends = push is not None
    push = SirtUpdate.zeros(1) if push is None else push
    _composite_rays(
        (pieces.ray_offsets, pieces.start, pieces.slope, pieces.step_m, pieces.count, pieces.layer),
        (F32(rules.min_transmittance), F32(rules.layer_min_transmittance)), (index, density, color), wanted, out,
        sampled, gathered, moves, tuple(push), descends,
    )  # fmt: skip


@compile_kernel(nogil=True, error_model="numpy", fastmath=True)
def _voxel_index(index, i, j, k):
    """Number of a node's voxel; 0, which is empty, where there is no brick."""
    if i >> 3 >= index.shape[0] or j >> 3 >= index.shape[1] or k >> 3 >= index.shape[2]:
        return 0
    brick = index[i >> 3, j >> 3, k >> 3]
    return brick * VOXELS_PER_BRICK + ((i & 7) << 6) + ((j & 7) << 3) + (k & 7) if brick > 0 else 0


@compile_kernel(nogil=True, error_model="numpy", fastmath=True)
def _tetrahedron_weights(index, px, py, pz, voxels, shares):
    """The four voxels about a point of the lattice, and their shares; none in an empty block."""
    px = min(max(px, F32(0)), F32(index.shape[0] * BRICK_SIZE) - F32(1e-3))
    py = min(max(py, F32(0)), F32(index.shape[1] * BRICK_SIZE) - F32(1e-3))
    pz = min(max(pz, F32(0)), F32(index.shape[2] * BRICK_SIZE) - F32(1e-3))
    i, j, k = int(px), int(py), int(pz)
    if index[i >> 3, j >> 3, k >> 3] == 0:
        voxels[:] = 0
        shares[:] = F32(0)
        return
    x, y, z = px - F32(i), py - F32(j), pz - F32(k)
    largest, smallest = max(x, y, z), min(x, y, z)
    middle = x + y + z - largest - smallest
    shares[0], shares[1] = F32(1) - largest, largest - middle
    shares[2], shares[3] = middle - smallest, smallest
    fx = 1 if x == largest else 0
    fy = 1 if fx == 0 and y == largest else 0
    lx = 0 if x == smallest else 1
    ly = 0 if lx == 1 and y == smallest else 1
    voxels[0] = _voxel_index(index, i, j, k)
    voxels[1] = _voxel_index(index, i + fx, j + fy, k + 1 - fx - fy)
    voxels[2] = _voxel_index(index, i + lx, j + ly, k + 2 - lx - ly)
    voxels[3] = _voxel_index(index, i + 1, j + 1, k + 1)


@compile_kernel(nogil=True, error_model="numpy", fastmath=True)
def _composite_ray(first, last, pieces, limits, bricks, sampled, gathered):
    """Front to back; leaves samples and pieces in the scratch arrays, returns how many pieces."""
    _, start, slope, step_m, count, layer = pieces
    ended, transmitted = limits
    index, density, color = bricks
    voxels, shares, depth, light = sampled
    color_voxels, color_shares, colors, weights, bounds = gathered
    there, sample, left, over = 0, 0, F32(1), False
    for p in range(first, last):
        if over if layer[p] == 0 else left <= transmitted:
            continue
        weight, mean = F32(0), F32(0)
        for turn in range(count[p]):
            way = F32(turn) + F32(0.5)
            _tetrahedron_weights(
                index, start[p, 0] + way * slope[p, 0], start[p, 1] + way * slope[p, 1],
                start[p, 2] + way * slope[p, 2], voxels[sample], shares[sample],
            )  # fmt: skip
            code = F32(0)
            for corner in range(4):
                code += density[voxels[sample, corner]] * shares[sample, corner]
            depth[sample] = F32(0)
            if code > F32(0.5):
                depth[sample] = np.exp(code * LOG_DENSITY_PER_CODE + MIN_LOG_DENSITY) * step_m[p]
            light[sample] = left
            seen = left * (F32(1) - np.exp(-depth[sample]))
            weight, mean, left = weight + seen, mean + seen * way, left - seen
            sample += 1
        way = mean / max(weight, F32(1e-9))
        _tetrahedron_weights(
            index, start[p, 0] + way * slope[p, 0], start[p, 1] + way * slope[p, 1],
            start[p, 2] + way * slope[p, 2], color_voxels[there], color_shares[there],
        )  # fmt: skip
        for channel in range(3):
            colors[there, channel] = F32(0)
            for corner in range(4):
                part = color[color_voxels[there, corner], channel] * color_shares[there, corner]
                colors[there, channel] += part / F32(255)
        weights[there] = weight
        there += 1
        bounds[there] = sample
        over = over or (layer[p] == 0 and left <= ended)
    light[sample] = left
    return there


@compile_kernel(nogil=True, error_model="numpy", fastmath=True)
def _back_project_color(there, gathered, error, push):
    """A ray's error on black and on white, shared among the colours that it is made of."""
    voxels, shares, _, weights, _ = gathered
    color, color_share = push[0], push[1]
    total = F32(0)
    for piece in range(there):
        total += weights[piece]
    for piece in range(there):
        for corner in range(4):
            share, voxel = shares[piece, corner] * weights[piece], voxels[piece, corner]
            for channel in range(3):
                middle = error[channel] - F32(0.5) * error[3]
                color[voxel, channel] += F32(255) * share * middle
            color_share[voxel] += share * total


@compile_kernel(nogil=True, error_model="numpy", fastmath=True)
def _back_project_density(there, sampled, gathered, moves, error, push):
    """The same among densities: how the picture on black and on white moves with each code."""
    voxels, shares, depth, light = sampled
    _, _, colors, _, bounds = gathered
    against, size = moves
    density, density_share = push[2], push[3]
    behind = np.zeros(4, dtype=np.float32)
    total = F32(0)
    for piece in range(there - 1, -1, -1):
        for sample in range(bounds[piece + 1] - 1, bounds[piece] - 1, -1):
            left = light[sample + 1]
            deeper = depth[sample] * LOG_DENSITY_PER_CODE
            alpha = deeper * (left - behind[3])
            alpha_error = error[3]
            against[sample], squares = F32(0), F32(0)
            for channel in range(3):
                move = deeper * (left * colors[piece, channel] - behind[channel])
                on_white = move - alpha
                against[sample] += move * error[channel]
                against[sample] += on_white * (error[channel] - alpha_error)
                squares += move * move + on_white * on_white
            size[sample] = np.sqrt(squares)
            total += size[sample]
            seen = light[sample] - left
            for channel in range(3):
                behind[channel] += seen * colors[piece, channel]
            behind[3] += seen
    for sample in range(bounds[there]):
        for corner in range(4):
            share, voxel = shares[sample, corner], voxels[sample, corner]
            density[voxel] += share * against[sample]
            density_share[voxel] += share * size[sample] * total


@compile_kernel(nogil=True, error_model="numpy", fastmath=True)
def _composite_rays(
    pieces, limits, bricks, wanted, out, sampled, gathered, moves, push, descends
):  # fmt: skip
    error = np.zeros(4, dtype=np.float32)
    for ray in range(len(out)):
        there = _composite_ray(
            pieces[0][ray], pieces[0][ray + 1], pieces, limits, bricks, sampled, gathered
        )
        _, _, colors, weights, bounds = gathered
        alpha = F32(1) - sampled[3][bounds[there]]
        for channel in range(3):
            total = F32(0)
            for piece in range(there):
                total += weights[piece] * colors[piece, channel]
            error[channel] = total - wanted[ray, channel]
            out[ray, channel] = total
        error[3] = alpha - wanted[ray, 3]
        out[ray, 3] = alpha
        if descends:
            _back_project_color(there, gathered, error, push)
            _back_project_density(there, sampled, gathered, moves, error, push)
