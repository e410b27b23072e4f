"""The player's tables as stored integers (surfels, bricks, a skinning grid), and how to draw them.

`RenderSettings` are the numbers that the graph and its reference share; quality tiers are made of
them.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int8, Int32, UInt, UInt8, UInt16

MAX_TRUSTED_COMPRESSION = 3.0
"""Canonical metres per metre along a ray above which the skin of a close-up counts as compressed: a
footprint spans centimetres of cloth there, over which skinning is far from linear."""
MIN_FOOTPRINT_PX = 3
"""Edge of a surfel's footprint from which a picture counts as a close-up: rays have one more block
and are not followed through compressed skin, and specks are filtered. Below, pixels are as coarse
as specks, and the texture is, too."""
MIN_MEDIAN_ALPHA = 0.9
"""Least alpha of the median about a pixel that counts as the inside of the avatar."""
MAX_MEDIAN_DIFFERENCE = 0.15
"""Difference of any channel from that median, in [0, 1], above which the pixel is a speck."""
HOLE_SPACINGS = 1, 2, 3
"""Distances of opposite pixels that close a hole, surfel spacings; each at least a footprint."""


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Settings of one tier, by which it draws the tables. The names are keys of manifest.json."""

    layers: int = 2
    """Depth layers of surfels, at least 1."""

    # Samples along a ray
    samples: int = 10
    """Density samples along `sample_span_m`, unless `Player.render` is given another number."""
    sample_span_m: float = 0.05
    """Length that `samples` refers to, metres."""
    block_samples: int = 3
    """Density samples in a block; a ray has one color sample and one Newton step per block."""
    uniform_blocks: int = 3
    """Blocks at the nominal spacing; each later block doubles the spacing of the one before."""
    max_blocks: int = 6
    """Blocks per ray; the last covers what remains. Both counts are one more in close-ups
    (`MIN_FOOTPRINT_PX`), and grow with the number of samples. 1: all rays are drawn as those of
    further layers are, whatever the number of samples."""
    further_layer_samples: int = 6
    """Density samples of a ray in each layer after the first, in a single block."""
    min_transmittance: float = 0.01
    """Stop a ray of the first layer below this transmittance."""
    skinning_subdivision: int = 2
    """Parts, 1 or 2, into which a step of the skinning grid is cut; positions are linear within."""
    max_correction_m: float = 0.01
    """Longest Newton step of a ray's canonical position, metres."""
    max_compression: float = 1e9
    """Canonical metres per metre along a ray above which spacing and `max_entry_margin_m` shrink in
    proportion, except in the last block; a segment is shortened by no larger factor."""

    # Footprints in the z-buffer
    max_footprint_px: int = 64
    """Longest edge of a surfel's square footprint, pixels."""
    footprint_spacings: float = 1.1
    """Edge of a footprint at the nearest surfel's depth, in surfel spacings."""
    hole_depth_m: float = 0.025
    """Fill a pixel that opposite ones, `HOLE_SPACINGS` away, overtop by this depth, metres."""
    near_plane_m: float = 0.1
    """Least depth of a surfel that is drawn, metres."""

    # Where a ray enters and leaves
    entry_margin_m: float = 0.004
    """Begin a segment this far in front of the surface along its normal, metres …"""
    max_entry_margin_m: float = 0.025
    """… and at most this far along the ray, metres."""
    max_entry_shift_m: float = 0.02
    """Longest distance along the ray from the surfel to the surface point it stands for, metres."""
    grazing_factor: float = 1.5
    """Relative lengthening of a segment at grazing incidence (× sin²)."""
    min_cosine: float = 0.1
    """Least cosine between ray and normal by which a segment is lengthened."""
    max_lengthening: float = 5.0
    """Longest segment in units of the surface's thickness there."""
    max_segment_m: float = 0.15
    """Longest segment, metres."""

    # Folded skin
    max_volume_ratio: float = 10.0
    """If the Jacobian's determinant is outside (1 / ratio, ratio), do not invert it: look along the
    surfel's normal, and leave the path uncorrected."""

    # Layers after the first
    layer_gap_m: float = 0.01
    """Least depth between surfels of consecutive layers, metres."""
    other_sheet_gap_m: float = 0.01
    """Least depth between surfels of different sheets, metres; negative allows overlap where limbs
    touch, and `layer_gap_m` or more disables the distinction."""
    same_sheet_m: float = 0.01
    """Surfels of two layers belong to one sheet where their canonical distance is below
    `same_sheet_ratio` × posed distance + `same_sheet_m` (metres): the second ray then begins where
    the first ends."""
    same_sheet_ratio: float = 1.25
    """Factor of the posed distance in that test."""
    min_facing_cosine: float = 0.2
    """Least cosine between view and normal for surfels of a further layer."""
    layer_min_transmittance: float = 0.02
    """Least transmittance for which a further layer is drawn."""


HQ_SETTINGS = RenderSettings(layers=3, other_sheet_gap_m=-0.015, max_compression=1.0)
"""Settings of the tier that every package has."""
QUALITY_TIERS = {
    "hq": HQ_SETTINGS,
    "lite": replace(
        HQ_SETTINGS,
        samples=5,
        block_samples=2,
        uniform_blocks=1,
        max_blocks=3,
        skinning_subdivision=1,
        entry_margin_m=0.002,
        min_transmittance=0.05,
        max_lengthening=4.0,
        layer_min_transmittance=0.11,
    ),
}
"""Settings by tier; "hq" comes first."""
THICK_FIELD_TIERS = {
    "hq": HQ_SETTINGS,
    "lite": replace(
        QUALITY_TIERS["lite"],
        block_samples=3,
        entry_margin_m=0.004,
        min_transmittance=0.02,
        layer_min_transmittance=0.08,
    ),
}
"""The same for fields that the usual settings cut short: haze in front of the surface, light that
passes through a limb."""


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
"""Multiple to which color codes are rounded when they are baked: invisible, and bytes halve."""
DENSITY_CODE_STEP = 16
"""Multiple to which density codes are rounded when they are baked: steps of 72 %, invisible, and
bytes halve."""
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

    @cached_property
    def positions(self) -> Float32[np.ndarray, "surfels 3"]:
        """Canonical positions, metres."""
        step = np.float32(self.extent_m / 65535.0)
        return self.low + self.position_codes.astype(np.float32) * step

    @cached_property
    def normals(self) -> Float32[np.ndarray, "surfels 3"]:
        """Outward canonical normals, of length 1 within 5 %."""
        return self.normal_codes.astype(np.float32) / np.float32(127.0)

    @cached_property
    def thickness(self) -> Float32[np.ndarray, "surfels"]:
        """Metres along the normal."""
        return self.thickness_codes.astype(np.float32) * np.float32(THICKNESS_STEP_M)


@dataclass(frozen=True, eq=False, kw_only=True)
class BrickTable:
    """Color and log-density on a voxel grid, stored only near the surface.

    Grid node (i, j, k) lies at `low + voxel_m · (i, j, k)`, canonical metres.

    Attributes:
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

    Node (i, j, k) lies at `low + step_m · (i, j, k)`, canonical metres; between nodes weights are
    trilinear.

    Attributes:
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
        pelvis: Rest pelvis in canonical space, metres: the middle of the z-buffer's depth range.
        reach_m: Largest distance of a surfel from the pelvis in any pose.
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
