"""What one picture may skip: warp cells that lead to nothing, and pixels that see none of them."""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float
from scipy.ndimage import distance_transform_cdt

from avatar.cells import CorrespondenceGrid
from avatar.kernels.backend import DensityGrid
from avatar.kernels.cpu_prune import cull_cells
from capture.camera import Camera

MIN_DEPTH_M = 0.05
"""What lies closer before the camera's plane than this has no place in the picture's plane."""


def cull_cells(cells: CorrespondenceGrid, grid: DensityGrid) -> CorrespondenceGrid:
    """The same warp without the cells that lead to nothing occupied; the others keep every sample.

    In the index of an empty cell stands how far a ray may go on from it (`CorrespondenceTables`): the
    paper's grid per frame (§3.3, inference), without a pass of the network.
    """
    index = np.empty_like(cells.packed_cells)
    cull_cells(
        cells.packed_cells.reshape(-1), cells.roots, np.float32(cells.cell_m),
        *(part.cpu().numpy() for part in (grid.occupied, grid.low, grid.cells_per_m)),
        index.reshape(-1),
    )  # fmt: skip
    if not index.any():
        return dataclasses.replace(cells, packed_cells=index)
    away = np.asarray(distance_transform_cdt(index == 0, metric="chessboard"))
    return dataclasses.replace(cells, packed_cells=np.where(index == 0, -away, index).astype(np.int32))


def screen_bounds(
    cells: CorrespondenceGrid, camera: Camera, world_from_body: Float[np.ndarray, "4 4"]
) -> tuple[slice, slice]:
    """Rows and columns of the picture outside of which no ray meets a cell that holds anything."""
    width, height = camera.size_px
    whole = slice(0, height), slice(0, width)
    held = np.argwhere(cells.packed_cells > 0)
    if not len(held):
        return slice(0, 0), slice(0, 0)
    sides = np.stack([held.min(axis=0), held.max(axis=0) + 1]) * cells.cell_m + cells.low
    corners = np.array(list(itertools.product(*sides.T)))
    in_world = corners @ world_from_body[:3, :3].T + world_from_body[:3, 3]
    depth = in_world @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    if camera.distortion or depth.min() < MIN_DEPTH_M:  # the picture of a box is no hull of corners
        return whole
    pixels = camera.project(in_world)
    left, top = np.floor(pixels.min(axis=0)).clip(0).astype(int).tolist()
    right, bottom = np.ceil(pixels.max(axis=0)).clip(0, camera.size_px).astype(int).tolist()
    return slice(top, bottom), slice(left, right)
