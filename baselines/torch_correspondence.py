"""Skinning, its inverse, correspondence grids and the gradient of poses in plain torch.

The oracle of the compiled kernels (`avatar.kernels.operations`), like `baselines.torch_reference`.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32
from torch import Tensor

from avatar.kernels.numba_correspondence import (
    MAX_ROOTS,
    MIN_SECOND_ORDER_M,
    PROBE_DISTANCE_CELLS,
    SAME_ROOT_M,
)
from avatar.kernels.numba_pose import MAX_ROOT_STEP_M
from avatar.kernels.numba_skinning import MAX_PROBE_CORRECTION_M
from avatar.kernels.operands import CorrespondenceTables, RaySamples, SkinningVolume
from avatar.rig import Rig
from baselines.torch_reference import root_row


def interpolate_volume(
    points: Float[Tensor, "points 3"],
    weights: Float[Tensor, "x y z channels"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
) -> Float[Tensor, "points channels"]:
    """Trilinear skinning weights at canonical points; the border's outside."""
    last = torch.tensor(weights.shape[:3]) - 1
    place = ((points - low) * nodes_per_m / last * 2.0 - 1.0).flip(-1)[None, :, None, None]
    volume = weights.permute(3, 0, 1, 2)[None]
    read = torch.nn.functional.grid_sample(
        volume, place, mode="bilinear", padding_mode="border", align_corners=True
    )
    return read[0, :, :, 0, 0].T


