"""What it means to place samples through a grid of the body frame, in plain torch."""

import math

import torch
from jaxtyping import Bool, Float32, Int32, Integer
from torch import Tensor


def sample_occupied_cells(
    origins: Float32[Tensor, "rays 3"],
    directions: Float32[Tensor, "rays 3"],
    slots: Int32[Tensor, "rays"],
    jitter: Float32[Tensor, "rays"],
    step_m: float,
    occupied: Integer[Tensor, "slots cells"] | Bool[Tensor, "slots cells"],
    low: Float32[Tensor, "slots 3"],
    cells_per_m: Float32[Tensor, "slots 3"],
    shape: Int32[Tensor, "slots 3"],
    near: Float32[Tensor, "slots 3"],
    far: Float32[Tensor, "slots 3"],
) -> tuple[Float32[Tensor, "samples 3"], Int32[Tensor, "rays"]]:
    """RaySamples `t = entry + (k + jitter) step_m` of rays, in the occupied cells of their grid.

    A ray enters the box between `near` and `far`, and ends where it leaves it. Beyond the grid its
    outermost cells count.

    Returns:
        Points of the body frame, ray by ray, and how many each ray has.
    """
    slot = slots.long()
    towards = torch.where(directions.abs() > 1e-7, directions, 1e-7)
    walls = (near[slot] - origins) / towards, (far[slot] - origins) / towards
    enter = torch.minimum(*walls).amax(dim=1).clamp(min=0.0)
    leave = torch.maximum(*walls).amin(dim=1)
    longest = float((leave - enter).max()) if len(slot) else 0.0
    steps = math.ceil(max(longest, 0.0) / step_m) + 1
    t = enter[:, None] + (torch.arange(steps, device=slot.device) + jitter[:, None]) * step_m
    points = origins[:, None] + t[..., None] * directions[:, None]
    cell = ((points - low[slot][:, None]) * cells_per_m[slot][:, None]).long().clamp(min=0)
    cell = torch.minimum(cell, shape[slot][:, None].long() - 1)
    sides = shape[slot].long()
    flat = (cell[..., 0] * sides[:, None, 1] + cell[..., 1]) * sides[:, None, 2] + cell[..., 2]
    kept = (t < leave[:, None]) & (occupied[slot[:, None], flat] > 0)
    return points[kept], kept.sum(dim=1).int()
