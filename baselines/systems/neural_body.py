"""Neural Body (Peng et al. 2021): a code for every vertex, diffused by a sparse 3-D network.

The codes lie where the posed vertices are; there is no canonical space. What is read at a posed
point, with its place, the view direction and a code of the frame, gives density and color.
"""

from typing import final

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

from baselines.systems.method_settings import MethodSettings, encode_positions
from baselines.systems.posed_person import OccupiedCells, PosedBodies, SkinnedPerson
from baselines.systems.voxel_convolution import ActiveVoxels, CodeDiffusion, read_volumes

COARSEST = 16
"""Stride of the coarsest volume; a grid ends at voxels of every stride."""
VIEW_OCTAVES = 4
"""Octaves of the encoded view direction."""

PRESETS = {
    "paper": MethodSettings(frames=1, rays=1024, samples=64, alpha_weight=0.0, voxel_m=0.005),
    "small": MethodSettings(
        frames=1, rays=128, samples=24, width=96, octaves=6, learning_rate=4e-3, voxel_m=0.02,
        channels=8,
    ),
}  # fmt: skip


@final
class NeuralBody(nn.Module):
    """The method: codes, their diffusion, and the heads of density and color."""

    def __init__(self, person: SkinnedPerson, frames: int, settings: MethodSettings) -> None:
        """Draws codes and networks, for a number of training frames."""
        super().__init__()
        self._settings, width = settings, settings.width
        self.codes = nn.Embedding(len(person.vertices), settings.channels)
        self.frame_codes = nn.Embedding(frames, width // 2)
        self.diffusion = CodeDiffusion(settings.channels)
        self._trunk = nn.Sequential(
            nn.Linear(sum(self.diffusion.widths), width), nn.ReLU(),
            nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
        )  # fmt: skip
        self._density = nn.Linear(width, 1)
        self._joined = nn.Linear(width + width // 2, width)
        seen = 3 + 6 * VIEW_OCTAVES + 3 + 6 * settings.octaves
        self._color = nn.Sequential(
            nn.Linear(width + seen, width // 2), nn.ReLU(), nn.Linear(width // 2, 3)
        )

    def pose(self, bodies: PosedBodies) -> OccupiedCells:
        """Lays the codes out and diffuses them."""
        self._lows, self._volumes = [], []
        for skin in bodies.vertices:
            low = skin.amin(dim=0) - self._settings.reach_m
            self._lows.append(low)
            self._volumes.append(self.diffuse((skin - low) / self._settings.voxel_m))
        mean = self.frame_codes.weight.mean(dim=0)
        known = self.frame_codes(bodies.frames.clamp(min=0))
        self._frame_codes = torch.where((bodies.frames >= 0)[:, None], known, mean)
        return OccupiedCells.around(bodies.vertices, self._settings.reach_m)

    def diffuse(self, places: Float32[Tensor, "vertices 3"]) -> list[Float32[Tensor, "1 _ _ _ _"]]:
        """The volumes of codes that lie at places, in voxels; codes of one voxel are averaged."""
        beyond = self._settings.reach_m / self._settings.voxel_m
        x, y, z = (
            COARSEST * (int(size) // COARSEST + 1) + 1
            for size in (places.amax(dim=0) + beyond).ceil()
        )
        cell = places.long()
        flat = (cell[:, 0] * y + cell[:, 1]) * z + cell[:, 2]
        active, row, count = torch.unique(flat, return_inverse=True, return_counts=True)
        summed = torch.zeros(len(active), self._settings.channels)
        features = summed.index_add(0, row, self.codes.weight) / count[:, None]
        where = torch.stack([active // (y * z), active // z % y, active % z], dim=1)
        return self.diffusion(features, ActiveVoxels(where, (x, y, z)))

    def radiance(
        self, points: Float32[Tensor, "points 3"], directions: Float32[Tensor, "points 3"],
        bodies: Int64[Tensor, "points"], *, fine: bool,
    ) -> Float32[Tensor, "points 4"]:  # fmt: skip
        """The heads at what the volumes hold there."""
        read = points.new_zeros(len(points), sum(self.diffusion.widths))
        for body, (low, volumes) in enumerate(zip(self._lows, self._volumes, strict=True)):
            mine = (bodies == body).nonzero()[:, 0]
            # the center of a voxel counts as its place
            place = (points[mine] - low) / self._settings.voxel_m - 0.5
            read = read.index_put((mine,), read_volumes(volumes, place))
        hidden = self._trunk(read)
        joined = self._joined(torch.cat([hidden, self._frame_codes[bodies]], dim=1))
        views = encode_positions(directions, VIEW_OCTAVES)
        places = encode_positions(points, self._settings.octaves)
        color = self._color(torch.cat([joined, views, places], dim=1))
        return torch.cat([color, self._density(hidden)], dim=1)

    def prior_loss(self) -> Tensor:
        """None."""
        return torch.zeros(())

    def parameter_groups(self) -> list[dict[str, object]]:
        """One rate for all."""
        return [{"params": list(self.parameters()), "lr": self._settings.learning_rate}]
