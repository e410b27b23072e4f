"""Scores of an avatar by renderer and poses, as an aligned Markdown table and as JSON."""

import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32

from apps.report.report_schema import finite_mean
from avatar.evaluation.held_out import MASK_THRESHOLD, HeldOutFrame, score_rendering
from avatar.evaluation.image_metrics import composite_on_white, ground_truth_on_white, psnr
from avatar.evaluation.sharpness import SharpnessVerdict, overall_verdict
from preprocess.observation import Observation

PremultipliedImage = Float32[np.ndarray, "height width 4"]
"""RGBA with premultiplied alpha."""


@dataclass(frozen=True, kw_only=True)
class FrameScore:
    """Scores of one rendering against its frame, both on white.

    Attributes:
        frame: Frame number in the video.
        psnr: PSNR of the whole image, dB.
        psnr_mask: PSNR where alpha > 0.5, dB.
        psnr_box: PSNR in the bounding box of the mask, dB.
        ssim: SSIM of the whole image (Wang et al. 2004), in [-1, 1].
        blur: Equivalent blur, as a fraction of body height (`avatar.evaluation.sharpness`).
        overlap: Soft IoU of rendered alpha and mask, in [0, 1].
        cpu_ms: CPU time of rendering, over all threads.
    """

    frame: int
    psnr: float
    psnr_mask: float
    psnr_box: float
    ssim: float
    blur: float
    overlap: float
    cpu_ms: float


METRICS = ("psnr", "psnr_box", "psnr_mask", "ssim", "cpu_ms")
"""Fields of `FrameScore` that are averaged."""


@dataclass(frozen=True, kw_only=True)
class ScoreRow:
    """Scores of one renderer with one kind of poses.

    Attributes:
        renderer: "renderer", "player hq" or "player lite".
        poses: "given" or "fitted".
        scores: Scores of each frame.
    """

    renderer: str
    poses: str
    scores: list[FrameScore] = field(default_factory=list)

    def mean_of(self, name: str) -> float | None:
        """Return the mean of one of `METRICS` over the frames; None without finite values."""
        return finite_mean([getattr(score, name) for score in self.scores])

    @property
    def verdict(self) -> SharpnessVerdict | None:
        """Verdict on the frames; None without a silhouette."""
        return overall_verdict(self.scores)

    def as_json(self) -> dict[str, object]:
        """Return means, then the scores of every frame."""
        return {
            "renderer": self.renderer,
            "poses": self.poses,
            **{name: _json_number(self.mean_of(name)) for name in METRICS},
            "verdict": self.verdict,
            "frames": [
                {key: _json_number(value) for key, value in vars(score).items()}
                for score in self.scores
            ],
        }


@dataclass(frozen=True, kw_only=True)
class AvatarEvaluation:
    """Scores of an avatar on a capture.

    Attributes:
        name: Name of the avatar in the table.
        capture: Path of the video.
        size: Width and height of the images; None without any.
        rows: Scores by renderer and poses, at least one.
        paper: Scores in the paper, if the subject is in it.
    """

    name: str
    capture: str
    size: tuple[int, int] | None
    rows: Sequence[ScoreRow]
    paper: dict[str, float] | None = None

    def as_json(self) -> dict[str, object]:
        """Return the scores as JSON."""
        return {
            "avatar": self.name,
            "capture": self.capture,
            "size": self.size,
            "background": "white",
            "rows": [row.as_json() for row in self.rows],
            "paper": self.paper,
        }


def score_frame(
    observation: Observation, render_image: Callable[[], PremultipliedImage]
) -> FrameScore:
    """Render a frame's pose and compare the image with the frame.

    Args:
        observation: The frame.
        render_image: Renders with premultiplied alpha.
    """
    started = time.process_time()
    picture = render_image()
    cpu_ms = 1000.0 * (time.process_time() - started)
    shown, truth = (
        np.clip(composite_on_white(picture), 0.0, 1.0),
        ground_truth_on_white(observation),
    )
    rows, columns = _bounding_box(observation.alpha > MASK_THRESHOLD)
    score = score_rendering(picture, HeldOutFrame(observation=observation))
    return FrameScore(
        **vars(score),
        psnr_box=psnr(shown[rows, columns], truth[rows, columns]),
        cpu_ms=cpu_ms,
    )


