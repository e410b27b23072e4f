"""The seam in plain torch: the reference, on whatever device."""

from typing import final

import numpy as np
import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from avatar.deformation.rig import Rig
from avatar.kernels import torch_reference, torch_skinning
from avatar.kernels.backend_protocol import (
    CorrespondenceTables,
    DensityGrid,
    Features,
    HashTable,
    MarchSettings,
    Points,
    PremultipliedPixels,
    RawOutputs,
    RayBatch,
    RaySamples,
    SkinningVolume,
    SolvedCorrespondences,
)
from avatar.kernels.hash_levels import HashLevels
from avatar.kernels.torch_correspondence import solve_correspondences


@final
class TorchBackend:
    """The reference itself, on any device torch knows.

    Gradients are those of sums: handed slopes, autograd would load a package of symbolic algebra.
    """

    name = "torch"

    def encode(self, points: Points, table: HashTable, levels: HashLevels) -> Features:
        with torch.no_grad():
            return torch_reference.encode(points, table, levels)

    def encode_backward(
        self, points: Points, grad_features: Features, levels: HashLevels, grad_table: HashTable
    ) -> None:
        table = torch.zeros_like(grad_table, requires_grad=True)
        with torch.enable_grad():
            features = torch_reference.encode(points, table, levels)
            (grad,) = torch.autograd.grad((features * grad_features).sum(), table)
        grad_table += grad

    def solve_correspondences(
        self,
        rig: Rig,
        bones: Float32[np.ndarray, "24 12"],
        band_m: float,
        cell_m: float,
        device: torch.device,
    ) -> SolvedCorrespondences:
        def there(part: np.ndarray) -> Tensor:
            return torch.from_numpy(part).to(device)

        extent = rig.box_high - rig.box_low
        nodes_per_m = (np.array(rig.weights.shape[:3], dtype=np.float32) - 1) / extent
        cells_per_m = np.array(rig.skin_distance.shape, dtype=np.float32) / extent
        volume = there(rig.weights), there(rig.box_low), there(nodes_per_m), there(bones)
        built = solve_correspondences(
            volume, there(rig.seeds), there(rig.seed_parts), there(rig.skin_distance),
            there(cells_per_m), band_m, cell_m,
        )  # fmt: skip
        return SolvedCorrespondences(*(part.cpu().numpy() for part in built))

    def march(
        self, rays: RayBatch, cells: CorrespondenceTables, grid: DensityGrid, how: MarchSettings
    ) -> RaySamples:
        return self.march_resumable(rays, cells, grid, how)[0]

    def march_resumable(
        self, rays: RayBatch, cells: CorrespondenceTables, grid: DensityGrid, how: MarchSettings
    ) -> tuple[RaySamples, Float32[Tensor, "rays"]]:
        points, rows, count, reached = torch_reference.march(
            *rays, how.sample_step_m, *cells, *grid, how.opaque_margin_steps, how.max_samples
        )
        samples = RaySamples(points, torch.cumsum(count, 0) - count, count, rows)
        return samples, rays.jitter + reached

    def composite(self, raw: RawOutputs, samples: RaySamples, step_m: float) -> PremultipliedPixels:
        with torch.no_grad():
            return torch_reference.composite(raw, samples.offsets, samples.counts, step_m)

    def composite_loss(
        self,
        raw: RawOutputs,
        samples: RaySamples,
        step_m: float,
        target: PremultipliedPixels,
        background: Float32[Tensor, "rays 3"],
        alpha_weight: float,
        hard_weight: float,
    ) -> tuple[PremultipliedPixels, Float32[Tensor, "rays"], RawOutputs]:
        leaf = raw.detach().requires_grad_()
        with torch.enable_grad():
            rendered = torch_reference.composite(leaf, samples.offsets, samples.counts, step_m)
            loss = torch_reference.loss_per_ray(
                rendered, target, background, alpha_weight, hard_weight
            )
            (grad,) = torch.autograd.grad(loss.mean(), leaf)
        return rendered.detach(), loss.detach(), grad

    def scatter_max_density(
        self, points: Points, log_density: Float32[Tensor, "points"], grid: DensityGrid
    ) -> None:
        torch_reference.scatter_max_density(
            points, log_density, grid.low, grid.cells_per_m, grid.density
        )

    def encode_points_backward(
        self, points: Points, grad_features: Features, table: HashTable, levels: HashLevels
    ) -> Points:
        leaf = points.detach().requires_grad_()
        with torch.enable_grad():
            features = torch_reference.encode(leaf, table.detach(), levels)
            (grad,) = torch.autograd.grad((features * grad_features).sum(), leaf)
        return grad

    def bone_wrenches(
        self,
        samples: RaySamples,
        grad_points: Float32[Tensor, "samples 3"],
        slots: Int32[Tensor, "rays"],
        cells: CorrespondenceTables,
        skin: SkinningVolume,
        bones: Float32[Tensor, "slots 24 12"],
    ) -> Float32[Tensor, "rays 24 6"]:
        ray = torch.arange(len(slots), device=slots.device).repeat_interleave(samples.counts)
        slot = slots[ray].long()
        roots = cells.roots[slot, samples.root_rows.long()]
        wrench = torch_skinning.bone_wrenches(
            samples.points, grad_points, roots, bones[slot], *skin
        )
        return wrench.new_zeros(len(slots), 24, 6).index_add_(0, ray, wrench)

    def update_roots(
        self,
        cells: CorrespondenceTables,
        slot: int,
        skin: SkinningVolume,
        bones: Float32[Tensor, "24 12"],
    ) -> None:
        nx, ny, nz = cells.shape[slot].tolist()
        index = cells.packed_cells[slot, : nx * ny * nz].view(nx, ny, nz)
        torch_skinning.update_roots(
            index, cells.low[slot], cells.cell_m, cells.roots[slot], *skin, bones
        )
