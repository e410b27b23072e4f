"""Scores of one rendering against its frame, and both as the evaluation card shows them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from apps.report.report_page import to_uint8, webp_data_uri
from avatar.evaluation.held_out import HeldOutFrame, score_rendering
from avatar.evaluation.image_metrics import (
    SSIM_BORDER_PX,
    composite_over,
    ground_truth_over,
    psnr_of_errors,
    silhouette_of,
    ssim,
    ssim_map,
)
from avatar.evaluation.perceptual import LPIPS_CONVENTIONS, Lpips
from avatar.evaluation.skin_patches import SCORED_PARTS, SkinPatches, label_parts, psnr_by_part
from avatar.events import HeldOutScore
from preprocess.body.parametric_body import ShapedBody
from preprocess.observation import Observation

PremultipliedImage = Float32[np.ndarray, "height width 4"]
"""RGBA with premultiplied alpha."""
FrameRenderer = Callable[[Observation], PremultipliedImage | None]
"""Renders the pose of a frame with its camera; None if there is no image of this frame."""

BACKGROUNDS = {"white": 1.0, "black": 0.0}
"""Gray behind the person, by name."""
REGIONS = ("", "_box", "_mask")
"""Suffixes of a metric over the whole image, the box of the person, and the mask."""
METRICS = (
    *(f"psnr{region}" for region in REGIONS),
    *(f"ssim{region}" for region in REGIONS),
    *(f"lpips_{name}{region}" for name in LPIPS_CONVENTIONS for region in REGIONS),
    *(f"psnr_{part}" for part in SCORED_PARTS),
    "cpu_ms",
)
"""All values of a frame that are averaged."""


@dataclass(frozen=True, kw_only=True)
class FrameScore(HeldOutScore):
    """Scores of one rendering against its frame, both on the same background.

    Attributes:
        psnr_box: PSNR in the bounding box of the mask, dB.
        cpu_ms: CPU time of rendering, over all threads; NaN if it was not rendered here.
        others: The others of `METRICS` that were measured.
    """

    psnr_box: float
    cpu_ms: float
    others: Mapping[str, float] = field(default_factory=dict)

    def value(self, metric: str) -> float:
        """Return one of `METRICS`; NaN if it was not measured."""
        return getattr(self, metric, self.others.get(metric, float("nan")))


@final
class FrameJudge:
    """Scores renderings of frames.

    Attributes:
        backgrounds: Names of `BACKGROUNDS`, in the order of the scores.
    """

    def __init__(
        self,
        backgrounds: tuple[str, ...] = ("white",),
        lpips: Lpips | None = None,
        shaped: ShapedBody | None = None,
    ) -> None:
        """Prepare the metrics.

        Args:
            backgrounds: Names of `BACKGROUNDS`.
            lpips: LPIPS; None to leave it out.
            shaped: The person, to score body parts; None to leave them out.
        """
        self.backgrounds, self._lpips, self._shaped = backgrounds, lpips, shaped
        self._patches = None if shaped is None else SkinPatches.from_shaped_body(shaped)

    def score(
        self,
        observation: Observation,
        picture: PremultipliedImage,
        *,
        cpu_ms: float = float("nan"),
    ) -> list[FrameScore]:
        """Compare a rendering with its frame, on each background.

        Args:
            observation: The frame.
            picture: The rendering; if it is opaque, it is on the background already.
            cpu_ms: CPU time that it took.
        """
        held, labels = HeldOutFrame(observation=observation), None
        if self._patches is not None and self._shaped is not None:
            labels = label_parts(self._patches, self._shaped, observation)
        silhouette, opaque = silhouette_of(observation), bool(picture[..., 3].min() >= 1.0)
        box, scores = _bounding_box(silhouette), list[FrameScore]()
        for name in self.backgrounds:
            gray = BACKGROUNDS[name]
            truth = ground_truth_over(observation, gray)
            shown = np.clip(composite_over(picture, gray), 0.0, 1.0)
            errors = (shown.astype(np.float64) - truth) ** 2
            score = score_rendering(picture, held, gray)
            score = replace(score, overlap=float("nan")) if opaque else score
            scores.append(
                FrameScore(
                    **vars(score),
                    psnr_box=psnr_of_errors(errors[box]),
                    cpu_ms=cpu_ms,
                    others={
                        "ssim_box": ssim(shown[box], truth[box]),
                        "ssim_mask": _ssim_within(shown, truth, silhouette),
                        **self._compare_perceptually(shown, truth, silhouette, box),
                        **psnr_by_part(errors, observation, labels),
                    },
                )
            )
        return scores

    def _compare_perceptually(
        self,
        shown: Float32[np.ndarray, "height width 3"],
        truth: Float32[np.ndarray, "height width 3"],
        silhouette: Bool[np.ndarray, "height width"],
        box: tuple[slice, slice],
    ) -> dict[str, float]:
        """LPIPS of the whole image, of the box as an image, and of its map within the mask."""
        lpips, values = self._lpips, dict[str, float]()
        for name in () if lpips is None else lpips.conventions:
            assert lpips is not None
            part = np.ascontiguousarray(shown[box]), np.ascontiguousarray(truth[box])
            values |= {
                f"lpips_{name}": lpips.compare(shown, truth, name),
                f"lpips_{name}_box": lpips.compare(*part, name),
                f"lpips_{name}_mask": lpips.compare_within(*part, silhouette[box], name),
            }
        return values


def _ssim_within(
    shown: Float32[np.ndarray, "height width 3"],
    truth: Float32[np.ndarray, "height width 3"],
    silhouette: Bool[np.ndarray, "height width"],
) -> float:
    inner = slice(SSIM_BORDER_PX, -SSIM_BORDER_PX)
    similarity = ssim_map(shown, truth)
    inside = similarity[silhouette[inner, inner]] if similarity.size else similarity
    return float(inside.mean()) if inside.size else float("nan")


def _bounding_box(silhouette: Bool[np.ndarray, "height width"]) -> tuple[slice, slice]:
    """Return rows and columns of the bounding box; empty for an empty silhouette."""
    spans = []
    for axis in (1, 0):
        where = np.flatnonzero(silhouette.any(axis=axis))
        spans.append(slice(where[0], where[-1] + 1) if where.size else slice(0, 0))
    return spans[0], spans[1]


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
