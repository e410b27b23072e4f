"""How an avatar is drawn from its tables: the numbers that the graph and its twin share."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class DrawingRules:
    """The rules of one tier.

    Attributes:
        layers: Depth layers, at least 1.
        samples: Samples along `span_m` of a ray, unless the player asks for another number.
        span_m: Metres; samples lie `span_m / samples` apart, and closer where a ray ends.
        block: Samples between two corrections of a ray's canonical path.
        steady: So many blocks have steps of that length; each further block has twice the steps
            of the one before it.
        nodes_per_step: In how many parts, 1 or 2, a step of the skin is cut along each axis:
            posed positions are taken as linear between the nodes.
        blocks: At most so many; the last one takes what is left of a ray. Where the player asks for
            more samples, steady and other blocks are so many times more.
        second_block: Samples of a ray in each further layer, all at once.
        squash_limit: Compression of canonical space along a ray (canonical metres a metre) up to
            which steps and `most_lead_m` are as stated; beyond it both shrink in proportion, except
            in the last block, and a segment is not shortened any further.
        longest_correction_m: No correction is longer than this.
        ended: A ray ends where less than this share of the light is left.
        largest_footprint_px: Surfels cover at most so many pixels along x and y.
        footprint_spacings: A footprint's size in surfel spacings at the nearest surfel's depth.
        lead_m, most_lead_m: How far in front of the hull a ray's segment begins, along the
            normal, and at most along the ray.
        slack_m: How far the segment's begin may lie from the surfel, along the ray.
        grazing: How much longer a segment is where the ray grazes the hull (× sin²).
        steepest: Least cosine between ray and normal that lengthens a segment.
        lengthened: A segment is at most so many times as long as the hull is thick there.
        longest_m: Longest segment, metres.
        stretch: Where the derivative's determinant is outside of (1/stretch, stretch), the skin is
            folded: surfels are looked at along their normals, and paths not corrected.
        fold_volume: Ratio of posed to canonical volume about a surfel below which the surfel counts
            as folded; negative ratios are inside out.
        fold_setback_m: Folded surfels are put this much deeper into the z-buffer, so that a
            neighbour, whose inverse is better conditioned, is drawn instead; 0 turns it off.
        hole_m: A pixel that opposite ones, a footprint away, overtop by this much is a hole, and
            filled.
        gap_m: Surfels of a further layer lie at least this far behind those of the one before it.
        sheet_gap_m: The same of surfels of another sheet; below 0 they may lie before. Where two
            limbs touch, each lies within the other's border. No less than `gap_m` turns it off.
        same_m, same_share: Where two layers' surfels are no farther apart in canonical space
            than this, and so many times as far as in the camera's, they belong to one sheet: the
            second ray begins where the first one ends.
        facing: Least cosine with which a surfel of a further layer faces the camera.
        transmitted: Least light that is left, that a further layer is drawn for.
        nearest_m: Nearer surfels are not drawn.
    """

    layers: int = 2
    samples: int = 10
    span_m: float = 0.05
    block: int = 3
    steady: int = 3
    nodes_per_step: int = 2
    blocks: int = 6
    second_block: int = 6
    longest_correction_m: float = 0.01
    ended: float = 0.01
    largest_footprint_px: int = 64
    footprint_spacings: float = 1.1
    lead_m: float = 0.004
    most_lead_m: float = 0.025
    slack_m: float = 0.02
    grazing: float = 1.5
    steepest: float = 0.1
    lengthened: float = 5.0
    longest_m: float = 0.15
    stretch: float = 10.0
    hole_m: float = 0.025
    gap_m: float = 0.01
    same_m: float = 0.01
    same_share: float = 1.25
    facing: float = 0.2
    transmitted: float = 0.02
    nearest_m: float = 0.1
    sheet_gap_m: float = 0.01
    squash_limit: float = 1e9
    fold_volume: float = 0.3
    fold_setback_m: float = 0.0
