"""Ray marching, hash grid, volume rendering and losses in plain, differentiable torch.

The oracle of the compiled kernels (`avatar.kernels.operations`): their constants, and the formulas
as the papers have them. The paper's training step (`instant_avatar.autograd_steps`) is built on it.
"""

import itertools
import math

import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64
from torch import Tensor

from avatar.kernels.numba_rendering import (
    ALPHA_DEAD_ZONE,
    BRIGHT_GRAY,
    COLOR_HUBER_DELTA,
    DARK_GRAY,
    OPAQUE_DEPTH,
)
from avatar.kernels.numba_shading import MIN_NORMAL_WEIGHT
from avatar.kernels.operands import (
    MAX_LOG_DENSITY,
    PRIMES,
    CorrespondenceTables,
    DensityGrid,
    HashLevels,
    MarchSettings,
    NormalVolume,
    RayBatch,
    RaySamples,
)


def encode(
    points: Float[Tensor, "points 3"],
    table: Float[Tensor, "entries 4"],
    levels: HashLevels,
) -> Float[Tensor, "points width"]:
    """Trilinear features of all levels at canonical points (Müller et al. 2022, §3).

    Args:
        points: Canonical points, metres. Outside the box the border's cells extrapolate.
        table: Entries of all levels.
        levels: Where they lie.
    """
    features = []
    for level in range(len(levels.cells_per_m)):
        counts = torch.from_numpy(levels.vertex_counts[level]).long()
        scaled = (points - torch.from_numpy(levels.low).to(points)) * float(
            levels.cells_per_m[level]
        )
        cell = torch.minimum(scaled.detach().trunc().long().clamp(min=0), counts - 2)
        within = scaled - cell
        total = 0.0
        for corner in range(8):
            offset = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
            weight = torch.where(offset.bool(), within, 1.0 - within).prod(dim=-1)
            entries = _table_entries(cell + offset, levels, level)
            total = total + weight[:, None] * table.index_select(0, entries)
        features.append(total)
    return torch.cat(features, dim=-1)


def _table_entries(
    vertices: Int64[Tensor, "points 3"], levels: HashLevels, level: int
) -> Int64[Tensor, "points"]:
    first, last = int(levels.offsets[level]), int(levels.offsets[level + 1])
    x, y, z = vertices.unbind(dim=-1)
    if levels.is_dense[level]:
        nx, ny = int(levels.vertex_counts[level, 0]), int(levels.vertex_counts[level, 1])
        return first + x + nx * (y + ny * z)
    hashed = (x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])
    return first + (hashed & (last - first - 1))


def activate(
    raw: Float[Tensor, "samples 4"],
) -> tuple[Float[Tensor, "samples 3"], Float[Tensor, "samples"]]:
    """Color in [0, 1] and density in 1/m of the network's raw outputs."""
    return torch.sigmoid(raw[:, :3]), torch.exp(raw[:, 3].clamp(max=MAX_LOG_DENSITY))


