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

from avatar.deformation.correspondence_grid import CLOTHING_BAND_M, CorrespondenceGrid
from avatar.deformation.rig import Rig
from avatar.kernels.backend_protocol import RayBatch, RaySamples
from avatar.numba_kernels.numba_correspondence import SEARCH_MARGIN_M, blended_transform_volume
from avatar.numba_kernels.numba_culling import find_off_ray_points, find_unreliable_roots
from avatar.numba_kernels.numba_skinning import MATRIX_LANES

MAX_RAY_DISTANCE_M = 0.005
"""A point that is carried farther than this from its ray is none of it: about a pixel."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrespondenceCheck:
    """Finds such samples in one pose.

    Attributes:
        doubtful: Rows of the cells' roots whose warp is wrong in some corner of their cell.
        transforms: Blended 3×4 matrices on the nodes of the weight volume.
        low, nodes_per_m: Where these lie.
    """

    unreliable_rows: Bool[Tensor, "rows"]
    transforms: Float32[np.ndarray, "x y z lanes"]
    low: Float32[np.ndarray, "3"]
    nodes_per_m: Float32[np.ndarray, "3"]

    @classmethod
    def for_pose(
        cls,
        rig: Rig,
        joint_rotations: Float[np.ndarray, "23 3"],
        cells: CorrespondenceGrid,
        device: torch.device,
    ) -> "CorrespondenceCheck":
        """Looks at every cell that is not empty.

        Args:
            rig: Whose body.
            joint_rotations: The pose that the cells warp.
            cells: Its warp; what is pruned is not looked at.
            device: Where samples will be.
        """
        bones = rig.body_from_canonical(joint_rotations)[:, :3].reshape(24, 12)
        volume = blended_transform_volume(
            rig, bones.astype(np.float32), CLOTHING_BAND_M + 2.0 * SEARCH_MARGIN_M
        )
        doubtful = np.zeros(len(cells.roots), dtype=bool)
        find_unreliable_roots(
            cells.packed_cells, cells.roots[None], cells.low, np.float32(cells.cell_m), *volume,
            np.float32(MAX_RAY_DISTANCE_M), doubtful, np.empty(MATRIX_LANES, dtype=np.float32),
        )  # fmt: skip
        transforms, low, nodes_per_m = volume
        return cls(
            unreliable_rows=torch.from_numpy(doubtful).to(device),
            transforms=transforms,
            low=low,
            nodes_per_m=nodes_per_m,
        )

    def find_spurious(self, samples: RaySamples, rays: RayBatch) -> Int64[Tensor, "strays"]:
        """Numbers of the samples that are not on their rays."""
        asked = self.unreliable_rows[samples.root_rows.long()].nonzero()[:, 0]
        ray = torch.searchsorted(samples.offsets, asked, right=True) - 1
        parts = (samples.points[asked], rays.origins[ray], rays.directions[ray])
        found = np.empty(len(asked), dtype=bool)
        find_off_ray_points(
            *(part.cpu().numpy() for part in parts), self.transforms, self.low, self.nodes_per_m,
            np.float32(MAX_RAY_DISTANCE_M), found, np.empty(MATRIX_LANES, dtype=np.float32),
        )  # fmt: skip
        return asked[torch.from_numpy(found).to(asked.device)]
