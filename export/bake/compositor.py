"""The player's compositing and its SIRT back-projection, compiled."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from avatar.kernels.kernel_compiler import NO_ALLOCATION, compile_kernel
from export.bake.traced_rays import RaySegments, TracedPicture, filter_specks
from export.package.player_tables import (
    BRICK_SIZE,
    LOG_DENSITY_RANGE,
    BrickTable,
    PlayerTables,
    RenderSettings,
)

F32 = np.float32
VOXELS_PER_BRICK = BRICK_SIZE**3
"""Voxels that a brick owns; its far border belongs to its neighbors."""
LOG_DENSITY_PER_CODE = F32((LOG_DENSITY_RANGE[1] - LOG_DENSITY_RANGE[0]) / 255.0)
"""Step of the natural logarithm of the density from one code to the next."""
MIN_LOG_DENSITY = F32(LOG_DENSITY_RANGE[0])
"""Natural logarithm of the density that code 0 would have, were it not empty."""


class VoxelCodes(NamedTuple):
    """Codes of every brick's own voxels, the empty brick's first, not yet rounded."""

    density: Float32[np.ndarray, "voxels"]
    color: Float32[np.ndarray, "voxels 3"]

    @classmethod
    def of(cls, bricks: BrickTable) -> "VoxelCodes":
        """Take a table's codes, without the borders that bricks repeat."""
        core = bricks.voxels[:, :BRICK_SIZE, :BRICK_SIZE, :BRICK_SIZE].reshape(-1, 4)
        return cls(core[:, 3].astype(np.float32), core[:, :3].astype(np.float32, order="C"))

    def chunk(self, voxels: slice) -> "VoxelCodes":
        """Return views of some voxels' codes."""
        return VoxelCodes(*(codes[voxels] for codes in self))


class SirtUpdate(NamedTuple):
    """Back-projected errors of rays, and the weights that normalize them, for each voxel.

    A step is `codes - update / (normalizer + damping)`: each ray shares its error among its samples
    (SIRT), so that nothing overshoots, however many rays see a voxel. The empty brick comes first.

    Attributes:
        color: Color codes × weights.
        color_normalizer: Squared weights.
        density: Density codes × squared colors.
        density_normalizer: Squared colors.
    """

    color: Float32[np.ndarray, "voxels 3"]
    color_normalizer: Float32[np.ndarray, "voxels"]
    density: Float32[np.ndarray, "voxels"]
    density_normalizer: Float32[np.ndarray, "voxels"]

    @classmethod
    def zeros(cls, voxels: int) -> "SirtUpdate":
        """Start a sum over rays."""
        sizes = ((voxels, 3), (voxels,), (voxels,), (voxels,))
        return cls(*(np.zeros(size, dtype=np.float32) for size in sizes))

    def add(self, other: "SirtUpdate") -> None:
        """Add the sums over other rays, in place."""
        for total, part in zip(self, other, strict=True):
            total += part

    def chunk(self, voxels: slice) -> "SirtUpdate":
        """Return views of some voxels' sums."""
        return SirtUpdate(*(sums[voxels] for sums in self))


def composite_segments(
    segments: RaySegments, settings: RenderSettings, bricks: BrickTable, codes: VoxelCodes
) -> Float32[np.ndarray, "rays 4"]:
    """Return rays' premultiplied color and alpha as the player draws them with these `codes`."""
    out = np.zeros((segments.num_rays, 4), dtype=np.float32)
    _run_kernel(segments, settings, bricks, codes, out, out, None)
    return out


def draw_traced(
    traced: TracedPicture, tables: PlayerTables, settings: RenderSettings, size_px: tuple[int, int]
) -> Float32[np.ndarray, "height width 4"]:
    """Draw a picture by its rays: premultiplied color and alpha in [0, 1]."""
    picture = np.zeros((size_px[0] * size_px[1], 4), dtype=np.float32)
    codes = VoxelCodes.of(tables.bricks)
    picture[traced.pixel] = composite_segments(traced.segments, settings, tables.bricks, codes)
    return filter_specks(picture.reshape(*size_px[::-1], 4), traced)


