"""Warp cells: Fast-SNARF's canonical correspondence, solved once per cell of a frame.

Fast-SNARF (Chen et al. 2022) finds for every sample the canonical point that linear blend skinning
carries to it. The warp is smooth, so one solution per 3-cm cell, with its inverse Jacobian, serves
every sample in it: `x(p) = x* + J⁻¹ (p - center)`. J⁻¹ is also the implicit gradient of the root
with respect to the pose.

Cells are solved on the CPU, compiled, whatever backend the training step runs on; what a root is
says `avatar.kernels.skin.find_roots`, and a test holds the two together.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32

from avatar.kernels.cpu_cells import build_cells
from avatar.rig import Rig

CELL_M = 0.03
BAND_M = 0.08
"""How far from the skin clothes and hair may reach."""


@dataclass(frozen=True, eq=False, kw_only=True)
class WarpCells:
    """The warp of one frame, from its body frame to canonical space.

    Attributes:
        low: Corner of the grid, body frame, metres.
        cell_m: Edge of a cell, metres.
        index: `first_root * 4 + count` for each cell, 0 where nothing of the body is near.
        roots: Canonical root at the cell's centre, then the inverse Jacobian, row by row. Row 0
            is unused.
    """

    low: Float32[np.ndarray, "3"]
    cell_m: float
    index: Int32[np.ndarray, "gx gy gz"]
    roots: Float32[np.ndarray, "roots 12"]

    @classmethod
    def of(
        cls,
        rig: Rig,
        joint_rotations: Float[np.ndarray, "23 3"],
        *,
        band_m: float = BAND_M,
        cell_m: float = CELL_M,
    ) -> "WarpCells":
        """Solves the warp of one pose.

        Args:
            rig: Whose body.
            joint_rotations: Axis-angle of joints 1 … 23; the root plays no part.
            band_m: How far from the skin there may be anything, metres.
            cell_m: Edge of a cell, metres.
        """
        bones = rig.body_from_canonical(joint_rotations)[:, :3].reshape(24, 12)
        bones = bones.astype(np.float32)
        near, near_weights = rig.near_nodes
        transforms = np.zeros((*rig.weights.shape[:3], 12), dtype=np.float32)
        transforms.reshape(-1, 12)[near] = near_weights @ bones
        seeds, inverses = _posed_seeds(rig, bones)
        low = seeds.min(axis=0) - band_m
        shape = np.ceil((seeds.max(axis=0) + band_m - low) / cell_m).astype(int)
        index = np.empty(tuple(shape), dtype=np.int32)
        nodes = np.array(rig.weights.shape[:3], dtype=np.float32) - 1
        cells = np.array(rig.distance.shape, dtype=np.float32)
        extent = rig.box_high - rig.box_low
        capacity = index.size // 5
        while True:
            roots = np.empty((capacity, 12), dtype=np.float32)
            count = build_cells(
                transforms, rig.box_low, nodes / extent, seeds, inverses, rig.seed_parts,
                low, np.float32(cell_m), np.float32(band_m + 0.012 + 0.6 * cell_m),
                rig.distance, cells / extent, np.float32(band_m + 0.5 * cell_m), index, roots,
            )  # fmt: skip
            if count <= capacity:
                return cls(low=low, cell_m=cell_m, index=index, roots=roots[:count].copy())
            capacity = count


def _posed_seeds(
    rig: Rig, bones: Float32[np.ndarray, "24 12"]
) -> tuple[Float32[np.ndarray, "seeds 3"], Float32[np.ndarray, "seeds 12"]]:
    """Seeds in the body frame, and each one's inverse blended transform."""
    blended = (rig.seed_weights @ bones).reshape(-1, 3, 4)
    rotation, translation = blended[:, :, :3], blended[:, :, 3]
    posed = np.einsum("sab,sb->sa", rotation, rig.seeds) + translation
    inverse = np.linalg.inv(rotation)
    shift = -np.einsum("sab,sb->sa", inverse, translation)
    inverses = np.concatenate([inverse, shift[:, :, None]], axis=2).reshape(-1, 12)
    return posed.astype(np.float32), np.ascontiguousarray(inverses, dtype=np.float32)
