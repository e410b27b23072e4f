"""Cells of 2³, 4³ or 8³ voxels that share one code, where pictures hardly show the difference.

Half of a person's visible voxels make up a few percent of the pictures: they lie behind others.
Every brick is an octree, pruned from its leaves wherever a cell costs more than it shows (Chou,
Lookabaugh and Gray 1989, "Optimal pruning with applications to tree-structured source coding").
Differences between the voxels of a cell are 0 and hardly take bytes.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from itertools import repeat

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from export.bake.compositor import SirtUpdate, VoxelCodes
from export.package.player_tables import BRICK_SIZE, BrickTable, round_codes
from export.package.table_codec import add_border_voxels, estimate_brick_bytes

DENSITY_STEP = 6
"""Multiple to which tuned densities are rounded: steps of 23 %."""
CHUNK_BRICKS = 64
"""Bricks in a chunk; temporary arrays of their 32,768 voxels fit into the processor's caches."""


def brick_chunks(voxels: int) -> list[slice]:
    """Divide the voxels of all bricks into chunks of whole bricks."""
    step = CHUNK_BRICKS * BRICK_SIZE**3
    return [slice(first, first + step) for first in range(0, voxels, step)]


def prune_octrees(
    codes: Float[np.ndarray, "voxels channels"], weights: Float[np.ndarray, "voxels"], price: float
) -> Int64[np.ndarray, "voxels"]:
    """Choose the cells that minimize squared error plus price times the number of cells.

    Returns the first voxel of each voxel's cell; bricks have 8³ voxels. `weights` are squared
    errors for a change of a voxel's code by 1: a cell's code is the weighted mean of its voxels'.
    Where all weights are 0, cells are as large as bricks.
    """
    bricks = len(codes) // BRICK_SIZE**3
    shape = (bricks, BRICK_SIZE, BRICK_SIZE, BRICK_SIZE)
    weight = weights.reshape(shape).astype(np.float64)
    first = weight[..., None] * codes.reshape(*shape, -1)
    second = (first * codes.reshape(*shape, -1)).sum(axis=-1)
    cost = np.full(shape, float(price))
    cells = np.arange(len(codes)).reshape(shape)
    size = 1
    while size < BRICK_SIZE:
        size *= 2
        weight, first, second, cost = (_pooled(part) for part in (weight, first, second, cost))
        square_of_mean = (first**2).sum(axis=-1) / np.maximum(weight, 1e-12)
        merged = second - square_of_mean + price
        chosen = merged <= cost
        cost = np.where(chosen, merged, cost)
        corner = cells[:, ::size, ::size, ::size]
        cells = np.where(_repeated(chosen, size), _repeated(corner, size), cells)
    return cells.ravel()


def _pooled(values: Float64[np.ndarray, "bricks *rest"]) -> Float64[np.ndarray, "bricks *half"]:
    """Sum blocks of 2³ values."""
    for axis in (1, 2, 3):
        values = np.add.reduceat(values, np.arange(0, values.shape[axis], 2), axis=axis)
    return values


def _repeated(values: np.ndarray, size: int) -> np.ndarray:
    """Repeat values of cells for each of their size³ voxels."""
    for axis in (1, 2, 3):
        values = values.repeat(size, axis=axis)
    return values


def sum_over_cells(
    values: Float32[np.ndarray, "voxels *channels"], cells: Int64[np.ndarray, "voxels"]
) -> Float32[np.ndarray, "voxels *channels"]:
    """Give each voxel the sum of its cell's values."""
    columns = values.reshape(len(cells), -1).T
    sums = [np.bincount(cells, column, len(cells))[cells] for column in columns]
    return np.stack(sums, axis=-1).astype(np.float32).reshape(values.shape)


@dataclass(frozen=True, eq=False, kw_only=True)
class VoxelCells:
    """First voxel of every voxel's cell, whose voxels share a code; bricks as in `VoxelCodes`."""

    density: Int64[np.ndarray, "voxels"]
    color: Int64[np.ndarray, "voxels"]

    def sum_update(self, update: SirtUpdate) -> SirtUpdate:
        """Give each voxel the update of its cells."""
        return SirtUpdate(
            color=sum_over_cells(update.color, self.color),
            color_normalizer=sum_over_cells(update.color_normalizer, self.color),
            density=sum_over_cells(update.density, self.density),
            density_normalizer=sum_over_cells(update.density_normalizer, self.density),
        )

    def mean_density(self, density: Float32[np.ndarray, "voxels"]) -> Float32[np.ndarray, "voxels"]:
        """Give each voxel the mean of its cell."""
        return sum_over_cells(density, self.density) / sum_over_cells(
            np.ones_like(density), self.density
        )


