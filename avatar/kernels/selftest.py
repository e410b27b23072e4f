"""Does a fast backend mean what the reference means, on this very machine?"""

import math

import numpy as np
import torch

from avatar.kernels.backend import Backend, Samples, TorchBackend
from avatar.levels import FEATURES, HashLevels

POINTS = 256
TOLERANCE = 1e-3
"""Largest difference allowed, as a share of the largest value."""


def strays(backend: Backend) -> str | None:
    """The operation in which a backend differs from the reference on 256 points, or None.

    Args:
        backend: Any but the reference itself.
    """
    generator = torch.Generator().manual_seed(0)
    levels = HashLevels.over(
        np.zeros(3, dtype=np.float32), np.array([1.0, 0.6, 0.4], dtype=np.float32),
        coarsest_m=0.2, finest_m=0.02, levels=4, table_size=1024,
    )  # fmt: skip
    table = torch.randn(levels.entries, FEATURES, generator=generator)
    points = torch.rand(POINTS, 3, generator=generator) * torch.tensor([1.0, 0.6, 0.4])
    slope = torch.randn(POINTS, levels.width, generator=generator)
    raw = torch.randn(POINTS, 4, generator=generator) + torch.tensor([0.0, 0.0, 0.0, 3.0])
    count = torch.full((16,), POINTS // 16, dtype=torch.int32)
    rows = torch.zeros(POINTS, dtype=torch.int32)
    samples = Samples(points, torch.cumsum(count, 0) - count, count, rows)
    target = torch.rand(16, 4, generator=generator)
    background = torch.rand(16, 3, generator=generator)

    def results(of: Backend) -> dict[str, torch.Tensor]:
        grad_table = torch.zeros_like(table)
        of.encode_backward(points, slope, levels, grad_table)
        rendered, loss, grad = of.composite_loss(raw, samples, 0.01, target, background, 0.1, 0.1)
        return {
            "encode": of.encode(points, table, levels),
            "encode_backward": grad_table,
            "encode_points_backward": of.encode_points_backward(points, slope, table, levels),
            "composite": of.composite(raw, samples, 0.01),
            "composite_loss": torch.cat([rendered.flatten(), loss, grad.flatten() * len(loss)]),
        }

    expected = results(TorchBackend())
    for name, values in results(backend).items():
        off = float((values - expected[name]).abs().max() / expected[name].abs().max())
        if not off <= TOLERANCE or math.isnan(off):
            return name
    return None
