"""Coverage: which skin the camera has seen, at what angle, and what to show it next."""

import base64
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple, final

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from avatar.evaluation.image_metrics import MASK_THRESHOLD
from avatar.rig import PART_OF_JOINT
from capture.camera import Camera
from capture.source import Frame
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import (
    vertex_areas,
    vertex_normals,
    visible_from_anywhere,
    visible_points,
)
from preprocess.body.parametric_body import ShapedBody
from preprocess.observation import Observation

MIN_WELL_SEEN_COSINE = 0.6
"""Cosine from which a patch is well seen (53°)."""
PART_NAMES = (
    "torso", "left thigh", "right thigh", "left shin", "right shin", "left foot", "right foot",
    "head", "left upper arm", "right upper arm", "left forearm", "right forearm", "left hand",
    "right hand",
)  # fmt: skip
"""The 14 body parts of `avatar.rig.PART_OF_JOINT`; left is the person's left."""
SIDE_NAMES = ("front", "back", "left", "right", "top", "under")
"""Directions of the patches in the T-pose; `under` is the underside."""
ARM_PARTS, FOOT_PARTS = slice(8, 14), (5, 6)
PATCH_M = 0.022


@dataclass(frozen=True, eq=False, kw_only=True)
class SkinPatches:
    """Pieces of skin of about 2 cm that are visible from around the person.

    Attributes:
        points: Centres in the rest pose (SMPL's T-pose), metres; `normals` point outward.
        areas: In square metres.
        parts, sides: Indices into `PART_NAMES` and `SIDE_NAMES`. Arms and hands have front, back,
            top and under; the others front, back, left and right.
    """

    points: Float32[np.ndarray, "patches 3"]
    normals: Float32[np.ndarray, "patches 3"]
    areas: Float32[np.ndarray, "patches"]
    weights: Float32[np.ndarray, "patches 24"]
    parts: Int[np.ndarray, "patches"]
    sides: Int[np.ndarray, "patches"]

    @classmethod
    def from_shaped_body(cls, shaped: ShapedBody) -> "SkinPatches":
        """The patches of one person: vertices of the same 2-cm voxel, part and side, together.

        The inside of the mouth and the soles, which are never visible, are left out.
        """
        weights = shaped.body.weights
        surface = shaped.vertices, shaped.body.faces
        normals, areas = vertex_normals(*surface), vertex_areas(*surface)
        parts = PART_OF_JOINT[weights.argmax(axis=1)]
        sides = _side_of_vertex(normals, parts)
        voxels = np.floor(shaped.vertices / PATCH_M).astype(np.int64)
        keys = np.column_stack([voxels, parts, sides])
        _, first, patch = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        patch = patch.reshape(-1)

        def mean(values: Float[np.ndarray, "vertices n"]) -> Float32[np.ndarray, "patches n"]:
            total = np.zeros((len(first), values.shape[1]))
            np.add.at(total, patch, values * areas[:, None])
            return (total / size[:, None]).astype(np.float32)

        size = np.bincount(patch, weights=areas)
        normals = mean(normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        points, parts, sides = mean(shaped.vertices), parts[first], sides[first]
        shown = visible_from_anywhere(
            points, normals, cell_m=PATCH_M, tolerance_m=0.01, min_cosine=0.3
        ) & ~(np.isin(parts, FOOT_PARTS) & (normals[:, 1] < -0.5))
        return cls(
            points=points[shown],
            normals=normals[shown],
            areas=size[shown].astype(np.float32),
            weights=mean(weights)[shown],
            parts=parts[shown],
            sides=sides[shown],
        )


def _side_of_vertex(
    normals: Float[np.ndarray, "vertices 3"], parts: Int[np.ndarray, "vertices"]
) -> Int[np.ndarray, "vertices"]:
    """The side of its part that each vertex is on: four around an arm, four around the rest."""
    x, y, z = normals.T
    is_arm = (parts >= ARM_PARTS.start) & (parts < ARM_PARTS.stop)
    across = np.where(is_arm, y, x)
    sideways = np.where(is_arm, np.where(y > 0.0, 4, 5), np.where(x > 0.0, 2, 3))
    return np.where(np.abs(z) >= np.abs(across), np.where(z > 0.0, 0, 1), sideways)


def pose_patches(
    patches: SkinPatches, world_from_rest: Float[np.ndarray, "24 4 4"]
) -> tuple[Float32[np.ndarray, "patches 3"], Float32[np.ndarray, "patches 3"]]:
    """Centres and unit normals of the patches in the world, by linear blend skinning."""
    joints = world_from_rest[:, :3].reshape(24, 12).astype(np.float32)
    blended = (patches.weights @ joints).reshape(-1, 3, 4)
    points = np.einsum("pab,pb->pa", blended[:, :, :3], patches.points) + blended[:, :, 3]
    normals = np.einsum("pab,pb->pa", blended[:, :, :3], patches.normals)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


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


@final
class Coverage:
    """Coverage of one person's skin; costs about a millisecond per frame.

    Frames may be added on one thread while others read: nothing that was seen is ever unseen.

    Attributes:
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

        A patch is seen if it faces the camera (cosine above 0.3), lies inside the image, has
        no other patch before it, and the mask says that a person is there.
        """
        camera, body = observation.camera, self._shaped.with_pose(observation.pose)
        points, normals = pose_patches(self.patches, body.world_from_rest())
        to_camera = camera.center_world - points
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        cosines = np.einsum("pa,pa->p", to_camera, normals)
        in_camera = points @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
        depths = in_camera[:, 2]
        if depths.min() <= 0.0:  # a person behind the camera is not in the image either
            return
        plane = in_camera[:, :2] / depths[:, None] * depths.mean()
        free = visible_points(plane, depths, cosines)
        column, row = np.floor(camera.project(points)).astype(np.int64).T
        width, height = camera.size_px
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        alpha = observation.alpha[row.clip(0, height - 1), column.clip(0, width - 1)]
        passed = (cosines > 0.3, inside, free, alpha > MASK_THRESHOLD)  # 72°
        stages = np.cumprod(passed, axis=0, dtype=np.uint8).sum(axis=0, dtype=np.uint8)
        np.maximum(self.stages, stages, out=self.stages)
        shown = np.where(stages == VisibilityStage.SEEN, cosines, 0.0).astype(np.float32)
        np.maximum(self.cosines, shown, out=self.cosines)

    @property
    def seen_share(self) -> float:
        """Share of the whole surface, in [0, 1]."""
        return _area_share(self.patches.areas, self.cosines > 0.0)

    @property
    def mean_cosine(self) -> float:
        """Mean of `cosines` over the whole surface, in [0, 1]: how squarely the skin was seen."""
        areas = self.patches.areas
        return float((areas * self.cosines).sum() / max(float(areas.sum()), 1e-12))

    @property
    def well_seen_share(self) -> float:
        """The share that was seen within 53° of squarely."""
        return _area_share(self.patches.areas, self.cosines >= MIN_WELL_SEEN_COSINE)

    def by_part(self) -> dict[str, dict[str, float]]:
        """Share of each part that was seen, under "seen", then of each of its sides."""
        patches, seen = self.patches, self.cosines > 0.0
        shares: dict[str, dict[str, float]] = {}
        for part, name in enumerate(PART_NAMES):
            here = patches.parts == part
            shares[name] = {"seen": _area_share(patches.areas[here], seen[here])}
            for k, side in enumerate(SIDE_NAMES):
                among = here & (patches.sides == k)
                if among.any():
                    shares[name][side] = _area_share(patches.areas[among], seen[among])
        return shares

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
    """Coverage that frames in these poses will reach, before any frame is read."""
    coverage = Coverage(shaped)
    for pose, camera in views:
        small = camera.resize_longer_side(64)
        width, height = small.size_px
        blank = Frame(index=0, time_s=0.0, rgb=np.zeros((height, width, 3), dtype=np.uint8))
        alpha = np.ones((height, width), dtype=np.float32)
        coverage.add(Observation(frame=blank, alpha=alpha, pose=pose, camera=small))
    return coverage


def _area_share(areas: Float32[np.ndarray, "patches"], seen: Any) -> float:
    total = float(areas.sum())
    return float(areas[seen].sum()) / total if total else 0.0


MIN_UNSEEN_OF_SIDE, MIN_UNSEEN_OF_LIMB = 0.5, 0.75
"""Unseen share from which a limb's side, and a whole limb, are called unseen."""
SEEN_COMPLETELY = "It was seen from all sides."
PARTS_OF_LIMB = {
    "hand": ("hand",),
    "foot": ("foot",),
    "arm": ("upper arm", "forearm", "hand"),
    "leg": ("thigh", "shin", "foot"),
}
ALL_AROUND = "all around"
"""Side of a limb that was not seen at all."""

ADVICE_BY_SIDE = {
    ("arm", "under"): "Raise your {limb}: the underside was never seen.",
    ("arm", "top"): "Lower your {limb}: the upper side was never seen.",
    ("hand", "under"): "Show the palm of your {limb}: it was never seen.",
    ("hand", "top"): "Show the back of your {limb}: it was never seen.",
    ("leg", "inner side"): "Stand with your legs apart: the inner side was never seen.",
    ("foot", "inner side"): "Put your feet apart: the inner side was never seen.",
    ("head", "top"): "Bow your head: its top was never seen.",
    ("head", "front"): "Look at the camera: your face was never seen.",
    ("torso", ALL_AROUND): "Turn round once, so that all of you is seen.",
    ("torso", "top"): "Bend forward: the top of your shoulders was never seen.",
    ("torso", "front"): "Face the camera: your front was never seen.",
    ("torso", "back"): "Turn until your back has been seen.",
    ("torso", "left"): "Turn until your left side has been seen.",
    ("torso", "right"): "Turn until your right side has been seen.",
}
"""Advice about skin that faced away, by its limb and side; others have one sentence."""


class UnseenRegion(NamedTuple):
    """A side of a limb, or all of it, that no frame shows.

    Attributes:
        limb: "arm", "hand", "leg", "foot", "head" or "torso"; the last also stands for the body.
        laterality: "left", "right", "both", or "" for head and torso.
        side: Of the limb: "front", "back", "top", "left" or "right" of head and torso, "under" of
            arms, "inner side" or "outer side" of legs; "all around" for all of it.
        stage: Stage at which most of it stopped being seen.
    """

    limb: str
    laterality: str
    side: str
    stage: VisibilityStage


def coverage_advice(coverage: Coverage) -> str:
    """Tell the person in one sentence what to do next: about the largest unseen region."""
    if not coverage.stages.any():
        return "No person has been seen yet."
    region = largest_unseen_region(coverage)
    if region is not None:
        return _advice_sentence(region)
    if coverage.seen_share >= 0.95:
        return SEEN_COMPLETELY
    # no share, which changes with each frame: a page that speaks would begin again
    return "Nearly everything was seen; only small pieces are missing."


def largest_unseen_region(coverage: Coverage) -> UnseenRegion | None:
    """Return the unseen region with the most skin; None if none is worth mentioning.

    A side of the whole body comes first, as turning shows much more than that side. A region of one
    limb grows by the same region of the other one if that is unseen as well.
    """
    patches, unseen = coverage.patches, coverage.stages < VisibilityStage.SEEN
    turns = SIDE_NAMES[:4]  # which turning shows
    sides = {side: patches.sides == SIDE_NAMES.index(side) for side in turns}
    shares = {side: _area_share(patches.areas[at], unseen[at]) for side, at in sides.items()}
    worst = max(turns, key=shares.__getitem__)
    everything = min(shares.values()) >= MIN_UNSEEN_OF_LIMB
    where = unseen if everything else unseen & sides[worst]
    if shares[worst] >= MIN_UNSEEN_OF_SIDE:
        stage, side = _main_stage(coverage, where), ALL_AROUND if everything else worst
        if stage in (VisibilityStage.FACING_AWAY, VisibilityStage.SELF_OCCLUDED):
            return UnseenRegion(limb="torso", laterality="", side=side, stage=stage)
    # viewers look at the face
    weights = patches.areas * np.where(patches.parts == PART_NAMES.index("head"), 2.0, 1.0)
    regions: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    for limb, whose, side, where in _limb_sides(patches):
        least = MIN_UNSEEN_OF_LIMB if side == ALL_AROUND else MIN_UNSEEN_OF_SIDE
        if _area_share(patches.areas[where], unseen[where]) >= least:
            regions.setdefault((limb, side), {})[whose] = where & unseen
    sizes = {
        key: sum(float(weights[where].sum()) for where in halves.values())
        for key, halves in regions.items()
    }
    largest = max(sizes, key=sizes.__getitem__, default=None)
    if largest is None or sizes[largest] < 0.02 * float(patches.areas.sum()):  # a hand: 2.3 %
        return None
    halves = regions[largest]
    return UnseenRegion(
        limb=largest[0],
        laterality="both" if len(halves) == 2 else next(iter(halves)),
        side=largest[1],
        stage=_main_stage(coverage, np.logical_or.reduce(list(halves.values()))),
    )


def _main_stage(coverage: Coverage, where: Bool[np.ndarray, "patches"]) -> VisibilityStage:
    """Return the stage at which most of the skin of some patches stopped being seen."""
    stages = np.bincount(coverage.stages[where], weights=coverage.patches.areas[where])
    return VisibilityStage(int(stages.argmax()))


def _limb_sides(
    patches: SkinPatches,
) -> Iterator[tuple[str, str, str, Bool[np.ndarray, "patches"]]]:
    """Yield limb, whose it is, side, and patches of all regions of limbs, torso and head."""
    limbs = {(limb, ""): patches.parts == PART_NAMES.index(limb) for limb in ("torso", "head")}
    for limb, parts in PARTS_OF_LIMB.items():
        for whose in ("left", "right"):
            rows = [PART_NAMES.index(f"{whose} {part}") for part in parts]
            limbs[limb, whose] = np.isin(patches.parts, rows)
    for (limb, whose), where in limbs.items():
        yield limb, whose, ALL_AROUND, where
        if not whose:
            yield limb, whose, "top", where & (patches.normals[:, 1] > 0.6)
        for k, side in enumerate(SIDE_NAMES):
            if limb in ("leg", "foot") and side in ("left", "right"):
                side = "outer side" if side == whose else "inner side"
            yield limb, whose, side, where & (patches.sides == k)


def _advice_sentence(region: UnseenRegion) -> str:
    limb = (
        {"hand": "hands", "foot": "feet", "arm": "arms", "leg": "legs"}[region.limb]
        if region.laterality == "both"
        else f"{region.laterality} {region.limb}".strip()
    )
    side = f"{region.side} side" if region.side in ("left", "right") else region.side
    if region.stage is VisibilityStage.OUTSIDE_IMAGE:
        return f"Step back: no picture shows your {limb.replace('torso', 'whole body')}."
    if region.stage is VisibilityStage.OUTSIDE_MASK:
        return f"Look at the masks: none shows your {limb}, though nothing of you was before it."
    around = region.limb == "torso" and region.side in ("left", "right", "front", "back")
    if around and region.stage is VisibilityStage.SELF_OCCLUDED:
        return f"Raise your arms: they hide your {side}."
    if (region.limb, region.side) in ADVICE_BY_SIDE:
        return ADVICE_BY_SIDE[region.limb, region.side].format(limb=limb)
    if region.side == ALL_AROUND:
        return f"Show your {limb} to the camera."
    return f"Turn until the {side} of your {limb} has been seen."
