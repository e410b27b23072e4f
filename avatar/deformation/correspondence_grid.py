"""Correspondence grid: Fast-SNARF's canonical correspondences, solved once per cell of a frame.

Fast-SNARF (Chen et al. 2022) finds for every sample the canonical point that linear blend skinning
carries to it. The warp is smooth, so one solution per 3-cm cell, with its inverse Jacobian A,
serves all samples in the cell: `x(p) = x* + A d` with d = p - center. Near bent joints a
second-order term `Σ c_ij d_i d_j` is added. A is also the implicit gradient of the root with
respect to the pose.

A rendering culls the cells that lead to unoccupied space, and the pixels that see none of the rest.
"""

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32, Int32
from scipy.ndimage import distance_transform_cdt

from avatar.backends import backend_for
from avatar.deformation.rig import CLOTHING_BAND_M, Rig
from avatar.kernels.backend_protocol import DensityGrid
from avatar.numba_kernels.numba_culling import cull_cells as cull_cells_numba
from capture.camera import Camera

CORRESPONDENCE_CELL_M = 0.03
"""Edge of a cell, metres."""
CPU = torch.device("cpu")


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrespondenceGrid:
    """Correspondences of one pose, from the body frame to canonical space.

    Attributes:
        low: Corner of the grid, body frame, metres.
        cell_m: Edge of a cell, metres.
        packed_cells: `first_row * 8 + bent * 4 + count` of each cell, 0 far from the body. A root
            takes one row, or three in a bent cell.
        roots: Canonical root at the cell's center, then A row by row. In a bent cell the next two
            rows hold c_xx, c_yy, c_zz, c_xy, c_xz and c_yz, three numbers each. Row 0 is unused.
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
        """Solves the correspondences of one pose.

        Args:
            rig: Rig of the person.
            joint_rotations: Axis-angle rotations of joints 1 to 23; the root plays no part.
            band_m: Distance from the skin that is covered, metres; at most to the rig's box.
            cell_m: Edge of a cell, metres.
            device: Device that solves.
        """
        bones = rig.body_from_canonical(joint_rotations)[:, :3].reshape(24, 12)
        solved = backend_for(device).solve_correspondences(
            rig, bones.astype(np.float32), band_m, cell_m, device
        )
        return cls(
            low=solved.low, cell_m=cell_m, packed_cells=solved.packed_cells, roots=solved.roots
        )


MIN_DEPTH_M = 0.05
"""Depth below which a corner of the box cannot be projected, metres."""


def cull_cells(cells: CorrespondenceGrid, grid: DensityGrid) -> CorrespondenceGrid:
    """Empties the cells that lead to unoccupied space; no sample of another cell is lost.

    An empty cell stores its distance to the next full one (`CorrespondenceTables`). This replaces
    the paper's grid per frame (§3.3, inference) without evaluating the field.
    """
    index = np.empty_like(cells.packed_cells)
    cull_cells_numba(
        cells.packed_cells.reshape(-1), cells.roots, np.float32(cells.cell_m),
        *(part.cpu().numpy() for part in (grid.occupied, grid.low, grid.cells_per_m)),
        index.reshape(-1),
    )  # fmt: skip
    if not index.any():
        return dataclasses.replace(cells, packed_cells=index)
    away = np.asarray(distance_transform_cdt(index == 0, metric="chessboard"))
    return dataclasses.replace(
        cells, packed_cells=np.where(index == 0, -away, index).astype(np.int32)
    )


def screen_bounds(
    cells: CorrespondenceGrid, camera: Camera, world_from_body: Float[np.ndarray, "4 4"]
) -> tuple[slice, slice]:
    """Rows and columns of the image outside of which no ray meets a full cell."""
    width, height = camera.size_px
    whole = slice(0, height), slice(0, width)
    held = np.argwhere(cells.packed_cells > 0)
    if not len(held):
        return slice(0, 0), slice(0, 0)
    sides = np.stack([held.min(axis=0), held.max(axis=0) + 1]) * cells.cell_m + cells.low
    corners = np.array(list(itertools.product(*sides.T)))
    in_world = corners @ world_from_body[:3, :3].T + world_from_body[:3, 3]
    depth = in_world @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    if camera.distortion or depth.min() < MIN_DEPTH_M:  # the projected corners bound no box
        return whole
    pixels = camera.project(in_world)
    left, top = np.floor(pixels.min(axis=0)).clip(0).astype(int).tolist()
    right, bottom = np.ceil(pixels.max(axis=0)).clip(0, camera.size_px).astype(int).tolist()
    return slice(top, bottom), slice(left, right)
