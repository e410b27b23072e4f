"""Chooses the backend of a device: the fastest one that passes a self-test on this machine.

The CPU has compiled kernels for every operation (`avatar.kernels.numba_backend`); a GPU runs the
reference in plain torch. The self-test compares a backend with the reference on small inputs.
"""

import functools
import math
import os
import threading
import warnings
from typing import final

import numpy as np
import torch
from jaxtyping import Float32

from avatar.kernels import torch_correspondence, torch_reference
from avatar.kernels.backend_protocol import (
    FEATURES_PER_LEVEL,
    AdamSettings,
    Backend,
    CorrespondenceTables,
    DensityGrid,
    HashLevels,
    MarchSettings,
    RayBatch,
    RaySamples,
    SolvedCorrespondences,
)
from avatar.rig import Rig
from capture.input_error import InputError

_SELF_TEST_LOCK = threading.Lock()


@final
class TorchBackend:
    """The reference itself, on any device torch knows; `Backend` states shapes and meanings.

    Gradients are those of sums: handed slopes, autograd would load a package of symbolic algebra.
    """

    name = "torch"
    solve_correspondences = staticmethod(torch_correspondence.solve_correspondences)
    march_resumable = staticmethod(torch_reference.march)
    mean_normals = staticmethod(torch_reference.mean_normals)
    scatter_max_density = staticmethod(torch_reference.scatter_max_density)
    bone_wrenches = staticmethod(torch_correspondence.bone_wrenches)
    update_roots = staticmethod(torch_correspondence.update_roots)
    adam_step = staticmethod(torch_reference.adam_step)

    def encode(self, points, table, levels):
        with torch.no_grad():
            return torch_reference.encode(points, table, levels)

    def encode_backward(self, points, grad_features, levels, grad_table):
        table = torch.zeros_like(grad_table, requires_grad=True)
        with torch.enable_grad():
            features = torch_reference.encode(points, table, levels)
            (grad,) = torch.autograd.grad((features * grad_features).sum(), table)
        grad_table += grad

    def encode_points_backward(self, points, grad_features, table, levels):
        leaf = points.detach().requires_grad_()
        with torch.enable_grad():
            features = torch_reference.encode(leaf, table.detach(), levels)
            (grad,) = torch.autograd.grad((features * grad_features).sum(), leaf)
        return grad

    def march(self, rays, cells, grid, how):
        return self.march_resumable(rays, cells, grid, how)[0]

    def composite(self, raw, samples, step_m):
        with torch.no_grad():
            return torch_reference.composite(raw, samples.offsets, samples.counts, step_m)

    def composite_loss(self, raw, samples, step_m, target, alpha_weight, hard_weight):
        leaf = raw.detach().requires_grad_()
        with torch.enable_grad():
            rendered = torch_reference.composite(leaf, samples.offsets, samples.counts, step_m)
            loss = torch_reference.loss_per_ray(rendered, target, alpha_weight, hard_weight)
            (grad,) = torch.autograd.grad(loss.mean(), leaf)
        return rendered.detach(), loss.detach(), grad


def backend_for(device: torch.device) -> Backend:
    """The fastest backend of a device; `IA_BACKEND=torch|numba` forces one.

    Raises:
        InputError: If the forced backend is unknown or cannot run on the device.
    """
    forced = os.environ.get("IA_BACKEND", "")
    if forced not in ("", "torch", "numba"):
        raise InputError(
            f"The variable IA_BACKEND is {forced!r}; expected 'torch' or 'numba', or leave it out."
        )
    if forced == "numba" and device.type != "cpu":
        raise InputError(
            f"IA_BACKEND=numba runs on the CPU only, not on {device}. "
            "Leave it out, or give --device cpu."
        )
    if device.type == "cpu" and forced != "torch":
        with _SELF_TEST_LOCK:  # kernels must not run in two threads at once
            if _numba_passes_self_test():
                return _numba_backend()
    # A CUDA backend goes here, after the self-test.
    return TorchBackend()


def _numba_backend() -> Backend:
    from avatar.kernels.numba_backend import NumbaBackend  # compiles at its import

    return NumbaBackend()


@functools.cache
def _numba_passes_self_test() -> bool:
    """Whether the compiled kernels agree with the reference here; tested once, with a warning."""
    operation = failing_operation(_numba_backend())
    if operation is not None:
        warnings.warn(
            f"The compiled kernel '{operation}' differs from its meaning on this machine; plain "
            "torch is used instead, many times slower. Please report it with your processor and "
            "the version of numba; IA_BACKEND=torch keeps it quiet.",
            stacklevel=3,
        )
    return operation is None


TEST_POINTS = 256
"""Points of the self-test."""
TEST_CELL_M = 0.05
"""Cell size of the self-test's correspondence grid, metres."""
RELATIVE_TOLERANCE = 1e-3
"""Largest difference from the reference, relative to the largest value."""


