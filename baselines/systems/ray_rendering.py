"""Rays sampled where a body is near, and composited: the same for every method."""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from avatar.kernels.operands import MAX_LOG_DENSITY
from baselines.systems.posed_person import OccupiedCells, PosedBodies

PROBES_PER_RAY = 64
"""Points at which a ray looks for occupied cells, between the sides of a body's box."""


class BodyRays(NamedTuple):
    """Rays in the body frames of their bodies.

    Attributes:
        origins: Where they start, metres.
        directions: Unit directions.
        bodies: Which body each belongs to.
    """

    origins: Float32[Tensor, "rays 3"]
    directions: Float32[Tensor, "rays 3"]
    bodies: Int64[Tensor, "rays"]


@runtime_checkable
class PosedRadiance(Protocol):
    """A method: what warps posed points, and the field behind it."""

    def pose(self, bodies: PosedBodies) -> OccupiedCells:
        """Prepares the bodies that the next points belong to; where there may be density."""
        ...

    def radiance(
        self, points: Float32[Tensor, "points 3"], directions: Float32[Tensor, "points 3"],
        bodies: Int64[Tensor, "points"], *, fine: bool,
    ) -> Float32[Tensor, "points 4"]:  # fmt: skip
        """Color logits and log density (log 1/m) at posed points, by the first or second net."""
        ...

    def prior_loss(self) -> Tensor:
        """The method's own loss terms, for the bodies that were posed last."""
        ...

    def parameter_groups(self) -> list[dict[str, object]]:
        """Parameters with their learning rates, for Adam."""
        ...


def render_rays(
    field: PosedRadiance,
    cells: OccupiedCells,
    rays: BodyRays,
    *,
    samples: int,
    fine_samples: int,
    jitters: bool,
) -> list[Float32[Tensor, "rays 4"]]:
    """Premultiplied color and alpha of rays; of two networks, the first one's first.

    Args:
        field: Method whose bodies are posed.
        cells: Where those may have density.
        rays: Rays to render.
        samples: Stratified samples of a ray, between its first and its last occupied cell.
        fine_samples: Further samples where the first network found density; 0 for no second one.
        jitters: Whether samples are drawn at random, as in training.
    """
    near, far, hit = _spans(rays, cells)
    rays, near, far = BodyRays(*(part[hit] for part in rays)), near[hit], far[hit]
    place = torch.rand(len(near), samples) if jitters else torch.full((len(near), samples), 0.5)
    depths = near[:, None] + (far - near)[:, None] * (torch.arange(samples) + place) / samples
    colors, weights = _composite(field, cells, rays, depths, far, fine=False)
    rendered = [_scatter(colors, hit)]
    if fine_samples:
        with torch.no_grad():
            more = _draw_depths(depths, weights, fine_samples, jitters=jitters)
            depths = torch.cat([depths, more], dim=1).sort(dim=1)[0]
        colors, _ = _composite(field, cells, rays, depths, far, fine=True)
        rendered.append(_scatter(colors, hit))
    return rendered


def _scatter(
    colors: Float32[Tensor, "hits 4"], hit: Bool[Tensor, "rays"]
) -> Float32[Tensor, "rays 4"]:
    """The colors of all rays; those that meet nothing are empty."""
    return colors.new_zeros(len(hit), 4).index_put((hit.nonzero()[:, 0],), colors)


@torch.no_grad()
def _spans(
    rays: BodyRays, cells: OccupiedCells
) -> tuple[Float32[Tensor, "rays"], Float32[Tensor, "rays"], Bool[Tensor, "rays"]]:
    """Where each ray enters its first and leaves its last occupied cell, and whether it does."""
    low = cells.low[rays.bodies]
    high = low + cells.shape[rays.bodies] * cells.cell_m
    safe = torch.where(rays.directions.abs() < 1e-9, 1e-9, rays.directions)
    sides = torch.stack([(low - rays.origins) / safe, (high - rays.origins) / safe])
    near = sides.amin(dim=0).amax(dim=1).clamp(min=0.0)
    far = torch.maximum(sides.amax(dim=0).amin(dim=1), near)
    spacing = (far - near)[:, None] / PROBES_PER_RAY
    depths = near[:, None] + spacing * (torch.arange(PROBES_PER_RAY) + 0.5)
    points = rays.origins[:, None] + rays.directions[:, None] * depths[..., None]
    found = cells.holds(points, rays.bodies[:, None].expand(depths.shape))
    order = torch.arange(PROBES_PER_RAY)
    first = torch.where(found, order, PROBES_PER_RAY).amin(dim=1)
    last = torch.where(found, order, -1).amax(dim=1)
    return near + spacing[:, 0] * first, near + spacing[:, 0] * (last + 1), found.any(dim=1)


def _composite(
    field: PosedRadiance, cells: OccupiedCells, rays: BodyRays,
    depths: Float32[Tensor, "rays samples"], far: Float32[Tensor, "rays"], *, fine: bool,
) -> tuple[Float32[Tensor, "rays 4"], Float32[Tensor, "rays samples"]]:  # fmt: skip
    """Volume rendering (Max 1995): premultiplied colors with alpha, and the samples' weights."""
    points = (rays.origins[:, None] + rays.directions[:, None] * depths[..., None]).flatten(0, 1)
    each = rays.bodies[:, None].expand(depths.shape).flatten()
    kept = cells.holds(points.detach(), each).nonzero()[:, 0]
    along = rays.directions[:, None].expand(*depths.shape, 3).flatten(0, 1)
    raw = field.radiance(points[kept], along[kept], each[kept], fine=fine)
    density = torch.exp(raw[:, 3].clamp(max=MAX_LOG_DENSITY))
    steps = torch.diff(depths, dim=1, append=far[:, None]).clamp(min=0.0).flatten()
    optical = raw.new_zeros(len(points)).index_put((kept,), density * steps[kept])
    optical = optical.view(depths.shape)
    color = raw.new_zeros(len(points), 3).index_put((kept,), torch.sigmoid(raw[:, :3]))
    before = optical.cumsum(dim=1) - optical
    weights = torch.exp(-before) * -torch.expm1(-optical)
    shown = (weights[..., None] * color.view(*depths.shape, 3)).sum(dim=1)
    return torch.cat([shown, weights.sum(dim=1, keepdim=True)], dim=1), weights


def _draw_depths(
    depths: Float32[Tensor, "rays samples"], weights: Float32[Tensor, "rays samples"],
    count: int, *, jitters: bool,
) -> Float32[Tensor, "rays count"]:  # fmt: skip
    """Depths drawn in proportion to the weights (Mildenhall et al. 2020, §5.2)."""
    share = (weights + 1e-5).cumsum(dim=1)
    share = share / share[:, -1:]
    even = (torch.arange(count) + 0.5) / count
    wanted = torch.rand(len(depths), count) if jitters else even.expand(len(depths), count)
    above = torch.searchsorted(share, wanted.contiguous()).clamp(1, depths.shape[1] - 1)
    left, right = depths.gather(1, above - 1), depths.gather(1, above)
    start, end = share.gather(1, above - 1), share.gather(1, above)
    part = ((wanted - start) / (end - start).clamp(min=1e-8)).clamp(0.0, 1.0)
    return left + part * (right - left)
