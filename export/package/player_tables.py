"""The player's tables as stored integers: surfels, sparse bricks and a skinning grid."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int8, Int32, UInt, UInt8, UInt16

BRICK_SIZE = 8
"""Voxels along a brick's edge that are its own."""
BRICK_NODES = BRICK_SIZE + 1
"""Voxels along a brick's edge with the layer it shares with its next neighbor."""
LOG_DENSITY_RANGE = (float(np.log(0.5)), float(np.log(3000.0)))
"""Range of the 8-bit log-density, density in 1/m; code 0 means empty."""
WEIGHT_SCALE = 65535
"""Code of the skinning weight 1."""
THICKNESS_STEP_M = 0.0005
"""Thickness of code 1, metres."""
COLOR_CODE_STEP = 8
"""Multiple to which color codes are rounded: invisible, and bytes halve."""
DENSITY_CODE_STEP = 16
"""Multiple to which density codes are rounded: steps of 72 %, invisible, and bytes halve."""
SURFEL_BITS = 17
"""Low bits of a z-buffer key, which number the surfel."""
SURFEL_MASK = (1 << SURFEL_BITS) - 1
"""Mask of those bits."""
DEPTH_CODES = 1 << (31 - SURFEL_BITS)
"""Depths that a z-buffer key distinguishes, in its high 14 bits."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SurfelTable:
    """Points of the proxy surface, just outside the visible density, in canonical space.

    Attributes:
        low: Corner of the position codes' cube, metres.
        extent_m: Edge of that cube; position = low + code / 65535 · extent.
        spacing_m: Distance between neighbors, about, metres.
        position_codes: Sorted along a Morton curve.
        normal_codes: Outward unit normals × 127.
        thickness_codes: Visible depth along the inward normal, in units of `THICKNESS_STEP_M`.
    """

    low: Float32[np.ndarray, "3"]
    extent_m: float
    spacing_m: float
    position_codes: UInt16[np.ndarray, "surfels 3"]
    normal_codes: Int8[np.ndarray, "surfels 3"]
    thickness_codes: UInt8[np.ndarray, "surfels"]

    def __len__(self) -> int:
        """Number of surfels."""
        return len(self.position_codes)

    @property
    def positions(self) -> Float32[np.ndarray, "surfels 3"]:
        """Canonical positions, metres."""
        step = np.float32(self.extent_m / 65535.0)
        return self.low + self.position_codes.astype(np.float32) * step

    @property
    def normals(self) -> Float32[np.ndarray, "surfels 3"]:
        """Outward canonical normals, of length 1 within 5 %."""
        return self.normal_codes.astype(np.float32) / np.float32(127.0)

    @property
    def thickness(self) -> Float32[np.ndarray, "surfels"]:
        """Metres along the normal."""
        return self.thickness_codes.astype(np.float32) * np.float32(THICKNESS_STEP_M)


@dataclass(frozen=True, eq=False, kw_only=True)
class BrickTable:
    """Color and log-density on a voxel grid, stored only near the surface.

    Grid node (i, j, k) lies at `low + voxel_m · (i, j, k)`.

    Attributes:
        low: Corner of the grid, canonical metres.
        voxel_m: Distance between nodes.
        index: Number of the brick that covers each 8×8×8 block of nodes; 0 is the empty one.
        voxels: RGB and log-density codes of each brick's 9×9×9 nodes.
    """

    low: Float32[np.ndarray, "3"]
    voxel_m: float
    index: Int32[np.ndarray, "bx by bz"]
    voxels: UInt8[np.ndarray, "bricks 9 9 9 4"]


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinningGrid:
    """Skinning weights on the nodes of a grid, stored only about visible density.

    Node (i, j, k) lies at `low + step_m · (i, j, k)`; between nodes weights are trilinear.

    Attributes:
        low: Corner of the grid, canonical metres.
        step_m: Distance between nodes along x, y, z.
        index: Column of the codes for each node, numbered in C order; 0 for none.
        weight_codes: Weights × `WEIGHT_SCALE`. Column 0 is the root alone.
    """

    low: Float32[np.ndarray, "3"]
    step_m: Float32[np.ndarray, "3"]
    index: Int32[np.ndarray, "x y z"]
    weight_codes: UInt16[np.ndarray, "24 columns"]

    @property
    def weights(self) -> Float32[np.ndarray, "columns 24"]:
        """Skinning weights; rows sum to 1 within 0.01 %."""
        return self.weight_codes.T.astype(np.float32) / np.float32(WEIGHT_SCALE)


@dataclass(frozen=True, eq=False, kw_only=True)
class PlayerTables:
    """Everything that a tier of the player draws.

    Attributes:
        surfels: The proxy surface.
        bricks: Color and density under it.
        skinning: Weights that move both.
        pelvis: Rest pelvis in canonical space, metres: the middle of the z-buffer's depth range.
        reach_m: Largest distance of a surfel from the pelvis in any pose, metres.
    """

    surfels: SurfelTable
    bricks: BrickTable
    skinning: SkinningGrid
    pelvis: Float32[np.ndarray, "3"]
    reach_m: float


def encode_density(density: Float[np.ndarray, "*batch"]) -> UInt8[np.ndarray, "*batch"]:
    """Quantize densities in 1/m logarithmically; those below the range become 0, which is empty."""
    return np.clip(np.round(density_code(np.maximum(density, 1e-9))), 0, 255).astype(np.uint8)


def density_code(density: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Return codes of positive densities in 1/m, neither rounded nor clipped."""
    low, high = LOG_DENSITY_RANGE
    return (np.log(density) - low) / (high - low) * 255.0


def decode_density(code: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Return densities in 1/m of interpolated codes; below half a code they are 0."""
    low, high = LOG_DENSITY_RANGE
    return np.where(code > 0.5, np.exp(code * ((high - low) / 255.0) + low), 0.0)


def round_codes(
    codes: UInt[np.ndarray, "*batch"], step: int, largest: int
) -> UInt[np.ndarray, "*batch"]:
    """Round to multiples of a step, at most the last one up to the largest code."""
    most = largest // step
    return (np.minimum((codes.astype(np.uint32) + step // 2) // step, most) * step).astype(
        codes.dtype
    )