def choose_cells(
    codes: VoxelCodes, update: SirtUpdate, baked: Float32[np.ndarray, "voxels"], price: float
) -> VoxelCells:
    """Choose the voxels that share codes, of some bricks.

    The normalizers of `update` tell how much each voxel shows. Voxels that were empty before tuning
    (`baked`) remain apart. `price`: the squared error, 1/255², that one code more has to save.
    """
    density_weights, color_weights = _error_weights(update, baked)
    apart = np.where(baked > 0, codes.density, np.float32(-1e4))
    return VoxelCells(
        density=prune_octrees(apart[:, None], density_weights, price),
        color=prune_octrees(codes.color, color_weights, price),
    )


def share_codes(
    codes: VoxelCodes, update: SirtUpdate, baked: Float32[np.ndarray, "voxels"], cells: VoxelCells
) -> VoxelCodes:
    """Give all voxels of a cell their weighted mean; other arguments as of `choose_cells`."""
    density_weights, color_weights = _error_weights(update, baked)

    def mean(values, weight, cell):
        total = sum_over_cells(weight, cell)
        weighted = sum_over_cells(values * weight[:, None], cell)
        return weighted / np.maximum(total, np.float32(1e-12))[:, None]

    density = mean(codes.density[:, None], density_weights, cells.density)[:, 0]
    return VoxelCodes(density, mean(codes.color, color_weights, cells.color))


def _error_weights(
    update: SirtUpdate, baked: Float32[np.ndarray, "voxels"]
) -> tuple[Float32[np.ndarray, "voxels"], Float32[np.ndarray, "voxels"]]:
    """Return squared errors, 1/255², for a change of each voxel's density or color code by 1."""
    visible = baked > 0
    floor = np.where(visible, np.float32(1e-3), np.float32(0.0))  # rays
    # normalizers of densities hold the squares on black and on white, of colors in [0, 1]
    density = update.density_normalizer * np.float32(0.5 * 255.0**2)
    density = np.where(visible, density + floor, np.float32(1.0))
    return density, update.color_normalizer + floor


def share_codes_within_budget(
    bricks: BrickTable,
    codes: VoxelCodes,
    update: SirtUpdate,
    baked: Float32[np.ndarray, "voxels"],
    price: float,
    *,
    executor: Executor,
) -> list[VoxelCells]:
    """Share codes, in place, at higher prices until the package has at most 4 MB.

    Returns the cells of each of the `brick_chunks`; arguments as of `choose_cells`, for all bricks.
    """
    shared = VoxelCodes(np.empty_like(codes.density), np.empty_like(codes.color))

    def share(chunk: slice, price: float) -> VoxelCells:
        known = codes.chunk(chunk), update.chunk(chunk), baked[chunk]
        cells = choose_cells(*known, price)
        shared.density[chunk], shared.color[chunk] = share_codes(*known, cells)
        return cells

    for raised in price * 1.5 ** np.arange(24):  # the last is 10,000 times the first
        cells = list(executor.map(share, brick_chunks(len(baked)), repeat(float(raised))))
        if estimate_brick_bytes(quantize_bricks(bricks, shared, baked)) <= 3.2e6:
            break
    codes.density[:], codes.color[:] = shared
    return cells


def quantize_bricks(
    bricks: BrickTable, codes: VoxelCodes, baked: Float32[np.ndarray, "voxels"]
) -> BrickTable:
    """Round codes to stored ones; voxels that were visible before tuning (`baked`) stay visible."""
    core = np.empty((len(baked), 4), dtype=np.uint8)
    for chunk in brick_chunks(len(baked)):
        color = np.round(codes.color[chunk]).astype(np.uint8)
        density = np.round(codes.density[chunk]).astype(np.uint8)
        density = round_codes(density, DENSITY_STEP, 255)
        visible = np.maximum(density, np.uint8(DENSITY_STEP))
        core[chunk, :3] = round_codes(color, 5, 255)
        core[chunk, 3] = np.where(baked[chunk] > 0, visible, density)
    shape = (len(bricks.voxels), BRICK_SIZE, BRICK_SIZE, BRICK_SIZE, 4)
    return replace(bricks, voxels=add_border_voxels(bricks.index, core.reshape(shape)))