def composite(
    raw: Float[Tensor, "samples 4"],
    offsets: Int64[Tensor, "rays"],
    counts: Int32[Tensor, "rays"],
    sample_step_m: float,
) -> Float[Tensor, "rays 4"]:
    """Premultiplied color Σ T_i α_i c_i and alpha 1 - Π (1 - α_i) (InstantAvatar, eq. 4)."""
    most = max(int(counts.max()) if len(counts) else 0, 1)
    order = torch.arange(most)
    held = order < counts[:, None]
    color, density = activate(torch.cat([raw, raw.new_zeros(1, 4)]))
    index = torch.where(held, offsets[:, None] + order, len(raw))
    kept = torch.where(
        held, torch.exp(-density[index] * sample_step_m), torch.ones((), dtype=raw.dtype)
    )
    through = torch.cumprod(kept, dim=1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    weight = before * (1.0 - kept)
    premultiplied = (weight[..., None] * color[index]).sum(dim=1)
    return torch.cat([premultiplied, 1.0 - through[:, -1:]], dim=1)


def mean_normals(
    raw: Float32[Tensor, "samples 4"],
    samples: RaySamples,
    step_m: float,
    slots: Int32[Tensor, "rays"],
    cells: CorrespondenceTables,
    volume: NormalVolume,
) -> Float32[Tensor, "rays 3"]:
    """Mean normal of what each ray sees, Σ T_i α_i n_i; n is that of the skin, warped.

    Between the centers of the volume's cells, normals are interpolated.
    """
    last = torch.tensor(volume.normals.shape[:3]) - 1
    place = ((samples.points - volume.low) * volume.cells_per_m - 0.5).clamp(min=0.0)
    place = torch.minimum(place, last)
    cell = torch.minimum(place.long(), last - 1)
    normals = torch.zeros_like(samples.points)
    for corner in itertools.product((0, 1), repeat=3):
        above = torch.tensor(corner)
        share = (1.0 - (cell + above - place).abs()).prod(dim=1, keepdim=True)
        normals += share * volume.normals[(cell + above).unbind(dim=1)]
    slot = torch.repeat_interleave(slots.long(), samples.counts.long())
    warp = cells.roots[slot, samples.root_rows.long(), 3:].unflatten(1, (3, 3))
    normals = torch.nn.functional.normalize((warp * normals[:, :, None]).sum(dim=1), dim=1)
    optical = torch.exp(raw[:, 3].double().clamp(max=MAX_LOG_DENSITY)) * step_m
    until = torch.cumsum(optical, dim=0)
    ray = torch.arange(len(slots)).repeat_interleave(samples.counts)
    before = until - optical
    before = before - torch.cat([before, before.new_zeros(1)])[samples.offsets][ray]
    weight = torch.exp(-before) * (1.0 - torch.exp(-optical))
    weight = weight * (weight > MIN_NORMAL_WEIGHT)
    mean = normals.new_zeros(len(slots), 3)
    return mean.index_add_(0, ray, weight.to(mean)[:, None] * normals)


def loss_per_ray(
    rendered: Float[Tensor, "rays 4"],
    target: Float[Tensor, "rays 4"],
    alpha_weight: float,
    hard_weight: float,
) -> Float[Tensor, "rays"]:
    """InstantAvatar's losses (§3.4): Huber on color, L1 on alpha, hard surface.

    Both pictures are composited over the same gray, one of two, whose mean stands for the paper's
    random background; it makes half-transparency costly. Huber (δ = 0.1) is divided by δ and summed
    over channels; L1 has a dead zone of 1e-3; hard surface is -log(exp(-α) + exp(α - 1)).

    Args:
        rendered: Premultiplied color and alpha.
        target: The same of the video.
        alpha_weight, hard_weight: Weights of the last two.
    """
    alpha, truth = rendered[:, 3:], target[:, 3:]
    grays = alpha.new_tensor([DARK_GRAY, BRIGHT_GRAY])[:, None, None]
    size = (rendered[:, :3] - target[:, :3] + (truth - alpha) * grays).abs()
    huber = torch.where(
        size <= COLOR_HUBER_DELTA, 0.5 * size**2 / COLOR_HUBER_DELTA, size - 0.5 * COLOR_HUBER_DELTA
    ).sum(dim=2).mean(dim=0)  # fmt: skip
    off = ((alpha - truth).abs() - ALPHA_DEAD_ZONE).clamp(min=0.0)[:, 0]
    hard = -torch.log(torch.exp(-alpha) + torch.exp(alpha - 1.0))[:, 0]
    return huber + alpha_weight * off + hard_weight * hard


def march(
    rays: RayBatch, cells: CorrespondenceTables, grid: DensityGrid, how: MarchSettings
) -> tuple[RaySamples, Float32[Tensor, "rays"]]:
    """Canonical samples along rays, and the jitter at which full rays continue.

    Samples lie on the lattice `t = entry + (k + jitter) sample_step_m`. A sample is kept if its
    cell has a root whose canonical cell is occupied; of several roots the one of highest cached
    density is used. A ray ends `opaque_margin_steps` samples after its cached optical depth passes
    `OPAQUE_DEPTH`, or after `max_samples` samples.
    """
    origins, directions, slots, jitter = rays
    cell_index, cell_roots, cell_low, cell_shape, cell_m = cells
    sample_step_m = how.sample_step_m
    slot = slots.long()
    shape = cell_shape[slot]
    towards = torch.where(directions.abs() > 1e-7, directions, 1e-7)
    near = (cell_low[slot] - origins) / towards
    far = near + shape * cell_m / towards
    enter = torch.minimum(near, far).amax(dim=1).clamp(min=0.0)
    leave = torch.maximum(near, far).amin(dim=1)
    steps = math.ceil(max(float((leave - enter).max()), 0.0) / sample_step_m) + 1
    t = enter[:, None] + (torch.arange(steps) + jitter[:, None]) * sample_step_m
    inside = t < leave[:, None]
    position = origins[:, None] + t[..., None] * directions[:, None]
    local = position - cell_low[slot][:, None]
    cell = torch.minimum((local / cell_m).long().clamp(min=0), shape[:, None] - 1)
    flat = (cell[..., 0] * shape[:, None, 1] + cell[..., 1]) * shape[:, None, 2] + cell[..., 2]
    packed = torch.where(inside, cell_index[slot[:, None], flat], 0).clamp(min=0)
    offset = local - (cell + 0.5) * cell_m

    best = torch.full_like(t, -1.0)
    points = torch.zeros_like(position)
    rows = torch.zeros_like(packed)
    for candidate in range(3):
        exists = (packed & 3) > candidate
        row = root_row(packed, candidate)
        canonical = canonical_points(cell_roots, slot[:, None], row, packed & 4 > 0, offset)
        cached, kept = _cached_density(canonical, grid)
        better = exists & kept & (cached > best)
        best = torch.where(better, cached, best)
        rows = torch.where(better, row, rows)
        points = torch.where(better[..., None], canonical, points)

    kept = best >= 0.0
    opaque = torch.cumsum(best.clamp(min=0.0) * sample_step_m, dim=1) > OPAQUE_DEPTH
    counted = (opaque & kept).int()
    kept &= torch.cumsum(counted, dim=1) - counted <= how.opaque_margin_steps
    kept &= torch.cumsum(kept.int(), dim=1) <= how.max_samples
    after = torch.arange(1, steps + 1) * kept
    count = kept.sum(dim=1).int()
    samples = RaySamples(points[kept], torch.cumsum(count, 0) - count, count, rows[kept].int())
    return samples, jitter + after.amax(dim=1).int()


def root_row(packed: Int32[Tensor, "*cells"], candidate: int) -> Int32[Tensor, "*cells"]:
    """Row of a cell's candidate root; the unused row 0 where the cell has no such root."""
    row = (packed >> 3) + candidate * torch.where(packed & 4 > 0, 3, 1)
    return torch.where((packed & 3) > candidate, row, 0).int()


def canonical_points(
    roots: Float32[Tensor, "slots roots 12"],
    slot: Int64[Tensor, "*#points"],
    row: Int32[Tensor, "*points"],
    bent: Bool[Tensor, "*points"],
    offset: Float32[Tensor, "*points 3"],
) -> Float32[Tensor, "*points 3"]:
    """Canonical points at an offset from the centers of cells.

    x* + A d, plus Σ c_ij d_i d_j in bent cells (`CorrespondenceGrid.roots`).
    """
    root = roots[slot, row.long()]
    straight = root[..., :3] + (root[..., 3:].unflatten(-1, (3, 3)) @ offset[..., None])[..., 0]
    x, y, z = offset.unbind(dim=-1)
    products = torch.stack([x * x, y * y, z * z, x * y, x * z, y * z], dim=-1)
    after = torch.where(bent, row, 0).long()  # what is not bent has no rows of its own there
    more = torch.cat([roots[slot, after + bent], roots[slot, after + 2 * bent, :6]], dim=-1)
    bend = (products[..., None] * more.unflatten(-1, (6, 3))).sum(dim=-2)
    return torch.where(bent[..., None], straight + bend, straight)


def _cached_density(
    points: Float32[Tensor, "rays steps 3"], grid: DensityGrid
) -> tuple[Float32[Tensor, "rays steps"], Bool[Tensor, "rays steps"]]:
    """Cached density of the canonical cells that hold the points, and which are occupied."""
    shape = torch.tensor(grid.occupied.shape)
    cell = torch.floor((points - grid.low) * grid.cells_per_m).long()
    inside = ((cell >= 0) & (cell < shape)).all(dim=-1)
    x, y, z = torch.minimum(cell.clamp(min=0), shape - 1).unbind(dim=-1)
    return grid.density[x, y, z], inside & (grid.occupied[x, y, z] != 0)


def scatter_max_density(
    points: Float32[Tensor, "points 3"], log_density: Float32[Tensor, "points"], grid: DensityGrid
) -> None:
    """Raises, in place, the cached density of each sample's cell to the sample's own."""
    shape = torch.tensor(grid.density.shape)
    cell = ((points - grid.low) * grid.cells_per_m).long()
    inside = ((cell >= 0) & (cell < shape)).all(dim=1)
    x, y, z = cell[inside].unbind(dim=1)
    flat = (x * grid.density.shape[1] + y) * grid.density.shape[2] + z
    here = torch.exp(log_density[inside].clamp(max=MAX_LOG_DENSITY))
    grid.density.view(-1).scatter_reduce_(0, flat, here, "amax")
