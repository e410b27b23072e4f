"""How an avatar is drawn from its tables: the numbers that the graph and its twin share.

The qualities in which one set of tables is drawn.
"""

from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """The rules of one tier.

    Attributes:
        layers: Depth layers, at least 1.
        samples: Samples along `sample_span_m` of a ray, unless the player asks for another number.
        sample_span_m: Metres; samples lie `sample_span_m / samples` apart, and closer where a ray ends.
        block: Samples between two corrections of a ray's canonical path.
        steady: So many blocks have steps of that length; each further block has twice the steps
            of the one before it.
        skinning_subdivision: In how many parts, 1 or 2, a step of the skin is cut along each axis:
            posed positions are taken as linear between the nodes.
        blocks: At most so many; the last one takes what is left of a ray. Where the player asks for
            more samples, steady and other blocks are so many times more.
        further_layer_samples: Samples of a ray in each further layer, all at once.
        max_compression: Compression of canonical space along a ray (canonical metres a metre) up to
            which steps and `max_entry_margin_m` are as stated; beyond it both shrink in proportion, except
            in the last block, and a segment is not shortened any further.
        max_correction_m: No correction is longer than this.
        ended: A ray ends where less than this share of the light is left.
        max_footprint_px: Surfels cover at most so many pixels along x and y.
        footprint_spacings: A footprint's size in surfel spacings at the nearest surfel's depth.
        entry_margin_m, max_entry_margin_m: How far in front of the hull a ray's segment begins, along the
            normal, and at most along the ray.
        slack_m: How far the segment's begin may lie from the surfel, along the ray.
        grazing: How much longer a segment is where the ray grazes the hull (× sin²).
        steepest: Least cosine between ray and normal that lengthens a segment.
        lengthened: A segment is at most so many times as long as the hull is thick there.
        max_segment_m: Longest segment, metres.
        stretch: Where the derivative's determinant is outside of (1/stretch, stretch), the skin is
            folded: surfels are looked at along their normals, and paths not corrected.
        fold_volume_ratio: Ratio of posed to canonical volume about a surfel below which the surfel counts
            as folded; negative ratios are inside out.
        fold_depth_offset_m: Folded surfels are put this much deeper into the z-buffer, so that a
            neighbour, whose inverse is better conditioned, is drawn instead; 0 turns it off.
        hole_depth_m: A pixel that opposite ones, a footprint away, overtop by this much is a hole, and
            filled.
        layer_gap_m: Surfels of a further layer lie at least this far behind those of the one before it.
        other_sheet_gap_m: The same of surfels of another sheet; below 0 they may lie before. Where two
            limbs touch, each lies within the other's border. No less than `layer_gap_m` turns it off.
        same_sheet_m, same_sheet_ratio: Where two layers' surfels are no farther apart in canonical space
            than this, and so many times as far as in the camera's, they belong to one sheet: the
            second ray begins where the first one ends.
        facing: Least cosine with which a surfel of a further layer faces the camera.
        transmitted: Least light that is left, that a further layer is drawn for.
        nearest_m: Nearer surfels are not drawn.
    """

    layers: int = 2
    samples: int = 10
    sample_span_m: float = 0.05
    block_samples: int = 3
    uniform_blocks: int = 3
    skinning_subdivision: int = 2
    max_blocks: int = 6
    further_layer_samples: int = 6
    max_correction_m: float = 0.01
    min_transmittance: float = 0.01
    max_footprint_px: int = 64
    footprint_spacings: float = 1.1
    entry_margin_m: float = 0.004
    max_entry_margin_m: float = 0.025
    max_entry_shift_m: float = 0.02
    grazing_factor: float = 1.5
    min_cosine: float = 0.1
    max_lengthening: float = 5.0
    max_segment_m: float = 0.15
    max_volume_ratio: float = 10.0
    hole_depth_m: float = 0.025
    layer_gap_m: float = 0.01
    same_sheet_m: float = 0.01
    same_sheet_ratio: float = 1.25
    min_facing_cosine: float = 0.2
    layer_min_transmittance: float = 0.02
    near_plane_m: float = 0.1
    other_sheet_gap_m: float = 0.01
    max_compression: float = 1e9
    fold_volume_ratio: float = 0.3
    fold_depth_offset_m: float = 0.0


HQ_SETTINGS = RenderSettings(max_compression=1.0, fold_depth_offset_m=0.02)
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
"""How each is drawn; "hq" comes first."""
