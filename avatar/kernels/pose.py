"""What the operations of pose refinement mean, in plain torch."""

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from avatar.kernels.reference import root_row
from avatar.kernels.skin import skin_points, interpolate_volume

MAX_ROOT_STEP_M = 0.05
"""A root never moves farther than this at once: where the chord is longer the warp has a fold."""


def bone_wrenches(
    points: Float[Tensor, "samples 3"],
    grad_points: Float[Tensor, "samples 3"],
    roots: Float[Tensor, "samples 12"],
    bones: Float[Tensor, "samples 24 12"],
    weights: Float[Tensor, "x y z 24"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
) -> Float[Tensor, "samples 24 6"]:
    """Force and moment that each sample exerts on each bone.

    The loss pulls the canonical point with g_x, so it pulls the posed one with g = J⁻ᵀ g_x; a bone
    of weight w takes the force w g and, about the body frame's origin, the moment w (B x) × g.
    """
    force = (roots[:, 3:].unflatten(1, (3, 3)).mT @ grad_points[..., None])[:, None, :, 0]
    share = interpolate_volume(points, weights, low, nodes_per_m)[..., None]
    matrix = bones.unflatten(2, (3, 4))
    carried = (matrix[..., :3] @ points[:, None, :, None])[..., 0] + matrix[..., 3]
    moment = torch.linalg.cross(carried, force.expand_as(carried))
    return torch.cat([share * force, share * moment], dim=2)


def update_roots(
    packed_cells: Int32[Tensor, "gx gy gz"],
    grid_low: Float[Tensor, "3"],
    cell_m: float,
    roots: Float[Tensor, "roots 12"],
    weights: Float[Tensor, "x y z 24"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
    bones: Float[Tensor, "24 12"],
) -> None:
    """Moves roots, in place, by one chord step towards what is skinned to their cell's centre.

    How the warp bends about a root is taken along as it is, like the inverse Jacobian.
    """
    cell = (packed_cells > 0).nonzero()
    packed = packed_cells[tuple(cell.T)]
    for candidate in range(3):
        held = (packed & 3) > candidate
        row = root_row(packed[held], candidate).long()
        center = grid_low + (cell[held] + 0.5) * cell_m
        x, inverse = roots[row, :3], roots[row, 3:].unflatten(1, (3, 3))
        error = center - skin_points(x, weights, low, nodes_per_m, bones)
        step = (inverse @ error[..., None])[..., 0]
        moves = step.norm(dim=1) <= MAX_ROOT_STEP_M
        roots[row, :3] = torch.where(moves[:, None], x + step, x)
