"""The backend of compiled kernels for the CPU."""

import threading
from typing import final

import numpy as np
import torch
from jaxtyping import Float32, Int32, Int64

from avatar.kernels import (
    numba_correspondence,
    numba_hash_grid,
    numba_pose,
    numba_rendering,
    numba_shading,
)
from avatar.kernels.backend_protocol import (
    Backend,
    HashLevels,
    RaySamples,
    SkinningVolume,
    SolvedCorrespondences,
)

_SCRATCH = threading.local()
MAX_REUSED_SAMPLES = 1 << 20
"""Room for more samples than this is given back at once."""


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


def _skinning_arrays(
    skin: SkinningVolume,
) -> tuple[
    Float32[np.ndarray, "nodes 24"],
    tuple[int, ...],
    Float32[np.ndarray, "3"],
    Float32[np.ndarray, "3"],
]:
    nodes = skin.weights.numpy().reshape(-1, skin.weights.shape[3])
    return nodes, tuple(skin.weights.shape[:3]), skin.low.numpy(), skin.nodes_per_m.numpy()


def _scratch_samples(
    rays: int, max_samples: int
) -> tuple[Float32[np.ndarray, "rays most 3"], Int32[np.ndarray, "rays most"]]:
    """Room for the samples of rays before they are packed; what a thread asked for last, if small.

    Fresh memory costs a page fault for every 4 KiB: a third of a march of one-sample rays.
    """
    key, room = getattr(_SCRATCH, "room", (None, None))
    if room is None or key != (rays, max_samples):
        room = (
            np.empty((rays, max_samples, 3), dtype=np.float32),
            np.empty((rays, max_samples), dtype=np.int32),
        )
        _SCRATCH.room = (
            ((rays, max_samples), room)
            if rays * max_samples <= MAX_REUSED_SAMPLES
            else (None, None)
        )
    return room


@final
class NumbaBackend(Backend):
    """Calls numba kernels on torch's CPU memory; `Backend` states shapes and meanings.

    Only the trainer's thread may call them, except for the serial `solve_correspondences`.
    """

    name = "numba"

    def encode(self, points, table, levels):
        features = torch.empty(len(points), levels.feature_width)
        numba_hash_grid.encode(
            points.numpy(), *_level_arrays(levels), table.detach().numpy(), features.numpy()
        )
        return features

    def encode_backward(self, points, grad_features, levels, grad_table):
        numba_hash_grid.encode_backward(
            points.numpy(), *_level_arrays(levels), grad_features.numpy(), grad_table.numpy()
        )

    def adam_step(self, how, grad, mean, square, parameter):
        (first, second), (rate, scale) = how.betas, how.scales
        numba_hash_grid.adam_step(
            *(part.detach().view(-1).numpy() for part in (grad, mean, square, parameter)),
            *map(np.float32, (rate, 1.0 - first, 1.0 - second, scale, how.eps)),
        )

    def solve_correspondences(self, rig, bones, band_m, cell_m, device):
        return SolvedCorrespondences(
            *numba_correspondence.solve_correspondences(rig, bones, band_m, cell_m)
        )

    def march_resumable(self, rays, cells, grid, how):
        padded, padded_rows = _scratch_samples(len(rays.slots), how.max_samples)
        count, reached = torch.empty(2, len(rays.slots), dtype=torch.int32)
        first = torch.empty(len(rays.slots), dtype=torch.int64)
        numba_rendering.march(
            *(part.numpy() for part in rays), np.float32(how.sample_step_m),
            *(part.numpy() for part in cells[:4]), np.float32(cells.cell_m),
            *(part.numpy() for part in grid), how.opaque_margin_steps, padded, padded_rows,
            count.numpy(), reached.numpy(),
        )  # fmt: skip
        total = numba_rendering.prefix_sum(count.numpy(), first.numpy())
        points, rows = torch.empty(total, 3), torch.empty(total, dtype=torch.int32)
        numba_rendering.pack_samples(
            padded, padded_rows, first.numpy(), count.numpy(), points.numpy(), rows.numpy()
        )
        return RaySamples(points, first, count, rows), rays.jitter + reached

    def composite(self, raw, samples, step_m):
        rendered = torch.empty(len(samples.counts), 4)
        numba_rendering.composite(
            raw.numpy(), samples.offsets.numpy(), samples.counts.numpy(), np.float32(step_m),
            rendered.numpy(),
        )  # fmt: skip
        return rendered

    def composite_loss(self, raw, samples, step_m, target, alpha_weight, hard_weight):
        rendered, loss = torch.empty(len(samples.counts), 4), torch.empty(len(samples.counts))
        grad = torch.empty_like(raw)
        numba_rendering.composite_loss(
            raw.numpy(), samples.offsets.numpy(), samples.counts.numpy(), np.float32(step_m),
            target.numpy(), np.float32(alpha_weight), np.float32(hard_weight),
            rendered.numpy(), loss.numpy(), grad.numpy(),
        )  # fmt: skip
        return rendered, loss, grad

    def mean_normals(self, raw, samples, step_m, slots, cells, volume):
        mean = torch.empty(len(slots), 3)
        numba_shading.mean_normals(
            raw.numpy(), samples.points.numpy(), samples.offsets.numpy(), samples.counts.numpy(),
            samples.root_rows.numpy(), slots.numpy(), cells.roots.numpy(), np.float32(step_m),
            *(part.numpy() for part in volume), mean.numpy(),
        )  # fmt: skip
        return mean

    def scatter_max_density(self, points, log_density, grid):
        numba_rendering.scatter_max_density(
            points.numpy(), log_density.numpy(), grid.low.numpy(), grid.cells_per_m.numpy(),
            grid.density.numpy(),
        )  # fmt: skip

    def encode_points_backward(self, points, grad_features, table, levels):
        grad = torch.empty_like(points)
        numba_hash_grid.encode_points_backward(
            points.numpy(), *_level_arrays(levels), table.detach().numpy(), grad_features.numpy(),
            grad.numpy(),
        )  # fmt: skip
        return grad

    def bone_wrenches(self, samples, grad_points, slots, cells, skin, bones):
        out = torch.zeros(len(slots), 24, 6)
        numba_pose.bone_wrenches(
            samples.points.numpy(), grad_points.numpy(), samples.root_rows.numpy(),
            samples.offsets.numpy(), samples.counts.numpy(), slots.numpy(), cells.roots.numpy(),
            *_skinning_arrays(skin), bones.numpy(), out.numpy(),
        )  # fmt: skip
        return out

    def update_roots(self, cells, slot, skin, bones):
        numba_pose.update_roots(
            cells.packed_cells[slot].numpy(), cells.shape[slot].numpy(), cells.low[slot].numpy(),
            np.float32(cells.cell_m), cells.roots[slot].numpy(),
            *_skinning_arrays(skin), bones.numpy(),
        )  # fmt: skip
