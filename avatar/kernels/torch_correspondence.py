"""Reference of the correspondence grid in plain torch: roots and second-order terms per cell."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32
from torch import Tensor

from avatar.deformation.rig import Rig
from avatar.kernels.backend_protocol import SolvedCorrespondences
from avatar.kernels.torch_skinning import broyden_roots, interpolate_volume, skin_points

MAX_ROOTS = 3
"""Largest number of roots of a cell; two bits hold it."""
SAME_ROOT_M = 0.02
"""Distance below which two roots of a cell are the same, metres."""
SEARCHES_PER_CELL = 4
"""Body parts, nearest first, from which roots of a cell are searched."""
PROBE_DISTANCE_CELLS = 0.375
"""Distance of the probes from a cell's center, in cells: three quarters of the way to a face."""
MIN_SECOND_ORDER_M = 5e-4
"""Deviation from an affine warp, at a cell's faces, from which the cell is bent, metres."""
MAX_PROBE_CORRECTION_M = 0.03
"""Largest motion of a probe, metres; one that would move farther lies beyond a fold and stays."""
FINITE_DIFFERENCE_M = 5e-3
"""Step of the finite differences of the skinning transforms, metres."""
FACES = [(i, 0, 0) for i in (1, -1)] + [(0, i, 0) for i in (1, -1)] + [(0, 0, i) for i in (1, -1)]
"""Directions to the faces of a cell."""
CORNERS = [(i, j, k) for i in (1, -1) for j in (1, -1) for k in (1, -1)]
"""Directions to the corners of a cell."""
CELLS_PER_CHUNK = 4096
"""Cells whose nearest seeds are searched together, which bounds the memory."""

SkinningTensors = tuple[Tensor, Tensor, Tensor, Tensor]
"""Skinning weights (x, y, z, 24), their low corner, nodes per metre, bones (24, 12)."""


def solve_correspondences(
    rig: Rig, bones: Float32[np.ndarray, "24 12"], band_m: float, cell_m: float,
    device: torch.device,
) -> SolvedCorrespondences:  # fmt: skip
    """Correspondence grid of one pose.

    A cell's roots are those that Broyden's method finds from the nearest seed of each of the four
    nearest body parts, if they are no farther from the canonical skin than the band.
    """
    weights, box_low, nodes_per_m, matrices, seeds, parts, distance, cells_per_m = (
        torch.from_numpy(part).to(device)
        for part in (
            rig.weights, rig.box_low, rig.nodes_per_m, bones,
            rig.seeds, rig.seed_parts, rig.skin_distance, rig.cells_per_m,
        )
    )  # fmt: skip
    volume = weights, box_low, nodes_per_m, matrices
    posed = skin_points(seeds, *volume)
    low = posed.amin(dim=0) - band_m
    shape = torch.ceil((posed.amax(dim=0) + band_m - low) / cell_m).long().tolist()
    axes = [torch.arange(n, device=seeds.device) for n in shape]
    center = low + (torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1) + 0.5) * cell_m
    center = center.reshape(-1, 3)
    start, near = _search_starts(center, posed, parts, band_m + 0.012 + 0.6 * cell_m)
    root = torch.zeros(*near.shape, 3, device=seeds.device)
    kept = torch.zeros_like(near)
    cell, rank = near.nonzero(as_tuple=True)
    seed = start[cell, rank]
    blend = (interpolate_volume(seeds[seed], *volume[:3]) @ volume[3]).unflatten(1, (3, 4))[..., :3]
    way = torch.linalg.solve(blend, (center[cell] - posed[seed])[..., None])[..., 0]
    found, rested = broyden_roots(center[cell], seeds[seed] + way, *volume)
    reach_m = band_m + 0.5 * cell_m
    near_skin = skin_distance_at(found, distance, volume[1], cells_per_m) <= reach_m
    root[cell, rank], kept[cell, rank] = found, rested & near_skin
    kept = _distinct_roots(root, kept)
    cell, rank = kept.nonzero(as_tuple=True)
    warp, bent = taylor_expansion(root[cell, rank], center[cell], volume, cell_m)
    index, roots = _pack_cells(cell, warp, bent, len(center))
    return SolvedCorrespondences(
        *(part.cpu().numpy() for part in (low, index.reshape(shape), roots))
    )


