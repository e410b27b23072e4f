"""Finds spurious correspondences: canonical samples that skinning does not carry to their ray.

A cell extrapolates its warp from the root at its center. In the folds of armpits and elbows that
root ends within the cell, and the extrapolation beyond it is no root: an image would show specks
and floating pieces of the body. In an image of a bent body these are a few thousandths of the
samples, few enough to skin each of them.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from avatar.deformation.correspondence_grid import CorrespondenceGrid
from avatar.deformation.rig import CLOTHING_BAND_M, Rig
from avatar.kernels.backend_protocol import RayBatch, RaySamples
from avatar.numba_kernels.numba_correspondence import SEARCH_MARGIN_M, blended_transform_volume
from avatar.numba_kernels.numba_culling import find_off_ray_points, find_unreliable_roots
from avatar.numba_kernels.numba_skinning import MATRIX_LANES

MAX_RAY_DISTANCE_M = 0.005
"""Distance from its ray beyond which a skinned sample is spurious, metres: about a pixel."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrespondenceCheck:
    """Finds the spurious samples of one pose.

    Attributes:
        unreliable_rows: Root rows whose warp is wrong in some corner of their cell.
        transforms: Blended 3×4 matrices at the nodes of the skinning volume.
        low, nodes_per_m: Corner of that volume, metres, and nodes per metre.
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
        """Checks the corners of every full cell.

        Args:
            rig: Rig of the person.
            joint_rotations: Pose of the cells.
            cells: Correspondence grid of the pose, culled.
            device: Device of the samples.
        """
        bones = rig.body_from_canonical(joint_rotations)[:, :3].reshape(24, 12)
        volume = blended_transform_volume(
            rig, bones.astype(np.float32), CLOTHING_BAND_M + 2.0 * SEARCH_MARGIN_M
        )
        unreliable = np.zeros(len(cells.roots), dtype=bool)
        find_unreliable_roots(
            cells.packed_cells, cells.roots[None], cells.low, np.float32(cells.cell_m), *volume,
            np.float32(MAX_RAY_DISTANCE_M), unreliable, np.empty(MATRIX_LANES, dtype=np.float32),
        )  # fmt: skip
        transforms, low, nodes_per_m = volume
        return cls(
            unreliable_rows=torch.from_numpy(unreliable).to(device),
            transforms=transforms,
            low=low,
            nodes_per_m=nodes_per_m,
        )

    def find_spurious(self, samples: RaySamples, rays: RayBatch) -> Int64[Tensor, "spurious"]:
        """Indices of the samples that skinning does not carry to their rays."""
        asked = self.unreliable_rows[samples.root_rows.long()].nonzero()[:, 0]
        ray = torch.searchsorted(samples.offsets, asked, right=True) - 1
        parts = (samples.points[asked], rays.origins[ray], rays.directions[ray])
        found = np.empty(len(asked), dtype=bool)
        find_off_ray_points(
            *(part.cpu().numpy() for part in parts), self.transforms, self.low, self.nodes_per_m,
            np.float32(MAX_RAY_DISTANCE_M), found, np.empty(MATRIX_LANES, dtype=np.float32),
        )  # fmt: skip
        return asked[torch.from_numpy(found).to(asked.device)]
