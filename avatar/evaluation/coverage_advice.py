"""One sentence a person can act on: where the largest unseen piece of skin is, how to show it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from avatar.evaluation.coverage import Coverage, VisibilityStage
from avatar.evaluation.skin_patches import PART_NAMES, SkinPatches

MIN_REGION_SHARE = 0.02
"""Share of the skin below which an unseen piece is not mentioned: one hand is 2.3 %."""
HEAD_WEIGHT = 2.0
"""Weight of the head's skin relative to other skin, since viewers look at the face."""
NEARLY_COMPLETE = 0.95
"""Share of seen skin from which the capture counts as complete."""
NOT_SEEN_YET = "No person has been seen yet."
SEEN_COMPLETELY = "It was seen from all sides: no piece as large as a hand is missing."
SMALL_REGIONS_LEFT = "Nearly everything was seen; the {rest:.0%} that are missing are small pieces."

MIN_LIMB_SHARE = 0.7
"""Share of a piece that a limb must hold to give the piece its name."""
MIN_TOP_NORMAL_Y = 0.6
"""A piece whose mean normal points up this much is the top of its limb."""
MAX_SIDELESS_NORMAL = 0.12
"""A piece whose mean normal is shorter than this has no side."""
PARTS_OF_LIMB = {
    "hand": ("hand",),
    "foot": ("foot",),
    "arm": ("upper arm", "forearm", "hand"),
    "leg": ("thigh", "shin", "foot"),
}
PLURALS = {"hand": "hands", "foot": "feet", "arm": "arms", "leg": "legs"}

WHOLE_LIMB_ADVICE = "Show your {limb}: {they} {was} never seen."
TURN_ADVICE = "Turn until the {side}{s} of your {limb} {has} been seen."
ADVICE_BY_SIDE = {
    ("arm", "under"): "Raise your {limb}: {its} underside{s} {was} never seen.",
    ("arm", "top"): "Lower your {limb}: {its} upper side{s} {was} never seen.",
    ("hand", "under"): "Turn your palm{s} to the camera: the {limb} {was} never seen from below.",
    ("hand", "top"): "Turn the back{s} of your {limb} to the camera: {they} {was} never seen.",
    ("leg", "inner side"): "Stand with your legs apart: {its} inner side{s} {was} never seen.",
    ("foot", "inner side"): "Put your feet apart: {its} inner side{s} {was} never seen.",
    ("head", "top"): "Bow your head: its top was never seen.",
    ("head", "front"): "Look at the camera: your face was never seen.",
    ("torso", "all around"): "Turn round once, so that all of you is seen.",
    ("torso", "top"): "Bend forward: the top of your shoulders was never seen.",
    ("torso", "front"): "Face the camera: your front was never seen.",
    ("torso", "back"): "Turn until your back has been seen.",
    ("torso", "left"): "Turn until your left side has been seen.",
    ("torso", "right"): "Turn until your right side has been seen.",
}
OUTSIDE_IMAGE_ADVICE = "Step back: your {limb} {was} never in the picture."
OUTSIDE_MASK_ADVICE = (
    "Look at the masks: your {limb} {was} never in them, though nothing of you hid {it}."
)
SELF_OCCLUSION_ADVICE = {
    ("torso", "left"): "Raise your arms: they hide your left side.",
    ("torso", "right"): "Raise your arms: they hide your right side.",
    ("torso", "front"): "Move your arms aside: they hide your front.",
    ("torso", "back"): "Move your arms aside: they hide your back.",
}


@dataclass(frozen=True, kw_only=True)
class UnseenRegion:
    """A connected piece of skin that no frame shows.

    Attributes:
        share: Share of the whole skin, in [0, 1].
        limb: "arm", "hand", "leg", "foot", "head" or "torso"; the last also stands for pieces
            that reach over several limbs.
        laterality: "left", "right", "both", or "" for head and torso.
        side: Of the limb: "front", "back", "top", "left" or "right" of head and torso, "under" of
            arms, "inner side" or "outer side" of legs; "all around" if it has none.
        stage: Stage at which most of it stopped being seen.
    """

    share: float
    limb: str
    laterality: str
    side: str
    stage: VisibilityStage


def coverage_advice(coverage: Coverage) -> str:
    """What the person should do next, in one sentence.

    The sentence names the largest connected unseen piece of skin, and both pieces if its mirror
    image on the other arm or leg is unseen as well.
    """
    if not coverage.stages.any():
        return NOT_SEEN_YET
    found = unseen_regions(coverage)
    if found:
        return _advice_sentence(_merge_symmetric(found))
    return (
        SEEN_COMPLETELY
        if coverage.seen_share >= NEARLY_COMPLETE
        else SMALL_REGIONS_LEFT.format(rest=1.0 - coverage.seen_share)
    )