def back_project(
    segments: RaySegments,
    settings: RenderSettings,
    bricks: BrickTable,
    codes: VoxelCodes,
    target_colors: Float32[np.ndarray, "rays 4"],
) -> SirtUpdate:
    """Return changes of codes that let rays show their targets, premultiplied color and alpha."""
    update = SirtUpdate.zeros(len(codes.density))
    out = np.zeros_like(target_colors)
    _run_kernel(segments, settings, bricks, codes, target_colors, out, update)
    return update


def _run_kernel(
    segments: RaySegments,
    settings: RenderSettings,
    bricks: BrickTable,
    codes: VoxelCodes,
    target_colors: Float32[np.ndarray, "rays 4"],
    out: Float32[np.ndarray, "rays 4"],
    update: SirtUpdate | None,
) -> None:
    """Composite every ray into `out`; back-project its error into `update` unless that is None."""
    samples = np.concatenate([[0], np.cumsum(segments.count, dtype=np.int64)])
    most = int(np.diff(samples[segments.ray_offsets]).max(initial=0)) + 1
    blocks = int(np.diff(segments.ray_offsets).max(initial=0)) + 1
    # scratch space of one ray, for all rays in turn
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
    error_and_behind = np.zeros((2, 4), dtype=np.float32)
    _composite_rays(
        (
            segments.ray_offsets, segments.start, segments.slope, segments.step_m,
            segments.count, segments.layer,
        ),
        (F32(settings.min_transmittance), F32(settings.layer_min_transmittance)),
        (bricks.index, codes.density, codes.color), target_colors, out, sampled, gathered, moves,
        error_and_behind, tuple(SirtUpdate.zeros(1) if update is None else update),
        update is not None,
    )  # fmt: skip


@compile_kernel(**NO_ALLOCATION)
def _voxel_index(index, i, j, k):
    """Return the number of a node's voxel; 0, which is empty, where there is no brick."""
    if i >> 3 >= index.shape[0] or j >> 3 >= index.shape[1] or k >> 3 >= index.shape[2]:
        return 0
    brick = index[i >> 3, j >> 3, k >> 3]
    return brick * VOXELS_PER_BRICK + ((i & 7) << 6) + ((j & 7) << 3) + (k & 7) if brick > 0 else 0


@compile_kernel(**NO_ALLOCATION)
def _tetrahedron_weights(index, px, py, pz, voxels, shares):
    """Write the four voxels about a point of the grid and their weights; none in an empty block.

    A cell is cut into six tetrahedra along its diagonal: four corners are read, not eight, and the
    largest and the smallest fraction of the point tell which.
    """
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
    # corners 000, one step along the largest fraction, all but the smallest's, 111
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


@compile_kernel(**NO_ALLOCATION)
def _composite_ray(first, last, segments, limits, bricks, sampled, gathered):
    """Composite front to back into the scratch arrays; return the number of segments seen."""
    _, start, slope, step_m, count, layer = segments
    min_transmittance, layer_min_transmittance = limits
    index, density, color = bricks
    voxels, shares, depth, light = sampled
    color_voxels, color_shares, colors, weights, bounds = gathered
    there, sample, left, over = 0, 0, F32(1), False
    for p in range(first, last):
        if over if layer[p] == 0 else left <= layer_min_transmittance:
            continue
        weight, mean = F32(0), F32(0)
        for turn in range(count[p]):
            way = F32(turn) + F32(0.5)
            _tetrahedron_weights(
                index, start[p, 0] + way * slope[p, 0], start[p, 1] + way * slope[p, 1],
                start[p, 2] + way * slope[p, 2], voxels[sample], shares[sample],
            )  # fmt: skip
            # below half a code the interpolated density counts as empty
            code = F32(0)
            for corner in range(4):
                code += density[voxels[sample, corner]] * shares[sample, corner]
            depth[sample] = F32(0)
            if code > F32(0.5):
                depth[sample] = np.exp(code * LOG_DENSITY_PER_CODE + MIN_LOG_DENSITY) * step_m[p]
            # weight T (1 - exp(-σ Δ)) of the transmittance T, of which the rest is left
            light[sample] = left
            seen = left * (F32(1) - np.exp(-depth[sample]))
            weight, mean, left = weight + seen, mean + seen * way, left - seen
            sample += 1
        # one color per segment, read at the mean position of what is seen of it
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
        over = over or (layer[p] == 0 and left <= min_transmittance)
    light[sample] = left
    return there


