"""The reference in plain torch as a backend, on any device."""

from typing import final

import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.kernels import torch_correspondence, torch_reference, torch_skinning
from avatar.kernels.backend_protocol import (
    CorrespondenceTables,
    DensityGrid,
    Features,
    HashLevels,
    HashTable,
    MarchSettings,
    Points,
    PremultipliedPixels,
    RawOutputs,
    RayBatch,
    RaySamples,
)


@final
class TorchBackend:
    """The reference itself, on any device torch knows.

    Gradients are those of sums: handed slopes, autograd would load a package of symbolic algebra.
    """

    name = "torch"
    solve_correspondences = staticmethod(torch_correspondence.solve_correspondences)
    march_resumable = staticmethod(torch_reference.march)
    mean_normals = staticmethod(torch_reference.mean_normals)
    scatter_max_density = staticmethod(torch_reference.scatter_max_density)
    bone_wrenches = staticmethod(torch_skinning.bone_wrenches)
    update_roots = staticmethod(torch_skinning.update_roots)

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

    def encode_points_backward(
        self, points: Points, grad_features: Features, table: HashTable, levels: HashLevels
    ) -> Points:
        leaf = points.detach().requires_grad_()
        with torch.enable_grad():
            features = torch_reference.encode(leaf, table.detach(), levels)
            (grad,) = torch.autograd.grad((features * grad_features).sum(), leaf)
        return grad

    def march(
        self, rays: RayBatch, cells: CorrespondenceTables, grid: DensityGrid, how: MarchSettings
    ) -> RaySamples:
        return self.march_resumable(rays, cells, grid, how)[0]

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
