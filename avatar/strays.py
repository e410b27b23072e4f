"""Samples that a warp cell invents: skinning does not carry them to their ray.

A cell's warp is a root at its centre and how that moves about it. In the folds of armpits and
elbows the root of a centre ends within its cell, and what the warp says beyond that is no root at
all: a picture would show pieces of the body in mid-air, and specks. In a whole picture of a bent
body they are few thousandths of the samples, so that each can be asked where skinning carries it.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from avatar.cells import BAND_M, WarpCells
from avatar.kernels.backend import Rays, Samples
from avatar.kernels.cpu_cells import REACH_M, posed_volume
from avatar.kernels.cpu_skin import LANES
from avatar.kernels.cpu_stray import doubt, stray
from avatar.rig import Rig

FAR_M = 0.005
"""A point that is carried farther than this from its ray is none of it: about a pixel."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Strays:
    """Finds such samples in one pose.

    Attributes:
        doubtful: Rows of the cells' roots whose warp is wrong in some corner of their cell.
        transforms: Blended 3×4 matrices on the nodes of the weight volume.
        low, nodes_per_m: Where these lie.
    """

    doubtful: Bool[Tensor, "rows"]
    transforms: Float32[np.ndarray, "x y z lanes"]
    low: Float32[np.ndarray, "3"]
    nodes_per_m: Float32[np.ndarray, "3"]

    @classmethod
    def of(
        cls,
        rig: Rig,
        joint_rotations: Float[np.ndarray, "23 3"],
        cells: WarpCells,
        device: torch.device,
    ) -> "Strays":
        """Looks at every cell that is not empty.

        Args:
            rig: Whose body.
            joint_rotations: The pose that the cells warp.
            cells: Its warp; what is pruned is not looked at.
            device: Where samples will be.
        """
        bones = rig.body_from_canonical(joint_rotations)[:, :3].reshape(24, 12)
        volume = posed_volume(rig, bones.astype(np.float32), BAND_M + 2.0 * REACH_M)
        doubtful = np.zeros(len(cells.roots), dtype=bool)
        doubt(
            cells.index, cells.roots[None], cells.low, np.float32(cells.cell_m), *volume,
            np.float32(FAR_M), doubtful, np.empty(LANES, dtype=np.float32),
        )  # fmt: skip
        transforms, low, nodes_per_m = volume
        return cls(
            doubtful=torch.from_numpy(doubtful).to(device),
            transforms=transforms,
            low=low,
            nodes_per_m=nodes_per_m,
        )

    def among(self, samples: Samples, rays: Rays) -> Int64[Tensor, "strays"]:
        """Numbers of the samples that are not on their rays."""
        asked = self.doubtful[samples.rows.long()].nonzero()[:, 0]
        ray = torch.searchsorted(samples.first, asked, right=True) - 1
        parts = (samples.points[asked], rays.origins[ray], rays.directions[ray])
        found = np.empty(len(asked), dtype=bool)
        stray(
            *(part.cpu().numpy() for part in parts), self.transforms, self.low, self.nodes_per_m,
            np.float32(FAR_M), found, np.empty(LANES, dtype=np.float32),
        )  # fmt: skip
        return asked[torch.from_numpy(found).to(asked.device)]
