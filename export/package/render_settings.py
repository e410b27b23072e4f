"""Numbers that the player's graph and its reference share, and the quality tiers made of them."""

from dataclasses import dataclass, replace

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


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """How one tier draws the tables. The names are keys of manifest.json."""

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
    (`MIN_FOOTPRINT_PX`), and grow with the number of samples."""
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
    """Fill a pixel that opposite ones, a footprint away, overtop by this depth, metres."""
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
    """Where the Jacobian's determinant is outside (1 / ratio, ratio), do not invert it: look along
    the surfel's normal, and leave the path uncorrected."""

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
        entry_margin_m=0.001,
        min_transmittance=0.05,
        max_lengthening=4.0,
        layer_min_transmittance=0.15,
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
        layer_min_transmittance=0.05,
    ),
}
"""The same for fields that the usual settings cut short: haze in front of the surface, light that
passes through a limb."""