@compile_kernel(**NO_ALLOCATION)
def _back_project_color(there, gathered, error, update):
    """Add a ray's error on black and on white to the colors that it is made of.

    The squared error is quadratic in colors, so this is its exact gradient × 255² / 4.
    """
    voxels, shares, _, weights, _ = gathered
    color, color_normalizer = update[0], update[1]
    total = F32(0)
    for segment in range(there):
        total += weights[segment]
    for segment in range(there):
        for corner in range(4):
            share, voxel = shares[segment, corner] * weights[segment], voxels[segment, corner]
            for channel in range(3):
                # mean of the errors on black, e, and on white, e - e_alpha
                middle = error[channel] - F32(0.5) * error[3]
                color[voxel, channel] += F32(255) * share * middle
            color_normalizer[voxel] += share * total


@compile_kernel(**NO_ALLOCATION)
def _back_project_density(there, sampled, gathered, moves, error, behind, update):
    """Add a ray's error on black and on white to the densities that it passes.

    Back to front: a sample's density adds its own color and takes away from all that is behind.
    """
    voxels, shares, depth, light = sampled
    _, _, colors, _, bounds = gathered
    # against: error × derivative; size: norm of the derivative, by which SIRT shares the error
    against, size = moves
    density, density_normalizer = update[2], update[3]
    behind[:] = F32(0)
    total = F32(0)
    for segment in range(there - 1, -1, -1):
        for sample in range(bounds[segment + 1] - 1, bounds[segment] - 1, -1):
            # d color / d code = d(σ Δ)/d code · (T behind the sample · its color - all behind it);
            # alpha is the channel whose color is 1
            left = light[sample + 1]
            deeper = depth[sample] * LOG_DENSITY_PER_CODE
            alpha = deeper * (left - behind[3])
            alpha_error = error[3]
            against[sample], squares = F32(0), F32(0)
            for channel in range(3):
                move = deeper * (left * colors[segment, channel] - behind[channel])
                on_white = move - alpha
                against[sample] += move * error[channel]
                against[sample] += on_white * (error[channel] - alpha_error)
                squares += move * move + on_white * on_white
            size[sample] = np.sqrt(squares)
            total += size[sample]
            seen = light[sample] - left
            for channel in range(3):
                behind[channel] += seen * colors[segment, channel]
            behind[3] += seen
    for sample in range(bounds[there]):
        for corner in range(4):
            share, voxel = shares[sample, corner], voxels[sample, corner]
            density[voxel] += share * against[sample]
            density_normalizer[voxel] += share * size[sample] * total


@compile_kernel(**NO_ALLOCATION)
def _composite_rays(
    segments, limits, bricks, targets, out, sampled, gathered, moves, error_and_behind, update,
    back_projects,
):  # fmt: skip
    error, behind = error_and_behind[0], error_and_behind[1]
    for ray in range(len(out)):
        there = _composite_ray(
            segments[0][ray], segments[0][ray + 1], segments, limits, bricks, sampled, gathered
        )
        _, _, colors, weights, bounds = gathered
        alpha = F32(1) - sampled[3][bounds[there]]
        for channel in range(3):
            total = F32(0)
            for segment in range(there):
                total += weights[segment] * colors[segment, channel]
            error[channel] = total - targets[ray, channel]
            out[ray, channel] = total
        error[3] = alpha - targets[ray, 3]
        out[ray, 3] = alpha
        if back_projects:
            _back_project_color(there, gathered, error, update)
            _back_project_density(there, sampled, gathered, moves, error, behind, update)
