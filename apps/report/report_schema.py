"""report.json: what a run was given, what it did and how well it came out."""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from apps.report.learning_curve import CurvePoint
from avatar.evaluation.coverage import Coverage
from avatar.evaluation.coverage_advice import coverage_advice
from avatar.evaluation.sharpness import (
    SharpnessVerdict,
    better_verdict,
    median_blur,
    median_overlap,
    overall_verdict,
)
from avatar.events import HeldOutScore
from capture.process_metrics import ReservoirSample

REPORT_FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class MachineInfo:
    """What it ran on: device ("cpu", "cuda"), backend of the kernels, threads."""

    device: str
    backend: str
    threads: int


@dataclass(frozen=True, kw_only=True)
class DroppedFrameEntry:
    """A frame that was left out, and why."""

    index: int
    reason: str


@dataclass(frozen=True, kw_only=True)
class FrameStats:
    """What became of the frames.

    Attributes:
        read: Frames that came out of the video.
        used: Trained on.
        held_out: Scored, and never trained on.
        dropped: Left out.
        alike: Not trained on, because each looks like the one before it.
        not_replayed: Trained on when they came, but not among the key frames that stayed.
    """

    read: int
    used: int
    held_out: int
    dropped: tuple[DroppedFrameEntry, ...]
    near_duplicates: int
    not_replayed: int


@dataclass(frozen=True, kw_only=True)
class TrainingStats:
    """What training cost.

    Attributes:
        wall_seconds: From the first frame handed to the trainer to the last step.
        cpu_seconds: CPU time of the whole process in that time.
        cpu_contention_seconds: For how long threads of this run were ready and had no core, because
            other programs held them, summed; a resumed run counts only its own.
        startup_seconds: Before it: imports, reading and checking, kernels.
        steps, rays: How much was done.
        rays_per_second: By the wall clock.
        samples_per_ray: Mean.
        peak_memory_mb: Of the process, so far.
    """

    wall_seconds: float
    cpu_seconds: float
    cpu_contention_seconds: float
    startup_seconds: float
    steps: int
    rays: int
    rays_per_second: float
    samples_per_ray: float
    peak_memory_mb: float


@dataclass(frozen=True, kw_only=True)
class HeldOutStats:
    """How well frames are rendered that were never trained on, on white.

    Attributes:
        frames: Their numbers in the video.
        size: Width and height in pixels.
        psnr: Mean of the frames' PSNR over the whole picture, dB; null if nothing was scored.
        psnr_mask: The same over alpha > 0.5.
        ssim: Mean.
        verdict: What these figures mean: sharp, soft, blurred or failed (`avatar.evaluation.sharpness`); null
            if nothing was scored.
        blur: Equivalent blur that half of the frames stay within, as a share of the person's
            height; null if it is beyond the widest that is measured.
        overlap: Of the rendered alpha with the mask, reached by half of the frames.
        lpips: Not measured.
        background: What alpha was blended with.
        poses: Which poses the frames were rendered in.
    """

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

    @classmethod
    def of(cls, scores: tuple[HeldOutScore, ...], size: tuple[int, int] | None) -> "HeldOutStats":
        """From the scores of the single frames."""
        return cls(
            frames=tuple(score.frame for score in scores),
            size=size,
            psnr=finite_mean([score.psnr for score in scores]),
            psnr_mask=finite_mean([score.psnr_mask for score in scores]),
            ssim=finite_mean([score.ssim for score in scores]),
            verdict=overall_verdict(scores),
            blur=median_blur(score.blur for score in scores),
            overlap=median_overlap(score.overlap for score in scores),
        )


@dataclass(frozen=True, kw_only=True)
class Percentiles:
    """A spread of numbers: half of them are below p50, and 95 % below p95."""

    p50: float
    p95: float

    @classmethod
    def of(cls, numbers: ReservoirSample, *, scale: float = 1.0) -> "Percentiles":
        """Of what a reservoir has seen, times `scale`."""
        p50, p95 = (scale * numbers.percentile(percent) for percent in (50.0, 95.0))
        return cls(p50=p50, p95=p95)


@dataclass(frozen=True, kw_only=True)
class StreamStats:
    """How the video kept pace.

    Attributes:
        realtime: Whether frames came at times of their own: played so, or live.
        ingest_ms: From decoding to ready for training, per frame.
        inbox_dropped: Frames of a live source that gave way, because nobody took them in time.
        ready_after_last_frame_seconds: From the end of the video, had it been filmed from the
            first frame on, to the finished package; null without a package.
        latency_ms: From the moment when a frame was there (due, filmed, or decoded) until the
            trainer had it.
        lateness_ms: How long after that moment its preparation began.
        inbox_depth: Frames that waited in the inbox.
    """

    realtime: bool
    ingest_ms: Percentiles
    inbox_dropped: int
    ready_after_last_frame_seconds: float | None
    latency_ms: Percentiles
    lateness_ms: Percentiles
    inbox_depth: Percentiles


@dataclass(frozen=True, kw_only=True)
class PackageStats:
    """The package, beside the report, and how close its player is to the volume renderer."""

    path: str
    bytes: int
    seconds: float
    psnr_to_renderer: dict[str, float | None]


