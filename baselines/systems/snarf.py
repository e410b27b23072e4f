"""SNARF (Chen et al. 2021): forward skinning by learnt weights, inverted by root finding.

The skinning weights are a network over canonical space. A posed point is searched for from the
rigid inverse of several bones, by Broyden's method; of its roots the densest counts. Gradients
reach the weights by implicit differentiation, the field by its canonical points.
"""

from itertools import pairwise
from typing import NamedTuple, final

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor, nn

from baselines.systems.method_settings import MethodSettings, NerfNetwork
from baselines.systems.posed_person import (
    OccupiedCells,
    PosedBodies,
    SkinnedPerson,
    apply_affine,
    invert_affine,
)

START_BONES = (0, 1, 2, 4, 5, 16, 17, 18, 19)
"""Bones whose rigid inverses root finding starts from."""
START_MARGIN_M = 0.04
"""Distance beyond the reach, off the canonical skin, at which no search starts any more, metres."""
SEARCH_STEPS = 10
"""Most steps of Broyden's method."""
CONVERGED_M, DIVERGED_M = 1e-4, 0.1
"""Residual below which a root is found, and above which a search ends, metres."""
SAME_ROOT_M = 1e-3
"""Distance below which two roots are one, metres."""
SOFTMAX_SCALE = 20.0
"""Factor of the network's outputs before their softmax."""
FIRST_STEPS, FIRST_POINTS, FIRST_RATE = 400, 512, 3e-3
"""Steps, points and rate by which the weights are fitted to the body's before training."""
SKINNING_RATE_FACTOR = 0.1
"""Their learning rate in training, as a share of the field's."""
SKIN_SPREAD_M = 0.02
"""Spread of the points about the skin that have the weights of their vertices, metres."""
BODY_WEIGHT, BODY_POINTS = 0.1, 128
"""Weight of the vertices' own skinning weights during training, and the vertices of a step."""

PRESETS = {
    "paper": MethodSettings(frames=1, rays=4096, samples=128, learning_rate=1e-3),
    "small": MethodSettings(
        frames=2, rays=128, samples=24, layers=4, width=96, octaves=6, learning_rate=4e-3
    ),
}


class FoundRoots(NamedTuple):
    """Roots of posed points, one for each bone that was started from.

    Attributes:
        points: Canonical points.
        inverse: Inverse Jacobians of skinning there, as Broyden's method has them.
        valid: Whether the search has converged, and to no root of an earlier bone.
    """

    points: Float32[Tensor, "points bones 3"]
    inverse: Float32[Tensor, "points bones 3 3"]
    valid: Bool[Tensor, "points bones"]


