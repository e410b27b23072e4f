"""The operations of a training step: one function each, which runs a compiled kernel on the CPU.

Shapes and meanings are stated here; the kernels (`numba_*`) take plain arrays. Kernels for a
graphics card would be a second module of these functions. `baselines.torch_reference` and
`baselines.torch_correspondence` say the same in plain torch, and a test compares both.
"""

import itertools
import threading
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from avatar.kernels import (
    numba_field,
    numba_hash_grid,
    numba_pose,
    numba_rendering,
    numba_shading,
    numba_training_step,
)
from avatar.kernels.operands import (
    HIDDEN_WIDTH,
    AdamArrays,
    AdamSettings,
    CorrespondenceTables,
    DensityGrid,
    FeatureGradients,
    Features,
    HashLevels,
    HashTable,
    LearntRays,
    LitSkin,
    LossSettings,
    MarchSettings,
    NetworkGradients,
    NetworkLayers,
    NormalVolume,
    Points,
    PosedBones,
    PremultipliedPixels,
    PriorPoints,
    RawOutputs,
    RayBatch,
    RaySamples,
    SkinningVolume,
)
from avatar.kernels.threads import run_blocks, run_threads

_SCRATCH = threading.local()
NO_POSES = PosedBones(
    SkinningVolume(torch.zeros(0, 0, 0, 24), torch.zeros(3), torch.zeros(3)),
    torch.zeros(0, 24, 12), levels=0,
)  # fmt: skip
"""Stands for the poses of a step that computes no wrenches."""