@dataclass(frozen=True, kw_only=True)
class CoverageStats:
    """What of the person's skin the frames show that were trained on.

    Attributes:
        seen: Share of the skin, in [0, 1].
        well: The same, counting only what was seen within 53° of squarely.
        advice: What the person should do next, in a sentence.
        parts: For each body part its share under "seen", then one for each side that it has. Left
            and right are the person's.
    """

    seen: float
    well: float
    advice: str
    parts: dict[str, dict[str, float]]

    @classmethod
    def of(cls, coverage: Coverage) -> "CoverageStats":
        """As things stand."""
        parts = {
            name: {"seen": part.seen_share, **part.sides}
            for name, part in coverage.by_part().items()
        }
        return cls(
            seen=coverage.seen_share,
            well=coverage.well_seen_share,
            advice=coverage_advice(coverage),
            parts=parts,
        )


@dataclass(frozen=True, kw_only=True)
class ForgettingStats:
    """What became of earlier videos when this one was added.

    Attributes:
        videos: Names of the videos that were learnt before, in order.
        used: How many of their frames the avatar had been trained on.
        wall_seconds: How long it had been trained.
        recalled: Their key frames that were learnt from again.
        frames: Their held-out frames that were scored, by their numbers in their own video.
        video_of_frame: Of which of `videos` each of those is, counted from 1.
        psnr_before, psnr_after: Means over them before this video, and at the end, dB.
        largest_drop: Of any of them, dB; 0 if none fell.
    """

    videos: tuple[str, ...]
    frames_trained: int
    wall_seconds: float
    replayed_key_frames: int
    frames: tuple[int, ...]
    video_of_frame: tuple[int, ...]
    psnr_before: float | None
    psnr_after: float | None
    largest_drop: float | None

    @classmethod
    def of(
        cls,
        before: tuple[HeldOutScore, ...],
        after: tuple[HeldOutScore, ...],
        *,
        videos: tuple[str, ...],
        video_of_frame: Sequence[int],
        frames_trained: int,
        wall_seconds: float,
        replayed_key_frames: int,
    ) -> "ForgettingStats":
        """From the scores of the same frames before and after."""
        falls = [b.psnr - a.psnr for b, a in zip(before, after, strict=True)]
        return cls(
            videos=videos,
            frames_trained=frames_trained,
            wall_seconds=wall_seconds,
            replayed_key_frames=replayed_key_frames,
            frames=tuple(score.frame for score in before),
            video_of_frame=tuple(video_of_frame),
            psnr_before=finite_mean([score.psnr for score in before]),
            psnr_after=finite_mean([score.psnr for score in after]),
            largest_drop=max(0.0, *falls) if falls else None,
        )


@dataclass(frozen=True, kw_only=True)
class Report:
    """All of it. `package` is None if none was written, `cameras` if none were solved."""

    command: dict[str, Any]
    recipe: dict[str, Any]
    machine: MachineInfo
    frames: FrameStats
    training: TrainingStats
    held_out: HeldOutStats
    curve: tuple[CurvePoint, ...]
    stream: StreamStats
    package: PackageStats | None
    held_out_refined: HeldOutStats | None = None
    coverage: CoverageStats | None = None
    earlier_videos: ForgettingStats | None = None
    cameras: dict[str, Any] | None = None
    format: int = REPORT_FORMAT

    @property
    def verdict(self) -> SharpnessVerdict | None:
        """What the avatar is, in a word: in fitted poses where it looks better in them."""
        fitted = self.held_out_refined
        return better_verdict(self.held_out.verdict, None if fitted is None else fitted.verdict)

    def to_json(self) -> str:
        """The text of report.json; what is not a number is null."""
        content = _to_json_value(dataclasses.asdict(self) | {"verdict": self.verdict})
        order = ("format", "verdict", "command", "recipe", "machine", "frames", "training")
        order += ("held_out", "held_out_refined", "curve", "stream", "package", "coverage")
        order += ("earlier_videos", "cameras")
        return json.dumps({key: content[key] for key in order}, indent=1, allow_nan=False) + "\n"


def provisional_verdict(verdict: str | None) -> str | None:
    """The word for an avatar that is still learnt: nothing has failed then."""
    return "no person to be seen yet" if verdict == "failed" else verdict


def format_psnr(
    psnr: float | None, verdict: str | None, *, digits: int = 2, provisional: bool = False
) -> str:
    """A PSNR as people read it, with what it means: "22.78 dB (blurred)".

    Args:
        psnr: In dB.
        verdict: Its word.
        digits: After the point.
        learning: Whether the avatar is still learnt: nothing has failed then.
    """
    if psnr is None:
        return "n/a"
    word = provisional_verdict(verdict) if provisional else verdict
    return f"{psnr:.{digits}f} dB" + (f" ({word})" if word else "")


def format_percent(share: float) -> str:
    """A share as people read it; only all of it is 100 %, and only nothing of it 0 %."""
    if 0.0 < share < 1.0:
        return f"{min(max(round(100.0 * share), 1), 99)} %"
    return f"{100.0 * share:.0f} %"


def finite_mean(values: list[float]) -> float | None:
    """The mean of the finite ones; None if there are none."""
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def _to_json_value(value: Any) -> Any:
    """Numbers of a sensible length, and null for NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): _to_json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_to_json_value(item) for item in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value
