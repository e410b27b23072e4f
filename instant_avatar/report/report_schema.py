"""report.json: the inputs of a run, its cost and the quality of its avatar.

docs/report.md says what each key means.
"""

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from avatar.evaluation.all_round_verdict import AllRoundVerdict
from avatar.evaluation.coverage import Coverage, coverage_advice
from avatar.evaluation.image_metrics import (
    SharpnessVerdict,
    median_blur,
    median_overlap,
    overall_verdict,
)
from avatar.events import HeldOutScore
from capture.input_error import counted
from preprocess.observation import DroppedFrame
from preprocess.tracking.video_tracking import NOT_FOUND

DROP_REASONS = {
    NOT_FOUND: "without the person",
    "no pose": "without a pose",
    "pose invalid": "without a pose",
    "no camera": "without a camera",
    "mask empty": "with an empty mask",
    "mask unusable": "with no mask or an unusable one",
    "picture damaged": "damaged",
}
"""Reasons for which frames are left out, as an attribute of the frames."""


@dataclass(frozen=True, kw_only=True)
class MachineInfo:
    """Number of threads, device and compiler of the kernels."""

    threads: int
    device: str = "cpu"
    backend: str = "numba"


@dataclass(frozen=True, kw_only=True)
class FrameStats:
    """Number of frames by use."""

    read: int
    used: int
    held_out: int
    dropped: tuple[DroppedFrame, ...]
    near_duplicates: int
    not_replayed: int

    def sentence(self) -> str:
        """Tell what became of all frames."""
        parts = [f"{self.used} learnt from"]
        if self.held_out:
            parts.append(f"{self.held_out} held out for scores")
        if self.near_duplicates:
            parts.append(f"{self.near_duplicates} almost like the one before")
        left_out = self.read - self.used - self.held_out - self.near_duplicates
        if left_out:
            causes = [drop.reason.partition(":")[0] for drop in self.dropped]
            words = [DROP_REASONS.get(cause, f"with {cause}") for cause in causes]
            reasons = ", ".join(f"{count} {word}" for word, count in Counter(words).most_common())
            parts.append(f"{left_out} left out ({reasons})")
        return f"{counted(self.read, 'frame')} read: {', '.join(parts)}."


@dataclass(frozen=True, kw_only=True)
class TrainingStats:
    """Cost of training."""

    wall_seconds: float
    cpu_seconds: float
    step_cpu_seconds: float
    startup_seconds: float
    steps: int
    rays: int
    rays_per_second: float
    samples_per_ray: float
    peak_memory_mb: float


@dataclass(frozen=True, kw_only=True)
class HeldOutStats:
    """Scores of the held-out frames, composited on white."""

    frames: tuple[int, ...]
    size: tuple[int, int] | None
    psnr: float | None
    psnr_mask: float | None
    ssim: float | None
    verdict: SharpnessVerdict | None
    blur: float | None
    overlap: float | None
    lpips: float | None = None
    background: str = "white"
    poses: str = "given"
    whole_images: int = 0

    @classmethod
    def of(cls, scores: tuple[HeldOutScore, ...], size: tuple[int, int] | None) -> "HeldOutStats":
        """Summarize the scores of single frames."""
        return cls(
            frames=tuple(score.frame for score in scores),
            size=size,
            psnr=finite_mean([score.psnr for score in scores]),
            psnr_mask=finite_mean([score.psnr_mask for score in scores]),
            ssim=finite_mean([score.ssim for score in scores]),
            verdict=overall_verdict(scores),
            blur=median_blur(score.blur for score in scores),
            overlap=median_overlap(score.overlap for score in scores),
            whole_images=sum(not math.isnan(score.ssim) for score in scores),
        )


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """One evaluation of held-out frames during training.

    Its scores are estimates from a sample of the pixels, the same ones every time. `frames`
    are their numbers in the video, and the PSNR of each; `pixels` is None if all were scored.
    """

    wall_seconds: float
    cpu_seconds: float
    frames_seen: int
    psnr: float | None
    psnr_mask: float | None
    verdict: str | None = None
    frames: tuple[tuple[int, float], ...] = ()
    video: int = 1
    pixels: int | None = None


