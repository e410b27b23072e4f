"""The compiled CPU twins behind the common seam."""

from typing import final

import numpy as np
import torch

from avatar.kernels import cpu_composite, cpu_grid, cpu_march, cpu_pose
from avatar.kernels.backend import Samples
from avatar.levels import HashLevels


def _levels(levels: HashLevels):
    return levels.low, levels.cells_per_m, levels.counts, levels.dense, levels.offsets


@final
class NumbaBackend:
    """Numba kernels on torch's CPU memory. Only the trainer's thread may call them."""

    name = "numba"

    def encode(self, points, table, levels):  # noqa: D102 - see the protocol
        features = torch.empty(len(points), levels.width)
        cpu_grid.encode(points.numpy(), *_levels(levels), table.detach().numpy(), features.numpy())
        return features

    def encode_backward(self, points, grad_features, levels, grad_table):  # noqa: D102
        cpu_grid.encode_backward(
            points.numpy(), *_levels(levels), grad_features.numpy(), grad_table.numpy()
        )

    def march(self, rays, cells, grid, how):  # noqa: D102
        padded = np.empty((len(rays.slots), how.most, 3), dtype=np.float32)
        padded_rows = np.empty((len(rays.slots), how.most), dtype=np.int32)
        count = torch.empty(len(rays.slots), dtype=torch.int32)
        cpu_march.march(
            *(part.numpy() for part in rays), np.float32(how.step_m),
            *(part.numpy() for part in cells[:4]), np.float32(cells.cell_m),
            *(part.numpy() for part in grid), how.grace_steps, padded, padded_rows, count.numpy(),
        )  # fmt: skip
        first = torch.cumsum(count, 0) - count
        total = int(count.sum())
        points, rows = torch.empty(total, 3), torch.empty(total, dtype=torch.int32)
        cpu_march.pack(
            padded, padded_rows, first.numpy(), count.numpy(), points.numpy(), rows.numpy()
        )
        return Samples(points, first, count, rows)

    def composite(self, raw, samples, step_m):  # noqa: D102
        rendered = torch.empty(len(samples.count), 4)
        cpu_composite.composite(
            raw.numpy(), samples.first.numpy(), samples.count.numpy(), np.float32(step_m),
            rendered.numpy(),
        )  # fmt: skip
        return rendered

    def composite_loss(  # noqa: D102
        self, raw, samples, step_m, target, background, alpha_weight, hard_weight
    ):
        rendered, loss = torch.empty(len(samples.count), 4), torch.empty(len(samples.count))
        grad = torch.empty_like(raw)
        cpu_composite.composite_loss(
            raw.numpy(), samples.first.numpy(), samples.count.numpy(), np.float32(step_m),
            target.numpy(), background.numpy(), np.float32(alpha_weight),
            np.float32(hard_weight), rendered.numpy(), loss.numpy(), grad.numpy(),
        )  # fmt: skip
        return rendered, loss, grad

    def keep_highest(self, points, log_density, grid):  # noqa: D102
        cpu_march.keep_highest(
            points.numpy(), log_density.numpy(), grid.low.numpy(), grid.cells_per_m.numpy(),
            grid.density.numpy(),
        )  # fmt: skip

    def encode_points_backward(self, points, grad_features, table, levels):  # noqa: D102
        grad = torch.empty_like(points)
        cpu_pose.encode_points_backward(
            points.numpy(), *_levels(levels), table.detach().numpy(), grad_features.numpy(),
            grad.numpy(),
        )  # fmt: skip
        return grad

    def add_wrenches(self, samples, grad_points, slots, cells, skin, bones, wrenches):  # noqa: D102
        cpu_pose.add_wrenches(
            samples.points.numpy(), grad_points.numpy(), samples.rows.numpy(),
            samples.first.numpy(), samples.count.numpy(), slots.numpy(), cells.roots.numpy(),
            *(part.numpy() for part in skin), bones.numpy(), wrenches.numpy(),
        )  # fmt: skip

    def follow(self, cells, slot, skin, bones):  # noqa: D102
        cpu_pose.follow(
            cells.index[slot].numpy(), cells.shape[slot].numpy(), cells.low[slot].numpy(),
            np.float32(cells.cell_m), cells.roots[slot].numpy(),
            *(part.numpy() for part in skin), bones.numpy(),
        )  # fmt: skip
