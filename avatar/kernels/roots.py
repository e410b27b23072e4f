"""What it means to find all canonical roots of a sample, as Fast-SNARF does, in plain torch."""

import torch
from jaxtyping import Bool, Float, Int32
from torch import Tensor

from avatar.kernels.skin import broyden_roots

START_BONES = (0, 1, 2, 4, 5, 16, 17, 18, 19)
"""Fast-SNARF's: a search starts where each of these bones alone would carry the sample."""
SAME_ROOT_M = 1e-3
"""Roots closer than this are one."""


def find_all_roots(
    points: Float[Tensor, "points 3"],
    slots: Int32[Tensor, "points"],
    blended: Float[Tensor, "slots x y z 12"],
    low: Float[Tensor, "3"],
    nodes_per_m: Float[Tensor, "3"],
    inverses: Float[Tensor, "slots starts 12"],
) -> tuple[Float[Tensor, "points starts 3"], Bool[Tensor, "points starts"]]:
    """Every canonical point that skinning carries to a sample, by BroydenLookup's method (§3.2).

    Args:
        points: RaySamples, each in the body frame of its slot.
        slots: Which pose each belongs to.
        blended: Σ w_j B_j on the nodes of the canonical box, for each slot.
        low, nodes_per_m: Where those nodes are.
        inverses: From body to canonical frame, of the bones that searches start with.

    Returns:
        Where each search ended, and whether that is a root which no earlier search had found.
    """
    starts = inverses.shape[1]
    roots = points.new_zeros(len(points), starts, 3)
    valid = torch.zeros(len(points), starts, dtype=torch.bool, device=points.device)
    # a volume of blended transforms is one of twelve weights, whose bones are unit vectors
    unit = torch.eye(12).to(points)
    for slot in slots.unique().tolist():
        here = (slots == slot).nonzero()[:, 0]
        matrix = inverses[slot].unflatten(1, (3, 4))
        target = points[here, None].expand(len(here), starts, 3)
        start = (matrix[:, :, :3] @ target[..., None])[..., 0] + matrix[:, :, 3]
        found, rests = broyden_roots(
            target.flatten(0, 1), start.flatten(0, 1), blended[slot], low, nodes_per_m, unit
        )
        roots[here] = found.unflatten(0, (len(here), starts))
        valid[here] = rests.unflatten(0, (len(here), starts))
    for search in range(1, starts):
        near = (roots[:, :search] - roots[:, search, None]).norm(dim=-1) < SAME_ROOT_M
        valid[:, search] &= ~(near & valid[:, :search]).any(dim=1)
    return roots, valid
