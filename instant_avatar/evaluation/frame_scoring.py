"""Scores of one rendering against its frame, and both as the evaluation's page shows them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float32

from avatar.evaluation.held_out import HeldOutFrame, score_rendering
from avatar.evaluation.image_metrics import (
    MASK_THRESHOLD,
    SharpnessVerdict,
    composite_over,
    ground_truth_over,
    overall_verdict,
    psnr_of_errors,
)
from avatar.evaluation.perceptual import LPIPS_CONVENTIONS, Lpips
from avatar.events import HeldOutScore
from instant_avatar.report.page_rendering import to_uint8, webp_data_uri
from preprocess.observation import Observation

PremultipliedImage = Float32[np.ndarray, "height width 4"]
"""RGBA with premultiplied alpha."""
FrameRenderer = Callable[[Observation], PremultipliedImage]
"""Renders the pose of a frame with its camera."""
BACKGROUNDS = {"white": 1.0, "black": 0.0}
"""Gray behind the person, by name."""
METRICS = (
    "psnr",
    "psnr_box",
    "psnr_mask",
    "ssim",
    *(f"lpips_{name}" for name in LPIPS_CONVENTIONS),
    "cpu_ms",
)
"""All values of a frame that are averaged."""
MARGIN = 0.08
"""Width of the rim around the person on the page, as a fraction of the box."""
LARGEST_SHOWN_ERROR = 0.25
"""Error that is drawn in the brightest color, of 1."""
SHOWN_FRAMES = 6
"""Frames that the page shows of an avatar."""


@dataclass(frozen=True, kw_only=True)
class FrameScore(HeldOutScore):
    """Scores of one rendering against its frame, both on the same background.

    Attributes:
        psnr_box: PSNR in the bounding box of the mask, dB.
        cpu_ms: CPU time of rendering, over all threads.
        lpips: LPIPS of the whole image by convention, as far as it was measured.
    """

    psnr_box: float
    cpu_ms: float
    lpips: Mapping[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, float | int]:
        """Return all values by name."""
        values = {key: value for key, value in vars(self).items() if key != "lpips"}
        return values | {f"lpips_{name}": value for name, value in self.lpips.items()}


def score_picture(
    observation: Observation,
    picture: PremultipliedImage,
    background: str,
    lpips: Lpips | None = None,
    *,
    cpu_ms: float = float("nan"),
) -> FrameScore:
    """Compare a rendering with its frame, both on a background of `BACKGROUNDS`."""
    gray, box = BACKGROUNDS[background], _bounding_box(observation)
    truth = ground_truth_over(observation, gray)
    shown = np.clip(composite_over(picture, gray), 0.0, 1.0)
    errors = (shown.astype(np.float64) - truth) ** 2
    conventions = () if lpips is None else lpips.conventions
    return FrameScore(
        **vars(score_rendering(picture, HeldOutFrame(observation=observation), gray)),
        psnr_box=psnr_of_errors(errors[box]),
        cpu_ms=cpu_ms,
        lpips={name: lpips.compare(shown, truth, name) for name in conventions if lpips},
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class ShownFrame:
    """A frame with its rendering and the error between them.

    Attributes:
        width: Width of each image, pixels.
        truth, rendering, error: The images, as data URIs.
    """

    score: FrameScore
    width: int
    truth: str
    rendering: str
    error: str

    @property
    def verdict(self) -> SharpnessVerdict | None:
        """Verdict on this frame; None without a silhouette."""
        return overall_verdict([self.score])

    @classmethod
    def of(
        cls,
        observation: Observation,
        picture: PremultipliedImage,
        background: str,
        score: FrameScore,
    ) -> "ShownFrame":
        """Encode a frame and its rendering, cut to the person."""
        gray, cut = BACKGROUNDS[background], _bounding_box(observation, margin=MARGIN)
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


def _bounding_box(observation: Observation, *, margin: float = 0.0) -> tuple[slice, slice]:
    """Return rows and columns of the person; of the whole image without one.

    `margin` is the width of the rim around the person, as a fraction of the box.
    """
    silhouette, spans = observation.alpha > MASK_THRESHOLD, []
    for axis in (1, 0):
        where = np.flatnonzero(silhouette.any(axis=axis))
        if not where.size:
            return slice(None), slice(None)
        rim = int(np.ceil(margin * (where[-1] - where[0])))
        spans.append(slice(max(0, int(where[0]) - rim), int(where[-1]) + 1 + rim))
    return spans[0], spans[1]
