"""Which part of the body each pixel of a frame shows, to score parts on their own."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from avatar.evaluation.coverage import view_patches
from avatar.evaluation.held_out import MASK_THRESHOLD
from avatar.evaluation.image_metrics import psnr_of_errors
from avatar.evaluation.skin_patches import PART_NAMES, SkinPatches
from preprocess.body.parametric_body import ShapedBody
from preprocess.observation import Observation

SCORED_PARTS = ("head", "hands", "arms", "trunk", "legs")
"""Parts that are scored on their own."""
PART_BY_WORD = {"torso": "trunk", "head": "head", "hand": "hands", "arm": "arms", "forearm": "arms"}
"""Scored part by the last word of a name of `PART_NAMES`; the others are legs."""
SCORED_PART_OF = np.array(
    [SCORED_PARTS.index(PART_BY_WORD.get(name.split()[-1], "legs")) for name in PART_NAMES]
)


def label_parts(
    patches: SkinPatches, shaped: ShapedBody, observation: Observation
) -> Int[np.ndarray, "pixels"] | None:
    """Index into `SCORED_PARTS` of each pixel of the mask, by the nearest patch in view.

    None if the body is behind the camera, or no patch is in view.
    """
    view = view_patches(patches, shaped, observation)
    if view is None or not view.unoccluded.any():
        return None
    rows, columns = np.nonzero(silhouette_of(observation))
    _, nearest = KDTree(view.pixels[view.unoccluded]).query(
        np.column_stack([columns, rows]) + 0.5, workers=1
    )
    return SCORED_PART_OF[patches.parts[view.unoccluded]][nearest]


def psnr_by_part(
    errors: Float[np.ndarray, "height width 3"],
    observation: Observation,
    labels: Int[np.ndarray, "pixels"] | None,
) -> dict[str, float]:
    """PSNR of each part that the frame shows, dB, from squared errors."""
    if labels is None:
        return {}
    of_person = errors[silhouette_of(observation)]
    return {
        f"psnr_{name}": psnr_of_errors(of_person[labels == part])
        for part, name in enumerate(SCORED_PARTS)
        if (labels == part).any()
    }


def silhouette_of(observation: Observation) -> Bool[np.ndarray, "height width"]:
    """Pixels that show the person."""
    return observation.alpha > MASK_THRESHOLD