def failing_operation(backend: Backend) -> str | None:
    """The first operation in which a backend differs from the reference, or None.

    Args:
        backend: Backend to test.
    """
    generator = torch.Generator().manual_seed(0)
    levels = HashLevels.spanning(
        np.zeros(3, dtype=np.float32), np.array([1.0, 0.6, 0.4], dtype=np.float32),
        coarsest_m=0.2, finest_m=0.02, levels=4, table_size=1024,
    )  # fmt: skip
    table = torch.randn(levels.entries, FEATURES_PER_LEVEL, generator=generator)
    points = torch.rand(TEST_POINTS, 3, generator=generator) * torch.tensor([1.0, 0.6, 0.4])
    slope = torch.randn(TEST_POINTS, levels.feature_width, generator=generator)
    raw = torch.randn(TEST_POINTS, 4, generator=generator) + torch.tensor([0.0, 0.0, 0.0, 3.0])
    count = torch.full((16,), TEST_POINTS // 16, dtype=torch.int32)
    rows = torch.zeros(TEST_POINTS, dtype=torch.int32)
    samples = RaySamples(points, torch.cumsum(count, 0) - count, count, rows)
    target = torch.rand(16, 4, generator=generator)

    rig, bones = _bent_tube()
    canonical = torch.from_numpy(rig.seeds) * torch.tensor([1.0, 1.2, 1.2])
    cells = _solve_tables(TorchBackend(), rig, bones)

    def results(of: Backend) -> dict[str, torch.Tensor]:
        grad_table = torch.zeros_like(table)
        of.encode_backward(points, slope, levels, grad_table)
        rendered, loss, grad = of.composite_loss(raw, samples, 0.01, target, 0.1, 0.1)
        how, stepped = AdamSettings(0.1, (0.9, 0.99), 1e-15, 3), table.clone()
        of.adam_step(how, table.clone(), 0.1 * table, table.square(), stepped)
        return {
            "encode": of.encode(points, table, levels),
            "encode_backward": grad_table,
            "encode_points_backward": of.encode_points_backward(points, slope, table, levels),
            "solve_correspondences": _march_to_seeds(
                TorchBackend(), _solve_tables(of, rig, bones), rig, bones, canonical
            ),
            "march": _march_to_seeds(of, cells, rig, bones, canonical),
            "composite": of.composite(raw, samples, 0.01),
            "composite_loss": torch.cat([rendered.flatten(), loss, grad.flatten() * len(loss)]),
            "adam_step": stepped,
        }

    expected = results(TorchBackend())
    for name, values in results(backend).items():
        off = float((values - expected[name]).abs().max() / expected[name].abs().max())
        if not off <= RELATIVE_TOLERANCE or math.isnan(off):
            return name
    return None


def _bent_tube() -> tuple[Rig, Float32[np.ndarray, "24 12"]]:
    """A tube of 256 seeds along x, and bones that bend it by half a radian in its middle."""
    low, high = np.array([-0.3, -0.2, -0.2]), np.array([0.3, 0.2, 0.2])
    x = np.linspace(low[0], high[0], 25)[:, None, None]
    weights = np.zeros((25, 17, 17, 24), dtype=np.float32)
    weights[..., 1] = 1.0 / (1.0 + np.exp(-30.0 * x))
    weights[..., 0] = 1.0 - weights[..., 1]
    centers = np.stack(
        np.meshgrid(*(np.linspace(-0.95, 0.95, 20) * side for side in high), indexing="ij"), axis=-1
    )
    off_axis = np.linalg.norm(centers[..., 1:], axis=-1)
    turn, along = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 16, False), np.linspace(-0.2, 0.2, 16))
    seeds = np.stack([along, 0.05 * np.cos(turn), 0.05 * np.sin(turn)], axis=-1).reshape(-1, 3)
    rig = Rig(
        rest_joints=np.zeros((24, 3)), parents=np.full(24, -1),
        canonical_rotations=np.zeros((23, 3)),
        box_low=low.astype(np.float32), box_high=high.astype(np.float32), weights=weights,
        skin_distance=np.abs(off_axis - 0.05).astype(np.float32), inside_skin=off_axis < 0.05,
        seeds=seeds.astype(np.float32),
        seed_parts=(seeds[:, 0] > 0.0).astype(np.int32),
        seed_normals=(seeds * (0.0, 20.0, 20.0)).astype(np.float32),
    )  # fmt: skip
    bones = np.tile(np.eye(4)[:3], (24, 1, 1))
    bones[1, :2, :2] = [[math.cos(0.5), -math.sin(0.5)], [math.sin(0.5), math.cos(0.5)]]
    return rig, bones.reshape(24, 12).astype(np.float32)


def _solve_tables(
    of: Backend, rig: Rig, bones: Float32[np.ndarray, "24 12"]
) -> CorrespondenceTables:
    built: SolvedCorrespondences = of.solve_correspondences(
        rig, bones, 0.05, TEST_CELL_M, torch.device("cpu")
    )
    return CorrespondenceTables(
        torch.from_numpy(built.packed_cells.reshape(1, -1)), torch.from_numpy(built.roots[None]),
        torch.from_numpy(built.low[None]),
        torch.tensor([built.packed_cells.shape], dtype=torch.int32), TEST_CELL_M,
    )  # fmt: skip


def _march_to_seeds(
    of: Backend,
    cells: CorrespondenceTables,
    rig: Rig,
    bones: Float32[np.ndarray, "24 12"],
    canonical: Float32[torch.Tensor, "points 3"],
) -> Float32[torch.Tensor, "points 3"]:
    """Canonical points that marching finds for skinned points; 0 where it finds none."""
    low, nodes_per_m = torch.from_numpy(rig.box_low), torch.from_numpy(rig.nodes_per_m)
    posed = torch_correspondence.skin_points(
        canonical, torch.from_numpy(rig.weights), low, nodes_per_m, torch.from_numpy(bones)
    )
    full = torch.ones(rig.skin_distance.shape)
    grid = DensityGrid(full.to(torch.uint8), full, low, torch.from_numpy(rig.cells_per_m))
    rays = RayBatch(
        posed, torch.tensor([[0.6, 0.64, 0.48]]).repeat(len(posed), 1),
        torch.zeros(len(posed), dtype=torch.int32), torch.zeros(len(posed)),
    )  # fmt: skip
    samples = of.march(rays, cells, grid, MarchSettings(9.0, math.inf, 1))
    found = torch.zeros_like(posed)
    found[samples.counts > 0] = samples.points
    return found