def field_forward(
    points: Points, table: HashTable, levels: HashLevels, network: NetworkLayers
) -> tuple[Features, RawOutputs]:
    """Hash-grid features and raw outputs."""
    rows = -(-len(points) // 4) * 4
    features, raw = torch.empty(rows, levels.feature_width), torch.empty(len(points), 4)
    *layers, _ = _network_arrays(network)
    run_threads(
        numba_field.forward,
        points.numpy(), *_level_arrays(levels), table.detach().numpy(), *layers,
        features.numpy(), raw.numpy(),
    )  # fmt: skip
    return features[: len(points)], raw


def learn(
    rays: RayBatch,
    target: PremultipliedPixels,
    world_from_body: Float32[Tensor, "rays 3 3"],
    samples: RaySamples,
    cells: CorrespondenceTables,
    priors: PriorPoints,
    skin: LitSkin,
    poses: PosedBones | None,
    seed: int,
    table: HashTable,
    levels: HashLevels,
    network: NetworkLayers,
    how: LossSettings,
    *,
    is_frozen: bool = False,
) -> LearntRays:
    """Renders rays, and propagates the gradients of their mean loss and of the priors.

    The losses are InstantAvatar's (§3.4): Huber on color, L1 on alpha, hard surface.

    Args:
        target, world_from_body: Pixels and rotations of the rays.
        priors: Points at which priors hold, and their weights.
        poses: Poses for which wrenches are computed; none if None.
        seed: Of the draw of the gradients that are propagated, below 2³².
        is_frozen: Leaves the gradients of the network out.
    """
    bones = poses or NO_POSES
    lists = samples.points, *priors.lists
    points = torch.cat(lists)
    ends = np.array(list(itertools.accumulate(part.shape[0] for part in lists)))
    count, total, width = len(rays.slots), len(points), levels.feature_width
    blocks = len(priors.lists) - (-count // numba_training_step.RAYS_PER_BLOCK)
    raw, grad_raw = np.empty((2, total, 4), dtype=np.float32)
    rendered, loss = np.empty((count, 4), np.float32), np.empty(count, np.float32)
    normals = np.empty((count, 3), np.float32)
    wrenches = np.empty((count if poses else 0, 24, 6), np.float32)
    rows, grad_features = np.empty(total, np.int64), np.empty((total, width), np.float32)
    runs, strengths = np.empty((blocks, 2), np.int64), np.empty(blocks, np.float32)
    # each block's sums of the gradients of W₁, W₂ᵀ and both biases; no rows if frozen
    sums = np.empty((blocks, 0 if is_frozen else width + 6, HIDDEN_WIDTH), dtype=np.float32)
    run_blocks(
        numba_training_step.learn,
        (
            np.float32(how.sample_step_m), np.float32(how.alpha_weight),
            np.float32(how.hard_surface_weight), np.float32(how.faint), np.uint32(seed),
            skin.is_needed,
        ),
        (
            points.numpy(), samples.offsets.numpy(), samples.counts.numpy(),
            samples.root_rows.numpy(),
        ),
        (rays.slots.numpy(), target.numpy(), world_from_body.numpy(), cells.roots.numpy()),
        (
            *(part.numpy() for part in skin.volume), skin.light.numpy(),
            *map(np.float32, (skin.min_length, *skin.bounds)),
        ),
        (ends, priors.pair_weights.numpy(), priors.weights, np.float32(priors.max_slope_per_m)),
        (table.detach().numpy(), *_network_arrays(network)),
        _level_arrays(levels),
        bones.levels,
        (*_skinning_arrays(bones.skinning), bones.bones.numpy()),
        (raw, grad_raw, rendered, loss, normals, wrenches),
        (rows, grad_features, runs),
        (sums, strengths),
    )  # fmt: skip
    return LearntRays(
        points=points,
        log_density=torch.from_numpy(raw[: len(samples.points), 3]),
        rendered=torch.from_numpy(rendered),
        loss=torch.from_numpy(loss),
        normals=torch.from_numpy(normals),
        wrenches=torch.from_numpy(wrenches),
        network=None if is_frozen else _network_gradients(sums, width),
        features=FeatureGradients(rows, grad_features, runs),
        strength=float(strengths.sum()) / max(total, 1),
    )


def add_table_gradient(
    points: Points, features: FeatureGradients, levels: HashLevels, grad_table: HashTable
) -> None:
    """Adds the table's gradient to `grad_table`; `features` are of rows of all `points`."""
    rows, grad_features, runs = features
    run_threads(
        numba_hash_grid.encode_backward, points.numpy(), rows, runs, *_level_arrays(levels),
        grad_features, grad_table.numpy(),
    )  # fmt: skip


def _network_arrays(
    network: NetworkLayers,
) -> tuple[
    Float32[np.ndarray, "width hidden"],
    Float32[np.ndarray, "1 hidden"],
    Float32[np.ndarray, "4 hidden"],
    Float32[np.ndarray, "4"],
    Float32[np.ndarray, "hidden padded"],
]:
    """W₁, b₁, W₂ᵀ, b₂, and W₁ᵀ with its width padded to a multiple of eight."""
    first, bias, second, second_bias = (part.detach().numpy() for part in network)
    width, hidden = first.shape
    transposed = np.zeros((hidden, -(-width // 8) * 8), dtype=np.float32)
    transposed[:, :width] = first.T
    return first, bias[None], np.ascontiguousarray(second.T), second_bias, transposed


def _network_gradients(
    sums: Float32[np.ndarray, "blocks rows hidden"], width: int
) -> NetworkGradients:
    """The gradients of both layers, added up in the order of the blocks."""
    total = sums.sum(axis=0)
    return total[:width], total[width + 4], total[width : width + 4].T, total[width + 5, :4]


def _level_arrays(
    levels: HashLevels,
) -> tuple[
    Float32[np.ndarray, "3"],
    Float32[np.ndarray, "levels"],
    Int32[np.ndarray, "levels 3"],
    Int32[np.ndarray, "levels"],
    Int64[np.ndarray, "levels+1"],
]:
    return levels.low, levels.cells_per_m, levels.vertex_counts, levels.is_dense, levels.offsets


def adam_step(parameters: list[tuple[AdamSettings, AdamArrays]]) -> None:
    """Takes Adam's step on parameters, in place, and zeroes their gradients."""
    flat = []
    for how, arrays in parameters:
        (first, second), (rate, scale) = how.betas, how.scales
        rates = tuple(map(np.float32, (rate, 1.0 - first, 1.0 - second, scale, how.eps)))
        flat.append((tuple(arrays), rates))
    run_blocks(numba_hash_grid.adam_step, tuple(flat))


def move_toward(means: Sequence[Tensor], values: Sequence[Tensor], share: float) -> None:
    """Moves contiguous tensors by a share of the way to others of their shapes, in place."""
    pairs = tuple(
        (mean.detach().numpy().reshape(-1), value.detach().numpy().reshape(-1))
        for mean, value in zip(means, values, strict=True)
    )
    run_threads(numba_hash_grid.move_toward, pairs, np.float32(share))


def march(
    rays: RayBatch, cells: CorrespondenceTables, grid: DensityGrid, how: MarchSettings
) -> RaySamples:
    """Canonical samples along rays."""
    return march_resumable(rays, cells, grid, how)[0]


def march_resumable(
    rays: RayBatch, cells: CorrespondenceTables, grid: DensityGrid, how: MarchSettings
) -> tuple[RaySamples, Float32[Tensor, "rays"]]:
    """Marches, and returns the jitter at which rays with `max_samples` samples continue."""
    padded, padded_rows = _scratch_samples(len(rays.slots) * how.max_samples)
    count, reached = torch.empty(2, len(rays.slots), dtype=torch.int32)
    first = torch.empty(len(rays.slots), dtype=torch.int64)
    run_blocks(
        numba_rendering.march,
        *(part.numpy() for part in rays), np.float32(how.sample_step_m),
        *(part.numpy() for part in cells[:4]), np.float32(cells.cell_m),
        *(part.numpy() for part in grid), how.opaque_margin_steps, how.max_samples, padded,
        padded_rows, count.numpy(), reached.numpy(),
    )  # fmt: skip
    total = numba_rendering.prefix_sum(count.numpy(), first.numpy())
    points, rows = torch.empty(total, 3), torch.empty(total, dtype=torch.int32)
    numba_rendering.pack_samples(
        padded, padded_rows, how.max_samples, count.numpy(), points.numpy(), rows.numpy()
    )
    return RaySamples(points, first, count, rows), rays.jitter + reached


def _scratch_samples(most: int) -> tuple[Float32[np.ndarray, "most 3"], Int32[np.ndarray, "most"]]:
    """Room for samples before they are packed; what a thread asked for last, if small.

    Fresh memory costs a page fault for every 4 KiB: a third of a march of one-sample rays.
    """
    room = getattr(_SCRATCH, "room", None)
    if room is None or len(room[1]) < most:
        room = np.empty((most, 3), dtype=np.float32), np.empty(most, dtype=np.int32)
        _SCRATCH.room = room if most <= 1 << 20 else None  # more is given back
    return room


def composite(raw: RawOutputs, samples: RaySamples, step_m: float) -> PremultipliedPixels:
    """Premultiplied color and alpha of each ray."""
    rendered = torch.empty(len(samples.counts), 4)
    run_threads(
        numba_rendering.composite,
        raw.numpy(), samples.offsets.numpy(), samples.counts.numpy(), np.float32(step_m),
        rendered.numpy(),
    )  # fmt: skip
    return rendered


def mean_normals(
    raw: RawOutputs,
    samples: RaySamples,
    step_m: float,
    slots: Int32[Tensor, "rays"],
    cells: CorrespondenceTables,
    volume: NormalVolume,
) -> Float32[Tensor, "rays 3"]:
    """Normals at the samples, in the body frame, composited like colors."""
    mean = torch.empty(len(slots), 3)
    run_threads(
        numba_shading.mean_normals,
        raw.numpy(), samples.points.numpy(), samples.offsets.numpy(), samples.counts.numpy(),
        samples.root_rows.numpy(), slots.numpy(), cells.roots.numpy(), np.float32(step_m),
        *(part.numpy() for part in volume), mean.numpy(),
    )  # fmt: skip
    return mean


def scatter_max_density(
    points: Points, log_density: Float32[Tensor, "points"], grid: DensityGrid
) -> None:
    """Raises the cached density of the samples' cells to the samples' own, in place."""
    numba_rendering.scatter_max_density(
        points.numpy(), log_density.numpy(), grid.low.numpy(), grid.cells_per_m.numpy(),
        grid.density.numpy(),
    )  # fmt: skip


def update_roots(
    cells: CorrespondenceTables,
    slots: list[int],
    skin: SkinningVolume,
    bones: Float32[Tensor, "slots 24 12"],
) -> None:
    """Moves the roots of some slots, in place, to follow their changed poses; bones are of all."""
    run_blocks(
        numba_pose.update_roots,
        np.array(slots, dtype=np.int64), cells.packed_cells.numpy(), cells.shape.numpy(),
        cells.low.numpy(), np.float32(cells.cell_m), cells.roots.numpy(),
        *_skinning_arrays(skin), bones.numpy(),
    )  # fmt: skip


def _skinning_arrays(
    skin: SkinningVolume,
) -> tuple[
    Float32[np.ndarray, "nodes 24"],
    Int32[np.ndarray, "3"],
    Float32[np.ndarray, "3"],
    Float32[np.ndarray, "3"],
]:
    nodes = skin.weights.numpy().reshape(-1, skin.weights.shape[3])
    return (
        nodes,
        np.array(skin.weights.shape[:3], dtype=np.int32),
        skin.low.numpy(),
        skin.nodes_per_m.numpy(),
    )
