"""Frames that the evaluation card shows: truth, rendering and error, cut to the person."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from apps.evaluation.frame_scoring import BACKGROUNDS, FrameScore, PremultipliedImage
from apps.report.html_page import to_uint8, webp_data_uri
from avatar.evaluation.image_metrics import composite_over, ground_truth_over, silhouette_of
from preprocess.observation import Observation

MARGIN = 0.08
"""Width of the rim around the person, as a fraction of the box."""
LARGEST_SHOWN_ERROR = 0.25
"""Error that is drawn in the brightest color, of 1."""
SHOWN_FRAMES = 6
"""Frames that a card shows of an avatar."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownFrame:
    """A frame with its rendering and the error between them.

    Attributes:
        score: Scores of the frame.
        width: Width of each image, pixels.
        truth, rendering, error: The images, as data URIs.
    """

    score: FrameScore
    width: int
    truth: str
    rendering: str
    error: str

    @classmethod
    def of(
        cls,
        observation: Observation,
        picture: PremultipliedImage,
        background: str,
        score: FrameScore,
    ) -> "ShownFrame":
        """Encode a frame and its rendering."""
        gray, cut = BACKGROUNDS[background], _box_with_margin(observation)
        truth = ground_truth_over(observation, gray)[cut]
        shown = np.clip(composite_over(picture, gray), 0.0, 1.0)[cut]
        error = np.abs(shown - truth).mean(axis=-1) / LARGEST_SHOWN_ERROR
        heat = cv2.applyColorMap(to_uint8(error[..., None])[..., 0], cv2.COLORMAP_INFERNO)
        return cls(
            score=score,
            width=truth.shape[1],
            truth=webp_data_uri(to_uint8(truth)),
            rendering=webp_data_uri(to_uint8(shown)),
            error=webp_data_uri(np.ascontiguousarray(heat[..., ::-1])),
        )


def choose_shown(frames: Sequence[ShownFrame]) -> list[ShownFrame]:
    """Choose `SHOWN_FRAMES` from the worst to the best in the mask, evenly by rank."""
    ranked = sorted(frames, key=lambda shown: shown.score.psnr_mask)
    places = np.linspace(0, len(ranked) - 1, min(SHOWN_FRAMES, len(ranked))).round().astype(int)
    return [ranked[place] for place in places]


def _box_with_margin(observation: Observation) -> tuple[slice, slice]:
    """Rows and columns around the person; the whole image without one."""
    silhouette, spans = silhouette_of(observation), []
    for axis in (1, 0):
        where = np.flatnonzero(silhouette.any(axis=axis))
        if not where.size:
            spans.append(slice(None))
            continue
        rim = 2 + int(MARGIN * (where[-1] - where[0]))
        spans.append(slice(max(0, int(where[0]) - rim), int(where[-1]) + 1 + rim))
    return spans[0], spans[1]