@final
class Snarf(nn.Module):
    """The method: a network of skinning weights, and a NeRF."""

    def __init__(self, person: SkinnedPerson, settings: MethodSettings) -> None:
        """Draws both networks, and fits the skinning weights to the body's own."""
        super().__init__()
        self._person, self._settings = person, settings
        self.network = NerfNetwork(settings)
        width = settings.width // 2
        sizes = [3, *[width] * 4]
        layers: list[nn.Module] = []
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.ReLU()]
        self.skinning = nn.Sequential(*layers, nn.Linear(width, 24))
        self._near_skin = OccupiedCells.around(
            person.vertices[None], settings.reach_m + START_MARGIN_M
        )
        optimizer = torch.optim.Adam(self.skinning.parameters(), lr=FIRST_RATE)
        for _ in range(FIRST_STEPS):
            optimizer.zero_grad()
            self._weight_loss(FIRST_POINTS).backward()
            optimizer.step()

    def pose(self, bodies: PosedBodies) -> OccupiedCells:
        """Keeps the bones."""
        self._bones = bodies.bones[:, :, :3]
        return OccupiedCells.around(bodies.vertices, self._settings.reach_m)

    def weights_at(self, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, "points 24"]:
        """Skinning weights at canonical points."""
        return torch.softmax(SOFTMAX_SCALE * self.skinning(points), dim=1)

    def skin(
        self, points: Float32[Tensor, "points 3"], bodies: Int64[Tensor, "points"]
    ) -> Float32[Tensor, "points 3"]:
        """Canonical points in the bodies' poses; the points are in the order of their bodies."""
        counts = torch.bincount(bodies, minlength=len(self._bones)).tolist()
        weights = self.weights_at(points).split(counts)
        maps = [part @ bones.flatten(1) for part, bones in zip(weights, self._bones, strict=True)]
        return apply_affine(torch.cat(maps).unflatten(1, (3, 4)), points)

    @torch.no_grad()
    def find_roots(
        self, posed: Float32[Tensor, "points 3"], bodies: Int64[Tensor, "points"]
    ) -> FoundRoots:
        """Searches for the canonical points that skinning carries to posed ones."""
        starts = self._bones[:, list(START_BONES)]
        rigid = invert_affine(starts)[bodies]
        shape = rigid.shape[:2]
        points = apply_affine(rigid, posed[:, None]).flatten(0, 1)
        inverse, body = rigid[..., :3].flatten(0, 1).clone(), bodies.repeat_interleave(shape[1])
        target = posed.repeat_interleave(shape[1], dim=0)
        residual = torch.full_like(points, torch.inf)
        active = self._near_skin.holds(points, torch.zeros_like(body)).nonzero()[:, 0]
        residual[active] = self.skin(points[active], body[active]) - target[active]
        for _ in range(SEARCH_STEPS):
            size = residual[active].norm(dim=1)
            active = active[(size > CONVERGED_M) & (size < DIVERGED_M)]
            if not len(active):
                break
            now, guess = residual[active], inverse[active]
            step = -(guess @ now[..., None])[..., 0]
            moved = points[active] + step
            after = self.skin(moved, body[active]) - target[active]
            change = (guess @ (after - now)[..., None])[..., 0]
            along = (step[:, None] @ guess)[:, 0]
            scale = (step * change).sum(dim=1, keepdim=True)
            scale = torch.where(scale.abs() < 1e-12, 1e-12, scale)
            inverse[active] = guess + ((step - change) / scale)[..., None] * along[:, None]
            points[active], residual[active] = moved, after
        valid = residual.norm(dim=1) < CONVERGED_M
        valid &= self._near_skin.holds(points, torch.zeros_like(body))
        points, valid = points.unflatten(0, shape), valid.unflatten(0, shape)
        for bone in range(1, shape[1]):
            near = (points[:, :bone] - points[:, bone : bone + 1]).norm(dim=2) < SAME_ROOT_M
            valid[:, bone] &= ~(near & valid[:, :bone]).any(dim=1)
        return FoundRoots(points, inverse.unflatten(0, shape), valid)

    def radiance(
        self, points: Float32[Tensor, "points 3"], directions: Float32[Tensor, "points 3"],
        bodies: Int64[Tensor, "points"], *, fine: bool,
    ) -> Float32[Tensor, "points 4"]:  # fmt: skip
        """The field at each point's densest root."""
        roots = self.find_roots(points, bodies)
        best = roots.valid.int().argmax(dim=1)
        several = (roots.valid.sum(dim=1) > 1).nonzero()[:, 0]
        if len(several):
            held = roots.valid[several]
            score = torch.full(held.shape, -torch.inf)
            with torch.no_grad():
                score[held] = self.network(roots.points[several][held])[:, 3]
            best[several] = score.argmax(dim=1)
        found = roots.valid.any(dim=1).nonzero()[:, 0]
        root, inverse = (part[found, best[found]] for part in (roots.points, roots.inverse))
        # d root = -J⁻¹ d skin(root): zero in value, the implicit gradient in the weights
        carried = self.skin(root, bodies[found])
        root = root - (inverse @ (carried - carried.detach())[..., None])[..., 0]
        raw = points.new_tensor([0.0, 0.0, 0.0, -30.0]).expand(len(points), 4)
        return raw.index_put((found,), self.network(root))

    def prior_loss(self) -> Tensor:
        """Skinning weights near the skin stay the body's."""
        return BODY_WEIGHT * self._weight_loss(BODY_POINTS)

    def _weight_loss(self, count: int) -> Tensor:
        chosen = torch.randint(len(self._person.vertices), (count,))
        wanted = self._person.weights[chosen]
        skin = self._person.vertices[chosen]
        logits = SOFTMAX_SCALE * self.skinning(skin + SKIN_SPREAD_M * torch.randn_like(skin))
        return nn.functional.cross_entropy(logits, wanted)

    def parameter_groups(self) -> list[dict[str, object]]:
        """The field's rate, and a tenth of it for the skinning weights."""
        rate = self._settings.learning_rate
        return [
            {"params": list(self.network.parameters()), "lr": rate},
            {"params": list(self.skinning.parameters()), "lr": SKINNING_RATE_FACTOR * rate},
        ]
