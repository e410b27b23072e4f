"""Coverage: which skin the camera has seen, at what angle, and what to show it next."""

import base64
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, final

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from avatar.evaluation.image_metrics import MASK_THRESHOLD
from avatar.evaluation.skin_patches import PART_NAMES, SIDE_NAMES, SkinPatches, view_patches
from capture.camera import Camera
from capture.source import Frame
from preprocess.body.body_pose import BodyPose
from preprocess.body.parametric_body import ShapedBody
from preprocess.observation import Observation

EXPECTED_PX = 64
"""Longer side of the images in which the coverage of poses is found, pixels."""
MIN_SEEN_COSINE = 0.3
"""Cosine between normal and view direction below which a patch is not seen (72°)."""
MIN_WELL_SEEN_COSINE = 0.6
"""Cosine from which a patch is well seen (53°)."""


class VisibilityStage(IntEnum):
    """Closest that a patch has ever come to being seen."""

    FACING_AWAY = 0
    """It never faced the camera."""
    OUTSIDE_IMAGE = 1
    """It did, outside the image."""
    SELF_OCCLUDED = 2
    """It did, inside the image, behind another part of the body."""
    OUTSIDE_MASK = 3
    """No part of the body hid it, but it was outside the mask."""
    SEEN = 4
    """It was seen."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PartCoverage:
    """Seen share of a body part's surface, in total and by side.

    Attributes:
        seen_share: Seen share of the surface, in [0, 1].
        sides: Seen share of each side that the part has, in the order of `SIDE_NAMES`.
    """

    seen_share: float
    sides: dict[str, float]


@final
class Coverage:
    """Coverage of one person's skin; costs about a millisecond per frame.

    Frames may be added on one thread while others read: nothing that was seen is ever unseen.

    Attributes:
        patches: Patches of the person's skin.
        cosines: Largest cosine at which each patch was seen, in [0, 1]; 0 if it never was.
        stages: `VisibilityStage` of each patch.
    """

    cosines: Float32[np.ndarray, "patches"]
    stages: UInt8[np.ndarray, "patches"]

    def __init__(self, shaped: ShapedBody) -> None:
        """Starts with every patch unseen."""
        self._shaped = shaped
        self.patches = SkinPatches.from_shaped_body(shaped)
        self.cosines = np.zeros(len(self.patches.points), dtype=np.float32)
        self.stages = np.zeros(len(self.patches.points), dtype=np.uint8)

    def add(self, observation: Observation) -> None:
        """Takes in what one frame shows.

        A patch is seen if it faces the camera (cosine above 0.3), lands inside the picture, has
        no other patch before it, and the mask says that a person is there.
        """
        view = view_patches(self.patches, self._shaped, observation)
        if view is None:  # a person behind the camera is not in the image either
            return
        column, row = np.floor(view.pixels).astype(np.int64).T
        camera, cosines, free = observation.camera, view.cosines, view.unoccluded
        width, height = camera.size_px
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        alpha = observation.alpha[row.clip(0, height - 1), column.clip(0, width - 1)]
        passed = (cosines > MIN_SEEN_COSINE, inside, free, alpha > MASK_THRESHOLD)
        stages = np.cumprod(passed, axis=0, dtype=np.uint8).sum(axis=0, dtype=np.uint8)
        np.maximum(self.stages, stages, out=self.stages)
        shown = np.where(stages == VisibilityStage.SEEN, cosines, 0.0).astype(np.float32)
        np.maximum(self.cosines, shown, out=self.cosines)

    @property
    def seen_share(self) -> float:
        """Share of the whole surface, in [0, 1]."""
        return _area_share(self.patches.areas, self.cosines > 0.0)

    @property
    def well_seen_share(self) -> float:
        """The share that was seen within 53° of squarely."""
        return _area_share(self.patches.areas, self.cosines >= MIN_WELL_SEEN_COSINE)

    def by_part(self) -> dict[str, PartCoverage]:
        """How much of each part was seen, by its name."""
        patches, seen = self.patches, self.cosines > 0.0
        found: dict[str, PartCoverage] = {}
        for part, name in enumerate(PART_NAMES):
            here = patches.parts == part
            sides = {
                side: _area_share(patches.areas[among], seen[among])
                for k, side in enumerate(SIDE_NAMES)
                if (among := here & (patches.sides == k)).any()
            }
            found[name] = PartCoverage(
                seen_share=_area_share(patches.areas[here], seen[here]), sides=sides
            )
        return found

    def to_state(self) -> dict[str, Any]:
        """Encode cosines and stages as text, for a checkpoint."""
        steps = np.round(self.cosines * 255.0).astype(np.uint8)
        return {
            "cosines": base64.b64encode(steps.tobytes()).decode("ascii"),
            "stages": base64.b64encode(self.stages.tobytes()).decode("ascii"),
        }

    def merge_state(self, state: dict[str, Any]) -> None:
        """Adds what `to_state` of an earlier run has kept; notes of another body count nothing."""
        cosines, stages = (
            np.frombuffer(base64.b64decode(state[key]), dtype=np.uint8)
            for key in ("cosines", "stages")
        )
        if len(stages) == len(self.stages) == len(cosines):
            np.maximum(self.cosines, cosines.astype(np.float32) / 255.0, out=self.cosines)
            np.maximum(self.stages, stages, out=self.stages)


def expected_coverage(shaped: ShapedBody, views: Iterable[tuple[BodyPose, Camera]]) -> Coverage:
    """What frames in some poses will show of the person, before any frame is read."""
    coverage = Coverage(shaped)
    for pose, camera in views:
        small = camera.resize_longer_side(EXPECTED_PX)
        width, height = small.size_px
        blank = Frame(index=0, time_s=0.0, rgb=np.zeros((height, width, 3), dtype=np.uint8))
        alpha = np.ones((height, width), dtype=np.float32)
        coverage.add(Observation(frame=blank, alpha=alpha, pose=pose, camera=small))
    return coverage


def _area_share(areas: Float32[np.ndarray, "patches"], seen: Any) -> float:
    total = float(areas.sum())
    return float(areas[seen].sum()) / total if total else 0.0


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

ADVICE_BY_SIDE = {
    ("arm", "under"): "Raise your {limb}: the underside was never seen.",
    ("arm", "top"): "Lower your {limb}: the upper side was never seen.",
    ("hand", "under"): "Show the palm of your {limb}: it was never seen.",
    ("hand", "top"): "Show the back of your {limb}: it was never seen.",
    ("leg", "inner side"): "Stand with your legs apart: the inner side was never seen.",
    ("foot", "inner side"): "Put your feet apart: the inner side was never seen.",
    ("head", "top"): "Bow your head: its top was never seen.",
    ("head", "front"): "Look at the camera: your face was never seen.",
    ("torso", "all around"): "Turn round once, so that all of you is seen.",
    ("torso", "top"): "Bend forward: the top of your shoulders was never seen.",
    ("torso", "front"): "Face the camera: your front was never seen.",
    ("torso", "back"): "Turn until your back has been seen.",
    ("torso", "left"): "Turn until your left side has been seen.",
    ("torso", "right"): "Turn until your right side has been seen.",
}
"""What shows a piece of skin that faced away, by its limb and side; others have one sentence."""


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
    limb = PLURALS[gap.limb] if gap.laterality == "both" else f"{gap.laterality} {gap.limb}".strip()
    side = f"{gap.side} side" if gap.side in ("left", "right") else gap.side
    if gap.stage is VisibilityStage.OUTSIDE_IMAGE:
        return f"Step back: no picture shows your {limb.replace('torso', 'whole body')}."
    if gap.stage is VisibilityStage.OUTSIDE_MASK:
        return f"Look at the masks: none shows your {limb}, though nothing of you was before it."
    around = gap.limb == "torso" and gap.side in ("left", "right", "front", "back")
    if around and gap.stage is VisibilityStage.SELF_OCCLUDED:
        return f"Raise your arms: they hide your {side}."
    if (gap.limb, gap.side) in ADVICE_BY_SIDE:
        return ADVICE_BY_SIDE[gap.limb, gap.side].format(limb=limb)
    if gap.side == "all around":
        return f"Show your {limb} to the camera."
    return f"Turn until the {side} of your {limb} has been seen."