@dataclass(frozen=True, kw_only=True)
class Percentiles:
    """Median and 95th percentile."""

    p50: float
    p95: float

    @classmethod
    def of(cls, numbers: Sequence[float], *, scale: float = 1.0) -> "Percentiles":
        """Return the percentiles of some numbers, times `scale`; 0 of none."""
        p50, p95 = scale * np.percentile(numbers or [0.0], (50.0, 95.0))
        return cls(p50=float(p50), p95=float(p95))


@dataclass(frozen=True, kw_only=True)
class StreamStats:
    """Timing of the frame stream."""

    realtime: bool
    ingest_ms: Percentiles
    inbox_dropped: int
    ready_after_last_frame_seconds: float | None
    latency_ms: Percentiles
    lateness_ms: Percentiles
    inbox_depth: Percentiles


@dataclass(frozen=True, kw_only=True)
class PackageStats:
    """The package next to the report, and the PSNR of its player against the volume renderer."""

    path: str
    bytes: int
    seconds: float
    psnr_to_renderer: dict[str, float | None]


@dataclass(frozen=True, kw_only=True)
class CoverageStats:
    """Fraction of the person's skin that the training frames show."""

    seen: float
    well: float
    advice: str
    parts: dict[str, dict[str, float]]

    @classmethod
    def of(cls, coverage: Coverage) -> "CoverageStats":
        """Summarize the coverage in its current state."""
        return cls(
            seen=coverage.seen_share,
            well=coverage.well_seen_share,
            advice=coverage_advice(coverage),
            parts=coverage.by_part(),
        )


@dataclass(frozen=True, kw_only=True)
class EarlierVideoStats:
    """The videos that the avatar was trained on before this one."""

    videos: tuple[str, ...]
    frames_trained: int
    wall_seconds: float
    replayed_key_frames: int


@dataclass(frozen=True, kw_only=True)
class Report:
    """A whole report.

    `package` is None if none was written, `cameras` if none were solved, `tracking` if poses were
    given.
    """

    command: dict[str, Any]
    recipe: dict[str, Any]
    machine: MachineInfo
    frames: FrameStats
    training: TrainingStats
    held_out: HeldOutStats
    held_out_refined: HeldOutStats | None = None
    all_round: AllRoundVerdict
    curve: tuple[CurvePoint, ...]
    stream: StreamStats
    package: PackageStats | None
    coverage: CoverageStats | None = None
    earlier_videos: EarlierVideoStats | None = None
    cameras: dict[str, Any] | None = None
    tracking: dict[str, Any] | None = None
    licence: dict[str, Any] | None = None

    @property
    def verdict(self) -> SharpnessVerdict | None:
        """Verdict on the avatar from all sides."""
        return self.all_round.verdict

    def to_json(self) -> str:
        """Return the text of report.json; NaN and infinity become null."""
        content = {"format": 1, "verdict": self.verdict} | dataclasses.asdict(self)
        return json.dumps(to_json_value(content), indent=1, allow_nan=False) + "\n"


def format_psnr(
    psnr: float | None, verdict: str | None, *, digits: int = 2, provisional: bool = False
) -> str:
    """Format a PSNR in dB with its verdict: "22.78 dB (blurred)"; None is "n/a".

    While training continues (`provisional`), the word "failed" does not apply yet.
    """
    if psnr is None:
        return "n/a"
    word = "not converged yet" if provisional and verdict == "failed" else verdict
    return f"{psnr:.{digits}f} dB" + (f" ({word})" if word else "")


def format_percent(share: float) -> str:
    """Format a fraction in percent; only 1 is "100 %", and only 0 is "0 %"."""
    if 0.0 < share < 1.0:
        return f"{min(max(round(100.0 * share), 1), 99)} %"
    return f"{100.0 * share:.0f} %"


def finite_mean(values: list[float]) -> float | None:
    """Return the mean of the finite values; None if there are none."""
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def to_json_value(value: Any) -> Any:
    """Round floats to 6 digits and replace NaN and infinity by null."""
    if isinstance(value, dict):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value