def skin_points(
    points: Float[Tensor, "points 3"],
    weights: Float[Tensor, "x y z channels"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
    bones: Float[Tensor, "channels 12"],
) -> Float[Tensor, "points 3"]:
    """Linear blend skinning: x ↦ Σ w_j(x) B_j x (Fast-SNARF, eq. 3)."""
    blend = (interpolate_volume(points, weights, low, nodes_per_m) @ bones).unflatten(1, (3, 4))
    return (blend[..., :3] @ points[..., None])[..., 0] + blend[..., 3]


def broyden_roots(
    targets: Float[Tensor, "points 3"],
    starts: Float[Tensor, "points 3"],
    weights: Float[Tensor, "x y z channels"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
    bones: Float[Tensor, "channels 12"],
    *,
    iterations: int = 12,
    tolerance_m: float = 1e-4,
) -> tuple[Float[Tensor, "points 3"], Bool[Tensor, "points"]]:
    """Canonical points that skinning carries to `targets`, by Broyden's method per sample.

    Fast-SNARF, §3.2. The inverse Jacobian starts from the blended rotation's inverse.

    Returns:
        The roots, and which of them came to rest within the tolerance.
    """
    x = starts.clone()
    blend = (interpolate_volume(x, weights, low, nodes_per_m) @ bones).unflatten(1, (3, 4))
    inverse = torch.linalg.inv(blend[..., :3])
    error = skin_points(x, weights, low, nodes_per_m, bones) - targets
    for _ in range(iterations):
        moving = (error.norm(dim=-1) > tolerance_m)[:, None]
        step = torch.where(moving, -(inverse @ error[..., None])[..., 0], 0.0)
        x = x + step
        new = skin_points(x, weights, low, nodes_per_m, bones) - targets
        change = (inverse @ (new - error)[..., None])[..., 0]
        scale = (step * change).sum(dim=-1, keepdim=True)
        scale = torch.where(scale.abs() < 1e-12, 1e-12, scale)
        row = (step[:, None] @ inverse)[:, 0]
        update = ((step - change) / scale)[..., None] * row[:, None]
        inverse = torch.where(moving[..., None], inverse + update, inverse)
        error = new
    return x, error.norm(dim=-1) <= 2.0 * tolerance_m


def bone_wrenches(
    samples: RaySamples,
    grad_points: Float32[Tensor, "samples 3"],
    slots: Int32[Tensor, "rays"],
    cells: CorrespondenceTables,
    skin: SkinningVolume,
    bones: Float32[Tensor, "slots 24 12"],
) -> Float32[Tensor, "rays 24 6"]:
    """Force and moment that each ray's samples exert on each bone.

    The loss pulls the canonical point with g_x, so it pulls the posed one with g = J⁻ᵀ g_x; a bone
    of weight w takes the force w g and, about the body frame's origin, the moment w (B x) × g.
    """
    ray = torch.arange(len(slots)).repeat_interleave(samples.counts)
    slot = slots[ray].long()
    roots = cells.roots[slot, samples.root_rows.long()]
    force = (roots[:, 3:].unflatten(1, (3, 3)).mT @ grad_points[..., None])[:, None, :, 0]
    share = interpolate_volume(samples.points, *skin)[..., None]
    matrix = bones[slot].unflatten(2, (3, 4))
    carried = (matrix[..., :3] @ samples.points[:, None, :, None])[..., 0] + matrix[..., 3]
    moment = torch.linalg.cross(carried, force.expand_as(carried))
    wrench = torch.cat([share * force, share * moment], dim=2)
    return wrench.new_zeros(len(slots), 24, 6).index_add_(0, ray, wrench)


def update_roots(
    cells: CorrespondenceTables, slot: int, skin: SkinningVolume, bones: Float32[Tensor, "24 12"]
) -> None:
    """Moves roots, in place, by one chord step towards what is skinned to their cell's centre.

    How the warp bends about a root is taken along as it is, like the inverse Jacobian.
    """
    nx, ny, nz = cells.shape[slot].tolist()
    packed_cells = cells.packed_cells[slot, : nx * ny * nz].view(nx, ny, nz)
    roots, cell = cells.roots[slot], (packed_cells > 0).nonzero()
    packed = packed_cells[tuple(cell.T)]
    for candidate in range(3):
        held = (packed & 3) > candidate
        row = root_row(packed[held], candidate).long()
        center = cells.low[slot] + (cell[held] + 0.5) * cells.cell_m
        x, inverse = roots[row, :3], roots[row, 3:].unflatten(1, (3, 3))
        error = center - skin_points(x, *skin, bones)
        step = (inverse @ error[..., None])[..., 0]
        moves = step.norm(dim=1) <= MAX_ROOT_STEP_M
        roots[row, :3] = torch.where(moves[:, None], x + step, x)


SEARCHES_PER_CELL = 4
"""Body parts, nearest first, from which roots of a cell are searched."""
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
    rig: Rig, bones: Float32[np.ndarray, "24 12"], band_m: float, cell_m: float
) -> tuple[Float32[np.ndarray, "3"], Int32[np.ndarray, "gx gy gz"], Float32[np.ndarray, "rows 12"]]:
    """Correspondence grid of one pose.

    A cell's roots are those that Broyden's method finds from the nearest seed of each of the four
    nearest body parts, if they are no farther from the canonical skin than the band.
    """
    weights, box_low, nodes_per_m, matrices, seeds, parts, distance, cells_per_m = (
        torch.from_numpy(part)
        for part in (
            rig.weights, rig.box_low, rig.nodes_per_m, bones,
            rig.seeds, rig.seed_parts, rig.skin_distance, rig.cells_per_m,
        )
    )  # fmt: skip
    volume = weights, box_low, nodes_per_m, matrices
    posed = skin_points(seeds, *volume)
    low = posed.amin(dim=0) - band_m
    shape = torch.ceil((posed.amax(dim=0) + band_m - low) / cell_m).long().tolist()
    axes = [torch.arange(n) for n in shape]
    center = low + (torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1) + 0.5) * cell_m
    center = center.reshape(-1, 3)
    start, near = _search_starts(center, posed, parts, band_m + 0.012 + 0.6 * cell_m)
    root = torch.zeros(*near.shape, 3)
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
    return low.numpy(), index.reshape(shape).numpy(), roots.numpy()


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
    shape = torch.tensor(distance.shape)
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
    axes = torch.eye(3) * FINITE_DIFFERENCE_M
    ahead = torch.stack([skin_points(root + step, *volume) for step in axes], dim=2)
    behind = torch.stack([skin_points(root - step, *volume) for step in axes], dim=2)
    inverse = torch.linalg.inv((ahead - behind) / (2.0 * FINITE_DIFFERENCE_M))
    off = center - skin_points(root, *volume)
    root = root + _limited_step((inverse @ off[..., None])[..., 0])
    slope, square = _face_differences(root, center, inverse, volume, PROBE_DISTANCE_CELLS * cell_m)
    bent = square.flatten(1).norm(dim=1) * 0.25 * cell_m**2 > MIN_SECOND_ORDER_M
    coefficients = torch.zeros(len(root), 6, 3)
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
    sign = torch.tensor(CORNERS, dtype=root.dtype)
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
    sign = torch.tensor(FACES, dtype=root.dtype)
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
    bends = torch.zeros(cells, dtype=torch.bool)
    bends[cell[bent]] = True
    rows = torch.where(bends, 3 * count, count)
    first = rows.cumsum(0) - rows + 1  # row 0 stays unused, so that no packed index is 0
    index = torch.where(count > 0, first * 8 + 4 * bends + count, 0)
    rank = torch.arange(len(cell)) - (count.cumsum(0) - count)[cell]
    row = first[cell] + rank * torch.where(bends[cell], 3, 1)
    roots = torch.zeros(int(rows.sum()) + 1, 12)
    roots[row] = warp[:, :12]
    long = bends[cell]
    roots[row[long] + 1], roots[row[long] + 2, :6] = warp[long, 12:24], warp[long, 24:]
    return index.int(), roots