def unseen_regions(coverage: Coverage) -> list[UnseenRegion]:
    """The connected unseen pieces that are worth mentioning, the largest first."""
    patches = coverage.patches
    unseen = coverage.stages < VisibilityStage.SEEN
    links = patches.adjacent_pairs[unseen[patches.adjacent_pairs].all(axis=1)]
    count = len(unseen)
    graph = coo_array((np.ones(len(links), dtype=bool), tuple(links.T)), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    counts = np.where(patches.parts == PART_NAMES.index("head"), HEAD_WEIGHT, 1.0)
    weights = np.bincount(piece, weights=unseen * counts * patches.areas)
    least = MIN_REGION_SHARE * float(patches.areas.sum())
    large = [k for k in np.argsort(-weights) if weights[k] >= least]
    return [_describe_region(coverage, np.flatnonzero(piece == k)) for k in large]


def _describe_region(coverage: Coverage, piece: Int[np.ndarray, "piece"]) -> UnseenRegion:
    patches, areas = coverage.patches, coverage.patches.areas[piece].astype(np.float64)
    share = float(areas.sum() / patches.areas.sum())
    limb, whose = _limb(patches, piece)
    stage = VisibilityStage(int(np.bincount(coverage.stages[piece], weights=areas).argmax()))
    looks = np.average(patches.normals[piece], axis=0, weights=areas)
    return UnseenRegion(
        share=share, limb=limb, laterality=whose, side=_side(looks, limb, whose), stage=stage
    )


def _side(mean_normal: Float[np.ndarray, "3"], limb: str, whose: str) -> str:
    """The side of a limb that a mean normal looks to, in the T-pose."""
    if np.linalg.norm(mean_normal) < MAX_SIDELESS_NORMAL:
        return "all around"
    x, y, z = mean_normal
    if limb in ("arm", "hand"):
        return (
            ("front" if z > 0.0 else "back") if abs(z) > abs(y) else "top" if y > 0.0 else "under"
        )
    if y > MIN_TOP_NORMAL_Y:
        return "top"
    if abs(z) >= abs(x):
        return "front" if z > 0.0 else "back"
    side = "left" if x > 0.0 else "right"
    if limb in ("leg", "foot"):
        return "outer side" if side == whose else "inner side"
    return side


def _limb(patches: SkinPatches, piece: Int[np.ndarray, "piece"]) -> tuple[str, str]:
    """The smallest limb that holds most of a piece, and whose it is."""
    areas = np.bincount(patches.parts[piece], weights=patches.areas[piece], minlength=14)
    held: dict[str, float] = dict(zip(PART_NAMES, areas.tolist(), strict=True))
    enough = MIN_LIMB_SHARE * float(areas.sum())
    for limb, parts in PARTS_OF_LIMB.items():
        left, right = (sum(held[f"{whose} {p}"] for p in parts) for whose in ("left", "right"))
        for whose, area in (("left", left), ("right", right), ("both", left + right)):
            if area >= enough:
                return limb, whose
    return ("head", "") if held["head"] >= enough else ("torso", "")


def _merge_symmetric(found: list[UnseenRegion]) -> UnseenRegion:
    """The largest gap; of both limbs if the other one has a like gap half as large."""
    first = found[0]
    other = {"left": "right", "right": "left"}.get(first.laterality)
    for gap in found[1:]:
        alike = (gap.limb, gap.laterality, gap.side, gap.stage) == (
            first.limb, other, first.side, first.stage,
        )  # fmt: skip
        if alike and gap.share >= 0.5 * first.share:
            return replace(first, laterality="both", share=first.share + gap.share)
    return first


def _advice_sentence(gap: UnseenRegion) -> str:
    both = gap.laterality == "both"
    words = {
        "limb": PLURALS[gap.limb] if both else f"{gap.laterality} {gap.limb}".strip(),
        "side": f"{gap.side} side" if gap.side in ("left", "right") else gap.side,
        "s": "s" if both else "",
        "it": "them" if both else "it",
        "they": "they" if both else "it",
        "its": "their" if both else "its",
        "was": "were" if both else "was",
        "has": "have" if both else "has",
    }
    kind = (gap.limb, gap.side)
    if gap.stage is VisibilityStage.OUTSIDE_IMAGE:
        return OUTSIDE_IMAGE_ADVICE.format(
            **{**words, "limb": words["limb"].replace("torso", "whole body")}
        )
    if gap.stage is VisibilityStage.OUTSIDE_MASK:
        return OUTSIDE_MASK_ADVICE.format(**words)
    if gap.stage is VisibilityStage.SELF_OCCLUDED and kind in SELF_OCCLUSION_ADVICE:
        return SELF_OCCLUSION_ADVICE[kind]
    otherwise = WHOLE_LIMB_ADVICE if gap.side == "all around" else TURN_ADVICE
    return ADVICE_BY_SIDE.get(kind, otherwise).format(**words)