def _search_starts(
    center: Float[Tensor, "cells 3"],
    posed: Float[Tensor, "seeds 3"],
    parts: Int32[Tensor, "seeds"],
    reach_m: float,
) -> tuple[Tensor, Bool[Tensor, "cells starts"]]:
    """The nearest seed of each of the nearest parts, and which of these are within reach."""
    members = [(parts == part).nonzero()[:, 0] for part in torch.unique(parts)]
    starts, near = [], []
    for some in center.split(CELLS_PER_CHUNK):
        best = [torch.cdist(some, posed[seeds]).min(dim=1) for seeds in members]
        gap = torch.stack([least.values for least in best], dim=1)
        seed = torch.stack([m[b.indices] for m, b in zip(members, best, strict=True)], dim=1)
        gap, part = gap.sort(dim=1)
        starts.append(seed.gather(1, part[:, :SEARCHES_PER_CELL]))
        near.append(gap[:, :SEARCHES_PER_CELL] < reach_m)
    return torch.cat(starts), torch.cat(near)


def skin_distance_at(
    points: Float[Tensor, "points 3"],
    distance: Float[Tensor, "cx cy cz"],
    low: Float[Tensor, "3"],
    cells_per_m: Float[Tensor, "3"],
) -> Float[Tensor, "points"]:
    """Distance from the canonical skin of the cells that hold canonical points; 1 m outside."""
    shape = torch.tensor(distance.shape, device=points.device)
    cell = torch.floor((points - low) * cells_per_m).long()
    inside = ((cell >= 0) & (cell < shape)).all(dim=1)
    x, y, z = torch.minimum(cell.clamp(min=0), shape - 1).unbind(dim=1)
    return torch.where(inside, distance[x, y, z], 1.0)


def _distinct_roots(
    root: Float[Tensor, "cells starts 3"], found: Bool[Tensor, "cells starts"]
) -> Bool[Tensor, "cells starts"]:
    """Which roots are kept: of those within 2 cm the first, and of all the first three."""
    kept = found.clone()
    for later in range(1, kept.shape[1]):
        gap = (root[:, :later] - root[:, later : later + 1]).norm(dim=2)
        known = ((gap < SAME_ROOT_M) & kept[:, :later]).any(dim=1)
        kept[:, later] &= ~known & (kept[:, :later].sum(dim=1) < MAX_ROOTS)
    return kept


def taylor_expansion(
    root: Float[Tensor, "roots 3"],
    center: Float[Tensor, "roots 3"],
    volume: SkinningTensors,
    cell_m: float,
) -> tuple[Float[Tensor, "roots 30"], Bool[Tensor, "roots"]]:
    """How roots move about those of cells' centres, and where the warp is bent.

    A root of p + d is x + A d + Σ c_ij d_i d_j. A and c_ii come from where the roots of six points
    lie towards the faces; where those say that the warp is bent, c_ij and better means come from
    eight points towards the corners.

    Returns:
        x, A row by row, then c_xx c_yy c_zz c_xy c_xz c_yz, 0 where the warp is straight.
    """
    axes = torch.eye(3, device=root.device) * FINITE_DIFFERENCE_M
    ahead = torch.stack([skin_points(root + step, *volume) for step in axes], dim=2)
    behind = torch.stack([skin_points(root - step, *volume) for step in axes], dim=2)
    inverse = torch.linalg.inv((ahead - behind) / (2.0 * FINITE_DIFFERENCE_M))
    off = center - skin_points(root, *volume)
    root = root + _limited_step((inverse @ off[..., None])[..., 0])
    slope, square = _face_differences(root, center, inverse, volume, PROBE_DISTANCE_CELLS * cell_m)
    bent = square.flatten(1).norm(dim=1) * 0.25 * cell_m**2 > MIN_SECOND_ORDER_M
    coefficients = torch.zeros(len(root), 6, 3, device=root.device)
    slope[bent], coefficients[bent] = _second_order_expansion(
        root[bent], center[bent], slope[bent], volume, PROBE_DISTANCE_CELLS * cell_m
    )
    return torch.cat([root, slope.flatten(1), coefficients.flatten(1)], dim=1), bent


