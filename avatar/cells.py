"""Warp cells: Fast-SNARF's canonical correspondence, solved once per cell of a frame.

Fast-SNARF (Chen et al. 2022) finds for every sample the canonical point that linear blend skinning
carries to it. The warp is smooth, so one solution per 3-cm cell, with its inverse Jacobian A,
serves every sample in it: `x(p) = x* + A d`, d = p - center. Where joints bend it a second-order
term is added, `Σ c_ij d_i d_j`. A is also the implicit gradient of the root with respect to the
pose.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32

from avatar.kernels.choice import backend_for
from avatar.rig import Rig

CORRESPONDENCE_CELL_M = 0.03
CLOTHING_BAND_M = 0.08
"""How far from the skin clothes and hair may reach."""
CPU = torch.device("cpu")


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrespondenceGrid:
    """The warp of one frame, from its body frame to canonical space.

    Attributes:
        low: Corner of the grid, body frame, metres.
        cell_m: Edge of a cell, metres.
        index: `first_row * 8 + bent * 4 + count` for each cell, 0 where nothing of the body is
            near. A root takes one row, in a bent cell three.
        roots: Canonical root at the cell's centre, then A row by row. The two rows after it hold
            c_xx, c_yy, c_zz, c_xy, c_xz and c_yz, three numbers each, if the cell is bent. Row 0
            is unused.
    """

    low: Float32[np.ndarray, "3"]
    cell_m: float
    packed_cells: Int32[np.ndarray, "gx gy gz"]
    roots: Float32[np.ndarray, "rows 12"]

    @classmethod
    def solve(
        cls,
        rig: Rig,
        joint_rotations: Float[np.ndarray, "23 3"],
        *,
        band_m: float = CLOTHING_BAND_M,
        cell_m: float = CORRESPONDENCE_CELL_M,
        device: torch.device = CPU,
    ) -> "CorrespondenceGrid":
        """Solves the warp of one pose.

        Args:
            rig: Whose body.
            joint_rotations: Axis-angle of joints 1 … 23; the root plays no part.
            band_m: How far from the skin there may be anything, metres; not beyond the rig's box.
            cell_m: Edge of a cell, metres.
            device: Where to solve.
        """
        bones = rig.body_from_canonical(joint_rotations)[:, :3].reshape(24, 12)
        solved = backend_for(device).solve_correspondences(
            rig, bones.astype(np.float32), band_m, cell_m, device
        )
        return cls(low=solved.low, cell_m=cell_m, index=solved.packed_cells, roots=solved.roots)
