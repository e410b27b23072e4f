"""The seam in plain torch: the reference, on whatever device."""

from typing import final

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from avatar.kernels import lattice, pose, reference, roots
from avatar.kernels.backend import (
    Articulations,
    Cells,
    CellTables,
    Features,
    Grid,
    Marching,
    Pixels,
    Points,
    PosedGrid,
    Raw,
    Rays,
    Samples,
    Skin,
    Table,
)
from avatar.kernels.cells import build_cells
from avatar.levels import HashLevels
from avatar.rig import Rig


@final
class TorchBackend:
    """The reference itself, on any device torch knows.

    Gradients are those of sums: handed slopes, autograd would load a package of symbolic algebra.
    """

    name = "torch"

    def encode(self, points: Points, table: Table, levels: HashLevels) -> Features:
        with torch.no_grad():
            return reference.encode(points, table, levels)

    def encode_backward(
        self, points: Points, grad_features: Features, levels: HashLevels, grad_table: Table
    ) -> None:
        table = torch.zeros_like(grad_table, requires_grad=True)
        with torch.enable_grad():
            features = reference.encode(points, table, levels)
            (grad,) = torch.autograd.grad((features * grad_features).sum(), table)
        grad_table += grad

    def build_cells(
        self,
        rig: Rig,
        bones: Float32[np.ndarray, "24 12"],
        band_m: float,
        cell_m: float,
        device: torch.device,
    ) -> Cells:
        def there(part: np.ndarray) -> Tensor:
            return torch.from_numpy(part).to(device)

        extent = rig.box_high - rig.box_low
        nodes_per_m = (np.array(rig.weights.shape[:3], dtype=np.float32) - 1) / extent
        cells_per_m = np.array(rig.distance.shape, dtype=np.float32) / extent
        volume = there(rig.weights), there(rig.box_low), there(nodes_per_m), there(bones)
        built = build_cells(
            volume, there(rig.seeds), there(rig.seed_parts), there(rig.distance),
            there(cells_per_m), band_m, cell_m,
        )  # fmt: skip
        return Cells(*(part.cpu().numpy() for part in built))

    def march(self, rays: Rays, cells: CellTables, grid: Grid, how: Marching) -> Samples:
        return self.march_on(rays, cells, grid, how)[0]

    def march_on(
        self, rays: Rays, cells: CellTables, grid: Grid, how: Marching
    ) -> tuple[Samples, Float32[Tensor, "rays"]]:
        points, rows, count, reached = reference.march(
            *rays, how.step_m, *cells, *grid, how.grace_steps, how.most
        )
        samples = Samples(points, torch.cumsum(count, 0) - count, count, rows)
        return samples, rays.jitter + reached

    def composite(self, raw: Raw, samples: Samples, step_m: float) -> Pixels:
        with torch.no_grad():
            return reference.composite(raw, samples.first, samples.count, step_m)

    def composite_loss(
        self,
        raw: Raw,
        samples: Samples,
        step_m: float,
        target: Pixels,
        background: Float32[Tensor, "rays 3"],
        alpha_weight: float,
        hard_weight: float,
    ) -> tuple[Pixels, Float32[Tensor, "rays"], Raw]:
        leaf = raw.detach().requires_grad_()
        with torch.enable_grad():
            rendered = reference.composite(leaf, samples.first, samples.count, step_m)
            loss = reference.loss_per_ray(rendered, target, background, alpha_weight, hard_weight)
            (grad,) = torch.autograd.grad(loss.mean(), leaf)
        return rendered.detach(), loss.detach(), grad

    def keep_highest(
        self, points: Points, log_density: Float32[Tensor, "points"], grid: Grid
    ) -> None:
        reference.keep_highest(points, log_density, grid.low, grid.cells_per_m, grid.density)

    def encode_points_backward(
        self, points: Points, grad_features: Features, table: Table, levels: HashLevels
    ) -> Points:
        leaf = points.detach().requires_grad_()
        with torch.enable_grad():
            features = reference.encode(leaf, table.detach(), levels)
            (grad,) = torch.autograd.grad((features * grad_features).sum(), leaf)
        return grad

    def wrenches(
        self,
        samples: Samples,
        grad_points: Float32[Tensor, "samples 3"],
        slots: Int32[Tensor, "rays"],
        cells: CellTables,
        skin: Skin,
        bones: Float32[Tensor, "slots 24 12"],
    ) -> Float32[Tensor, "rays 24 6"]:
        ray = torch.arange(len(slots), device=slots.device).repeat_interleave(samples.count)
        slot = slots[ray].long()
        roots = cells.roots[slot, samples.rows.long()]
        wrench = pose.wrenches(samples.points, grad_points, roots, bones[slot], *skin)
        return wrench.new_zeros(len(slots), 24, 6).index_add_(0, ray, wrench)

    def follow(
        self, cells: CellTables, slot: int, skin: Skin, bones: Float32[Tensor, "24 12"]
    ) -> None:
        nx, ny, nz = cells.shape[slot].tolist()
        index = cells.index[slot, : nx * ny * nz].view(nx, ny, nz)
        pose.follow(index, cells.low[slot], cells.cell_m, cells.roots[slot], *skin, bones)

    def place(
        self, rays: Rays, grid: PosedGrid, step_m: float
    ) -> tuple[Float32[Tensor, "samples 3"], Int32[Tensor, "rays"]]:
        return lattice.place(*rays, step_m, *grid)

    def find_roots(
        self,
        points: Float32[Tensor, "points 3"],
        slots: Int32[Tensor, "points"],
        poses: Articulations,
    ) -> tuple[Float32[Tensor, "points starts 3"], Bool[Tensor, "points starts"]]:
        return roots.find_all(points, slots, *poses)
