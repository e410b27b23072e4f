"""Pictures of an avatar beside the frames that they should show: one row of a table each way."""

import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32

from apps.reporting.report import mean
from avatar.hold import SILHOUETTE, HeldOut, compared, on_white, truth_on_white
from avatar.metrics import psnr
from avatar.sharpness import Verdict, verdict_of
from preprocess.observation import Observation

Picture = Float32[np.ndarray, "height width 4"]


@dataclass(frozen=True, kw_only=True)
class FrameScore:
    """How close one picture comes to its frame, both on white.

    Attributes:
        frame: Its number in the video.
        psnr: Of the whole picture, dB.
        psnr_mask: Where alpha > 0.5, dB.
        psnr_box: In the smallest upright box around that, dB.
        ssim: Of the whole picture (Wang et al. 2004), in [-1, 1].
        blur: Equivalent blur, as a share of the person's height (`avatar.sharpness`).
        overlap: Of the drawn alpha with the mask, in [0, 1].
        cpu_ms: What the picture took, of all the process's threads.
    """

    frame: int
    psnr: float
    psnr_mask: float
    psnr_box: float
    ssim: float
    blur: float
    overlap: float
    cpu_ms: float


FIGURES = ("psnr", "psnr_box", "psnr_mask", "ssim", "cpu_ms")


@dataclass(frozen=True, kw_only=True)
class Row:
    """One way to draw an avatar, scored.

    Attributes:
        drawn_by: "renderer", "player hq" or "player lite".
        poses: "given" or "fitted".
        scores: One for each frame.
    """

    drawn_by: str
    poses: str
    scores: list[FrameScore] = field(default_factory=list)

    def figure(self, name: str) -> float | None:
        """The mean of one of `FIGURES` over the frames; None if no frame has it."""
        return mean([getattr(score, name) for score in self.scores])

    @property
    def verdict(self) -> Verdict | None:
        """What the figures mean, in a word; None without a silhouette to look at."""
        return verdict_of(self.scores)

    def as_json(self) -> dict[str, object]:
        """Means, then every frame."""
        return {
            "drawn_by": self.drawn_by,
            "poses": self.poses,
            **{name: _plain(self.figure(name)) for name in FIGURES},
            "verdict": self.verdict,
            "frames": [
                {key: _plain(value) for key, value in vars(score).items()} for score in self.scores
            ],
        }


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """An avatar's rows.

    Attributes:
        name: By which the table calls it.
        capture: What it was compared with.
        size: Of the pictures, width and height; None if there was none.
        rows: At least one.
        paper: The same figures as the paper has them, where it does.
    """

    name: str
    capture: str
    size: tuple[int, int] | None
    rows: Sequence[Row]
    paper: dict[str, float] | None = None

    def as_json(self) -> dict[str, object]:
        """For machines."""
        return {
            "avatar": self.name,
            "capture": self.capture,
            "size": self.size,
            "background": "white",
            "rows": [row.as_json() for row in self.rows],
            "paper": self.paper,
        }


def scored(seen: Observation, draw: Callable[[], Picture]) -> FrameScore:
    """Draws a picture and compares it with the frame.

    Args:
        seen: The frame.
        draw: Makes the picture, premultiplied.
    """
    started = time.process_time()
    picture = draw()
    cpu_ms = 1000.0 * (time.process_time() - started)
    shown, truth = np.clip(on_white(picture), 0.0, 1.0), truth_on_white(seen)
    rows, columns = _box(seen.alpha > SILHOUETTE)
    score = compared(picture, HeldOut(observation=seen))
    return FrameScore(
        **vars(score),
        psnr_box=psnr(shown[rows, columns], truth[rows, columns]),
        cpu_ms=cpu_ms,
    )


def to_json(evaluations: Iterable[Evaluation]) -> str:
    """The text of the file that --json names."""
    content = {"format": 1, "avatars": [each.as_json() for each in evaluations]}
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _box(silhouette: Bool[np.ndarray, "height width"]) -> tuple[slice, slice]:
    """Rows and columns of the smallest box around it; empty around nothing."""
    spans = []
    for axis in (1, 0):
        where = np.flatnonzero(silhouette.any(axis=axis))
        spans.append(slice(where[0], where[-1] + 1) if where.size else slice(0, 0))
    return spans[0], spans[1]


def _plain(value: float | int | None) -> float | int | None:
    return None if value is None or not np.isfinite(value) else round(value, 4)
