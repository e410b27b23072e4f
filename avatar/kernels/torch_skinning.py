"""Reference of skinning, its inverse, and the operations of pose refinement, in plain torch."""

import torch
from jaxtyping import Bool, Float, Float32, Int32
from torch import Tensor

from avatar.kernels.backend_protocol import CorrespondenceTables, RaySamples, SkinningVolume
from avatar.kernels.torch_reference import root_row


def interpolate_volume(
    points: Float[Tensor, "points 3"],
    weights: Float[Tensor, "x y z channels"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
) -> Float[Tensor, "points channels"]:
    """Trilinear skinning weights at canonical points; the border's outside."""
    last = torch.tensor(weights.shape[:3], device=points.device) - 1
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


MAX_ROOT_STEP_M = 0.05
"""A root never moves farther than this at once: where the chord is longer the warp has a fold."""


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
    ray = torch.arange(len(slots), device=slots.device).repeat_interleave(samples.counts)
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
