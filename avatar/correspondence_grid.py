"""Correspondence grid: Fast-SNARF's canonical correspondences, solved once per cell of a frame.

Fast-SNARF (Chen et al. 2022) finds for every sample the canonical point that linear blend skinning
carries to it. The warp is smooth, so one solution per 3-cm cell, with its inverse Jacobian A,
serves all samples in the cell: `x(p) = x* + A d` with d = p - center. Near bent joints a
second-order term `Σ c_ij d_i d_j` is added. A is also the implicit gradient of the root with
respect to the pose.

A rendering culls the cells that lead to unoccupied space, and the pixels that see none of the rest.
It also drops spurious correspondences, which skinning does not carry to their ray: a cell
extrapolates its warp from the root at its center, which in the folds of armpits and elbows ends
within the cell. They would show as specks and floating pieces of the body; they are a few
thousandths of the samples, few enough to skin each.
"""

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int32, Int64
from scipy.ndimage import distance_transform_cdt
from torch import Tensor

from avatar.kernels.numba_correspondence import (
    SEARCH_MARGIN_M,
    TransformVolume,
    blended_transform_volume,
    find_off_ray_points,
    find_unreliable_roots,
    solve_correspondences,
)
from avatar.kernels.numba_correspondence import cull_cells as cull_cells_numba
from avatar.kernels.numba_skinning import MATRIX_LANES
from avatar.kernels.operands import DensityGrid, RayBatch, RaySamples
from avatar.rig import CLOTHING_BAND_M, Rig
from capture.camera import Camera
from preprocess.body.body_surface import NEAR_PLANE_M

CORRESPONDENCE_CELL_M = 0.03


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrespondenceGrid:
    """Correspondences of one pose, from the body frame to canonical space.

    Attributes:
        low: Corner of the grid, body frame, metres.
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
    ) -> "CorrespondenceGrid":
        """Solves a pose, but for its root, up to `band_m` from the skin, within the rig's box."""
        bones = rig.body_from_canonical(joint_rotations)[:, :3].reshape(24, 12)
        low, packed_cells, roots = solve_correspondences(
            rig, bones.astype(np.float32), band_m, CORRESPONDENCE_CELL_M
        )
        return cls(low=low, cell_m=CORRESPONDENCE_CELL_M, packed_cells=packed_cells, roots=roots)


def cull_cells(cells: CorrespondenceGrid, grid: DensityGrid) -> CorrespondenceGrid:
    """Empties the cells that lead to unoccupied space; no sample of another cell is lost.

    An empty cell stores its distance to the next full one (`CorrespondenceTables`). This replaces
    the paper's grid per frame (§3.3, inference) without evaluating the field.
    """
    index = np.empty_like(cells.packed_cells)
    cull_cells_numba(
        cells.packed_cells.reshape(-1), cells.roots, np.float32(cells.cell_m),
        *(part.numpy() for part in (grid.occupied, grid.low, grid.cells_per_m)),
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
    if camera.distortion or depth.min() < NEAR_PLANE_M:  # the projected corners bound no box
        return whole
    pixels = camera.project(in_world)
    left, top = np.floor(pixels.min(axis=0)).clip(0).astype(int).tolist()
    right, bottom = np.ceil(pixels.max(axis=0)).clip(0, camera.size_px).astype(int).tolist()
    return slice(top, bottom), slice(left, right)


MAX_RAY_DISTANCE_M = 0.005
"""Distance from its ray beyond which a skinned sample is spurious, metres: about a pixel."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CorrespondenceCheck:
    """Finds the spurious samples of one pose.

    `unreliable_rows` are the root rows whose warp is wrong in some corner of their cell.
    """

    unreliable_rows: Bool[Tensor, "rows"]
    volume: TransformVolume

    @classmethod
    def for_pose(
        cls, rig: Rig, joint_rotations: Float[np.ndarray, "23 3"], cells: CorrespondenceGrid
    ) -> "CorrespondenceCheck":
        """Checks the corners of every full cell of a pose's culled grid."""
        bones = rig.body_from_canonical(joint_rotations)[:, :3].reshape(24, 12)
        volume = blended_transform_volume(
            rig, bones.astype(np.float32), CLOTHING_BAND_M + 2.0 * SEARCH_MARGIN_M
        )
        unreliable = np.zeros(len(cells.roots), dtype=bool)
        find_unreliable_roots(
            cells.packed_cells, cells.roots[None], cells.low, np.float32(cells.cell_m), *volume,
            np.float32(MAX_RAY_DISTANCE_M), unreliable, np.empty(MATRIX_LANES, dtype=np.float32),
        )  # fmt: skip
        return cls(unreliable_rows=torch.from_numpy(unreliable), volume=volume)

    def find_spurious(self, samples: RaySamples, rays: RayBatch) -> Int64[Tensor, "spurious"]:
        """Indices of the samples that skinning does not carry to their rays."""
        asked = self.unreliable_rows[samples.root_rows.long()].nonzero()[:, 0]
        ray = torch.searchsorted(samples.offsets, asked, right=True) - 1
        parts = (samples.points[asked], rays.origins[ray], rays.directions[ray])
        found = np.empty(len(asked), dtype=bool)
        find_off_ray_points(
            *(part.numpy() for part in parts), *self.volume, np.float32(MAX_RAY_DISTANCE_M), found,
            np.empty(MATRIX_LANES, dtype=np.float32),
        )  # fmt: skip
        return asked[torch.from_numpy(found)]
