"""Anim-NeRF (Chen et al. 2021): inverse skinning by the nearest vertices, and a NeRF.

A posed point takes the inverse of its four nearest vertices' skinning, blended by exp(-distance)
among those whose skinning weights resemble the nearest one's. Poses are optimized with the field.
"""

from typing import final

import numpy as np
import torch
from jaxtyping import Float32, Int64
from scipy.spatial import KDTree
from torch import Tensor, nn

from avatar.kernels.operands import MAX_LOG_DENSITY
from avatar.rig import Rig
from baselines.systems.method_settings import MethodSettings, NerfNetwork
from baselines.systems.posed_person import (
    OccupiedCells,
    PosedBodies,
    SkinnedPerson,
    apply_affine,
    blend,
    invert_affine,
    random_points,
)

NEIGHBORS = 4
"""Vertices whose inverse skinning is blended."""
WEIGHT_SIGMA = 0.1
"""Width of the Gaussian over the L1 difference of skinning weights."""
MIN_RESEMBLANCE = 0.9
"""Value of that Gaussian below which a vertex does not count."""
DECEPTIVE_LOG_DENSITY = -30.0
"""Log density of points that are too far from the skin."""
INSIDE_M, OUTSIDE_M = 0.02, 0.10
"""Distances from the canonical skin at which points must be solid, and empty."""
PRIOR_STEP_M = 2.0 / 64
"""Length over which opacity is measured there, metres."""
PRIOR_POINTS, PRIOR_WEIGHT = 128, 0.01
"""Points of each prior, and the weight of each."""
NORMAL_SPREAD_M, NEIGHBOR_SPREAD_M = 0.1, 0.01
"""Spread of the points about the vertices whose normals are compared, and of their neighbors."""

PRESETS = {
    "paper": MethodSettings(  # a quarter of the paper's 16 frames a step, which take 16 GB
        frames=4, rays=4 * 1024, samples=64, fine_samples=32, pose_rate=2.5e-4, reach_m=0.2
    ),
    "small": MethodSettings(
        frames=2, rays=128, samples=24, layers=4, width=96, octaves=6, learning_rate=4e-3,
        pose_rate=2.5e-5,
    ),
}  # fmt: skip


@final
class AnimNerf(nn.Module):
    """The method: k nearest vertices, and one or two networks."""

    def __init__(self, person: SkinnedPerson, settings: MethodSettings) -> None:
        """Draws the networks."""
        super().__init__()
        self._person, self._settings = person, settings
        count = 2 if settings.fine_samples else 1
        self.networks = nn.ModuleList(NerfNetwork(settings) for _ in range(count))
        self._inside, self._outside = _prior_candidates(person.rig)

    def pose(self, bodies: PosedBodies) -> OccupiedCells:
        """Inverts the skinning of every vertex."""
        self._trees = [KDTree(skin.numpy()) for skin in bodies.vertices]
        self._canonical_from_body = invert_affine(blend(self._person.weights, bodies.bones))
        return OccupiedCells.around(bodies.vertices, self._settings.reach_m)

    def warp(
        self, points: Float32[Tensor, "points 3"], bodies: Int64[Tensor, "points"]
    ) -> tuple[Float32[Tensor, "points 3"], Float32[Tensor, "points"]]:
        """Canonical points, and their blended distances from the skin, metres."""
        away = np.zeros((len(points), NEIGHBORS), dtype=np.float32)
        nearest = np.zeros((len(points), NEIGHBORS), dtype=np.int64)
        places, which = points.detach().numpy(), bodies.numpy()
        for body, tree in enumerate(self._trees):
            mine = which == body
            away[mine], nearest[mine] = tree.query(places[mine], k=NEIGHBORS)
        distance, vertex = torch.from_numpy(away), torch.from_numpy(nearest)
        weights = self._person.weights[vertex]
        unlike = (weights - weights[:, :1]).abs().sum(dim=-1)
        counts = torch.exp(-unlike / (2.0 * WEIGHT_SIGMA**2)) > MIN_RESEMBLANCE
        share = torch.exp(-distance) * counts
        share = share / share.sum(dim=1, keepdim=True)
        maps = self._canonical_from_body[bodies[:, None], vertex]
        blended = (share[..., None, None] * maps).sum(dim=1)
        return apply_affine(blended, points), (share * distance).sum(dim=1)

    def radiance(
        self, points: Float32[Tensor, "points 3"], directions: Float32[Tensor, "points 3"],
        bodies: Int64[Tensor, "points"], *, fine: bool,
    ) -> Float32[Tensor, "points 4"]:  # fmt: skip
        """The field at canonical points; no density beyond the reach."""
        canonical, away = self.warp(points, bodies)
        raw = self.networks[int(fine)](canonical)
        empty = raw.new_tensor([0.0, 0.0, 0.0, DECEPTIVE_LOG_DENSITY])
        return torch.where((away < self._settings.reach_m)[:, None], raw, empty)

    def prior_loss(self) -> Tensor:
        """Solid inside, empty outside, smooth normals; of every network."""
        solid = random_points(self._inside, PRIOR_POINTS, 0.01)
        empty = random_points(self._outside, PRIOR_POINTS, 0.01)
        skin = random_points(self._person.vertices.numpy(), PRIOR_POINTS, NORMAL_SPREAD_M)
        pairs = torch.cat([skin, skin + NEIGHBOR_SPREAD_M * torch.randn_like(skin)])
        loss = torch.zeros(())
        for network in self.networks:
            density = torch.exp(network(torch.cat([solid, empty]))[:, 3].clamp(max=MAX_LOG_DENSITY))
            clear = torch.exp(-PRIOR_STEP_M * density)
            loss = loss + clear[:PRIOR_POINTS].mean() + (1.0 - clear[PRIOR_POINTS:]).mean()
            asked = pairs.requires_grad_()
            slopes = torch.autograd.grad(network(asked)[:, 3].sum(), asked, create_graph=True)[0]
            normals = nn.functional.normalize(slopes, dim=1, eps=1e-5)
            loss = loss + (normals[:PRIOR_POINTS] - normals[PRIOR_POINTS:]).norm(dim=1).mean()
        return PRIOR_WEIGHT * loss

    def parameter_groups(self) -> list[dict[str, object]]:
        """The networks' parameters."""
        return [{"params": list(self.parameters()), "lr": self._settings.learning_rate}]


def _prior_candidates(rig: Rig) -> tuple[np.ndarray, np.ndarray]:
    """Centers of the canonical cells well under the skin, and well off it."""
    cell = (rig.box_high - rig.box_low) / np.array(rig.skin_distance.shape)
    solid = rig.inside_skin & (rig.skin_distance > INSIDE_M)
    empty = ~rig.inside_skin & (rig.skin_distance > OUTSIDE_M)
    inside, outside = (rig.box_low + (np.argwhere(mask) + 0.5) * cell for mask in (solid, empty))
    return inside, outside