def _second_order_expansion(
    root: Float[Tensor, "roots 3"],
    center: Float[Tensor, "roots 3"],
    inverse: Float[Tensor, "roots 3 3"],
    volume: SkinningTensors,
    t: float,
) -> tuple[Float[Tensor, "roots 3 3"], Float[Tensor, "roots 6 3"]]:
    """A and c_ij, from the faces with the inverse Jacobian found there, and from the corners."""
    slope, square = _face_differences(root, center, inverse, volume, t)
    sign = torch.tensor(CORNERS, dtype=root.dtype, device=root.device)
    u = torch.stack([_probe_root(root, center, inverse, t * way, volume) for way in sign], dim=1)
    slope = 0.5 * (slope + torch.einsum("rkc,ka->rca", u, sign) / (8.0 * t))
    mean = u.mean(dim=1) / t**2
    square = square + ((mean - square.sum(dim=1)) / 6.0)[:, None]
    pairs = torch.stack([sign[:, 0] * sign[:, 1], sign[:, 0] * sign[:, 2], sign[:, 1] * sign[:, 2]])
    mixed = torch.einsum("rkc,pk->rpc", u, pairs) / (8.0 * t**2)
    return slope, torch.cat([square, mixed], dim=1)


def _face_differences(
    root: Float[Tensor, "roots 3"],
    center: Float[Tensor, "roots 3"],
    inverse: Float[Tensor, "roots 3 3"],
    volume: SkinningTensors,
    t: float,
) -> tuple[Float[Tensor, "roots 3 3"], Float[Tensor, "roots 3 3"]]:
    """A, and c_xx, c_yy, c_zz one below the other."""
    sign = torch.tensor(FACES, dtype=root.dtype, device=root.device)
    u = torch.stack([_probe_root(root, center, inverse, t * way, volume) for way in sign], dim=1)
    ahead, behind = u[:, 0::2], u[:, 1::2]
    return ((ahead - behind) / (2.0 * t)).mT, (ahead + behind) / (2.0 * t**2)


def _probe_root(
    root: Float[Tensor, "roots 3"],
    center: Float[Tensor, "roots 3"],
    inverse: Float[Tensor, "roots 3 3"],
    way: Float[Tensor, "3"],
    volume: SkinningTensors,
) -> Float[Tensor, "roots 3"]:
    """Where the roots of center + way lie from those of center: linearly, and one chord step."""
    straight = inverse @ way
    off = center + way - skin_points(root + straight, *volume)
    return straight + _limited_step((inverse @ off[..., None])[..., 0])


def _limited_step(step: Float[Tensor, "roots 3"]) -> Float[Tensor, "roots 3"]:
    return torch.where(step.norm(dim=1, keepdim=True) < MAX_PROBE_CORRECTION_M, step, 0.0)


def _pack_cells(
    cell: Tensor, warp: Float[Tensor, "roots 30"], bent: Bool[Tensor, "roots"], cells: int
) -> tuple[Int32[Tensor, "cells"], Float[Tensor, "rows 12"]]:
    """Flat `CorrespondenceGrid.packed_cells`, and `.roots`, of roots in the cells' order."""
    count = torch.bincount(cell, minlength=cells)
    bends = torch.zeros(cells, dtype=torch.bool, device=cell.device)
    bends[cell[bent]] = True
    rows = torch.where(bends, 3 * count, count)
    first = rows.cumsum(0) - rows + 1  # row 0 stays unused, so that no packed index is 0
    index = torch.where(count > 0, first * 8 + 4 * bends + count, 0)
    rank = torch.arange(len(cell), device=cell.device) - (count.cumsum(0) - count)[cell]
    row = first[cell] + rank * torch.where(bends[cell], 3, 1)
    roots = torch.zeros(int(rows.sum()) + 1, 12, device=warp.device)
    roots[row] = warp[:, :12]
    long = bends[cell]
    roots[row[long] + 1], roots[row[long] + 2, :6] = warp[long, 12:24], warp[long, 24:]
    return index.int(), roots
