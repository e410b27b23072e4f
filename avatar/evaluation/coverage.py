"""Coverage: which skin the camera has seen and at what angle, updated frame by frame."""

import base64
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, final

import numpy as np
from jaxtyping import Float32, UInt8

from avatar.evaluation.skin_patches import PART_NAMES, SIDE_NAMES, SkinPatches, view_patches
from preprocess.body.parametric_body import ShapedBody
from preprocess.observation import Observation

MIN_SEEN_COSINE = 0.3
"""Cosine between normal and view direction below which a patch is not seen (72°)."""
MIN_WELL_SEEN_COSINE = 0.6
"""Cosine from which a patch is well seen (53°)."""
MIN_PERSON_ALPHA = 0.5
"""Alpha above which a pixel shows the person."""


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
        passed = (cosines > MIN_SEEN_COSINE, inside, free, alpha > MIN_PERSON_ALPHA)
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


def _area_share(areas: Float32[np.ndarray, "patches"], seen: Any) -> float:
    total = float(areas.sum())
    return float(areas[seen].sum()) / total if total else 0.0
