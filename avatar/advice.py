"""One sentence a person can act on: where the largest unseen piece of skin is, how to show it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from avatar.coverage import Coverage, Stage
from avatar.patches import PART_NAMES, SkinPatches

WORTH_A_WORD = 0.02
"""Share of the skin below which an unseen piece is not mentioned: one hand is 2.3 %."""
HEAD_COUNTS = 2.0
"""A face is what people look at: the head's skin counts as so much more."""
NEARLY_ALL = 0.95
NOBODY = "Nobody has been seen yet."
EVERYTHING = "It was seen from all sides: no piece as large as a hand is missing."
SCATTERED = "Nearly everything was seen; the {rest:.0%} that are missing are small pieces."

MOST = 0.7
"""Share of a piece that a limb must hold to give the piece its name."""
UPWARD = 0.6
"""A piece whose mean normal points up this much is the top of its limb."""
ALL_AROUND = 0.12
"""A piece whose mean normal is shorter than this has no side."""
LEFT_AND_RIGHT = {
    "hand": ("hand",),
    "foot": ("foot",),
    "arm": ("upper arm", "forearm", "hand"),
    "leg": ("thigh", "shin", "foot"),
}
PLURALS = {"hand": "hands", "foot": "feet", "arm": "arms", "leg": "legs"}

ALL_OF_IT = "Show your {limb}: {they} {was} never seen."
ELSEWHERE = "Turn until the {side}{s} of your {limb} {has} been seen."
WORDS = {
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
OUTSIDE = "Step back: your {limb} {was} never in the picture."
MASKED = "Look at the masks: your {limb} {was} never in them, though nothing of you hid {it}."
HIDDEN = {
    ("torso", "left"): "Raise your arms: they hide your left side.",
    ("torso", "right"): "Raise your arms: they hide your right side.",
    ("torso", "front"): "Move your arms aside: they hide your front.",
    ("torso", "back"): "Move your arms aside: they hide your back.",
}


@dataclass(frozen=True, kw_only=True)
class Gap:
    """A connected piece of skin that no frame shows.

    Attributes:
        share: Of the whole skin, in [0, 1].
        limb: "arm", "hand", "leg", "foot", "head" or "torso"; the last also stands for pieces
            that reach over several limbs.
        whose: "left", "right", "both", or "" for head and torso.
        side: Of the limb: "front", "back", "top", "left" or "right" of head and torso, "under" of
            arms, "inner side" or "outer side" of legs; "all around" if it has none.
        stage: Why most of it was not seen.
    """

    share: float
    limb: str
    whose: str
    side: str
    stage: Stage


def advice(coverage: Coverage) -> str:
    """What the person should do next, in one sentence.

    It is about the largest connected piece that nobody has seen; if the same piece of the other
    arm or leg is missing, too, about both.
    """
    if not coverage.stages.any():
        return NOBODY
    found = gaps(coverage)
    if found:
        return _sentence(_of_both(found))
    return EVERYTHING if coverage.seen >= NEARLY_ALL else SCATTERED.format(rest=1.0 - coverage.seen)


def gaps(coverage: Coverage) -> list[Gap]:
    """The connected unseen pieces worth a word, the largest first."""
    patches = coverage.patches
    unseen = coverage.stages < Stage.SEEN
    links = patches.links[unseen[patches.links].all(axis=1)]
    count = len(unseen)
    graph = coo_array((np.ones(len(links), dtype=bool), tuple(links.T)), shape=(count, count))
    _, piece = connected_components(graph, directed=False)
    counts = np.where(patches.parts == PART_NAMES.index("head"), HEAD_COUNTS, 1.0)
    weights = np.bincount(piece, weights=unseen * counts * patches.areas)
    least = WORTH_A_WORD * float(patches.areas.sum())
    large = [k for k in np.argsort(-weights) if weights[k] >= least]
    return [_gap(coverage, np.flatnonzero(piece == k)) for k in large]


def _gap(coverage: Coverage, piece: Int[np.ndarray, "piece"]) -> Gap:
    patches, areas = coverage.patches, coverage.patches.areas[piece].astype(np.float64)
    share = float(areas.sum() / patches.areas.sum())
    limb, whose = _limb(patches, piece)
    stage = Stage(int(np.bincount(coverage.stages[piece], weights=areas).argmax()))
    looks = np.average(patches.normals[piece], axis=0, weights=areas)
    return Gap(share=share, limb=limb, whose=whose, side=_side(looks, limb, whose), stage=stage)


def _side(looks: Float[np.ndarray, "3"], limb: str, whose: str) -> str:
    """The side of a limb that a mean normal looks to, in the T-pose."""
    if np.linalg.norm(looks) < ALL_AROUND:
        return "all around"
    x, y, z = looks
    if limb in ("arm", "hand"):
        return (
            ("front" if z > 0.0 else "back") if abs(z) > abs(y) else "top" if y > 0.0 else "under"
        )
    if y > UPWARD:
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
    enough = MOST * float(areas.sum())
    for limb, parts in LEFT_AND_RIGHT.items():
        left, right = (sum(held[f"{whose} {p}"] for p in parts) for whose in ("left", "right"))
        for whose, area in (("left", left), ("right", right), ("both", left + right)):
            if area >= enough:
                return limb, whose
    return ("head", "") if held["head"] >= enough else ("torso", "")


def _of_both(found: list[Gap]) -> Gap:
    """The largest gap; of both limbs if the other one has a like gap half as large."""
    first = found[0]
    other = {"left": "right", "right": "left"}.get(first.whose)
    for gap in found[1:]:
        alike = (gap.limb, gap.whose, gap.side, gap.stage) == (
            first.limb, other, first.side, first.stage,
        )  # fmt: skip
        if alike and gap.share >= 0.5 * first.share:
            return replace(first, whose="both", share=first.share + gap.share)
    return first


def _sentence(gap: Gap) -> str:
    both = gap.whose == "both"
    words = {
        "limb": PLURALS[gap.limb] if both else f"{gap.whose} {gap.limb}".strip(),
        "side": f"{gap.side} side" if gap.side in ("left", "right") else gap.side,
        "s": "s" if both else "",
        "it": "them" if both else "it",
        "they": "they" if both else "it",
        "its": "their" if both else "its",
        "was": "were" if both else "was",
        "has": "have" if both else "has",
    }
    kind = (gap.limb, gap.side)
    if gap.stage is Stage.OUTSIDE:
        return OUTSIDE.format(**{**words, "limb": words["limb"].replace("torso", "whole body")})
    if gap.stage is Stage.MASKED:
        return MASKED.format(**words)
    if gap.stage is Stage.HIDDEN and kind in HIDDEN:
        return HIDDEN[kind]
    otherwise = ALL_OF_IT if gap.side == "all around" else ELSEWHERE
    return WORDS.get(kind, otherwise).format(**words)