def evaluations_to_json(evaluations: Iterable[AvatarEvaluation]) -> str:
    """Return the content of the file for --json."""
    content = {"format": 1, "avatars": [each.as_json() for each in evaluations]}
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _bounding_box(silhouette: Bool[np.ndarray, "height width"]) -> tuple[slice, slice]:
    """Return rows and columns of the bounding box; empty for an empty silhouette."""
    spans = []
    for axis in (1, 0):
        where = np.flatnonzero(silhouette.any(axis=axis))
        spans.append(slice(where[0], where[-1] + 1) if where.size else slice(0, 0))
    return spans[0], spans[1]


def _json_number(value: float | int | None) -> float | int | None:
    return None if value is None or not np.isfinite(value) else round(value, 4)


HEADER = (
    "avatar", "frames", "drawn by", "poses", "PSNR", "in the box", "in the mask", "SSIM", "ms",
    "looks",
)  # fmt: skip
LEFT_ALIGNED_COLUMNS = (0, 2, 3, 9)
"""Columns of the table that are left-aligned."""
FORMATS = {"psnr": ".2f", "psnr_box": ".2f", "psnr_mask": ".2f", "ssim": ".4f", "cpu_ms": ".0f"}
"""Format of each metric in the table."""
PAPER_ROW_NAME = "InstantAvatar (paper)"
"""Renderer of the rows with the paper's scores."""


def markdown_table(evaluations: Sequence[AvatarEvaluation]) -> str:
    """Return all rows of all avatars, and their means over several avatars, as Markdown."""
    lines = [HEADER]
    for each in evaluations:
        lines += [_row_cells(each.name, row) for row in each.rows]
        if each.paper is not None:
            lines.append(_paper_cells(each))
    if len(evaluations) > 1:
        lines += _mean_rows(evaluations)
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEADER))]
    rule = [
        "-" * width if i in LEFT_ALIGNED_COLUMNS else "-" * (width - 1) + ":"
        for i, width in enumerate(widths)
    ]
    drawn = [_pad_cells(lines[0], widths), rule, *(_pad_cells(line, widths) for line in lines[1:])]
    return "\n".join(f"| {' | '.join(line)} |" for line in drawn) + "\n"


def _pad_cells(line: Sequence[str], widths: Sequence[int]) -> list[str]:
    return [
        text.ljust(width) if column in LEFT_ALIGNED_COLUMNS else text.rjust(width)
        for column, (text, width) in enumerate(zip(line, widths, strict=True))
    ]


def _row_cells(name: str, row: ScoreRow) -> tuple[str, ...]:
    figures = (_format_cell(row.mean_of(figure), form) for figure, form in FORMATS.items())
    looks = row.verdict or ""
    return (name, str(len(row.scores)), row.renderer, row.poses, *figures, looks)


def _paper_cells(each: AvatarEvaluation) -> tuple[str, ...]:
    """Return the cells of the paper's scores."""
    assert each.paper is not None
    figures = (_format_cell(each.paper.get(figure), form) for figure, form in FORMATS.items())
    return (each.name, "", PAPER_ROW_NAME, "fitted", *figures, "")


def _mean_rows(evaluations: Sequence[AvatarEvaluation]) -> list[tuple[str, ...]]:
    """Return the mean over avatars for each renderer and kind of poses that all of them have."""
    ways = [(row.renderer, row.poses) for row in evaluations[0].rows]
    lines = []
    for way in ways:
        alike = [r for each in evaluations for r in each.rows if (r.renderer, r.poses) == way]
        if len(alike) != len(evaluations):
            continue
        figures = []
        for figure, form in FORMATS.items():
            values = [value for row in alike if (value := row.mean_of(figure)) is not None]
            figures.append(_format_cell(sum(values) / len(values) if values else None, form))
        lines.append(("mean", str(sum(len(row.scores) for row in alike)), *way, *figures, ""))
    return lines


def _format_cell(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
