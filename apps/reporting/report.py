"""report.json: what a run was given, what it did and how well it came out."""

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from apps.reporting.curve import CurvePoint
from avatar.advice import advice
from avatar.coverage import Coverage
from avatar.events import Score
from avatar.sharpness import Verdict, better, typical_blur, typical_overlap, verdict_of
from capture.reservoir import Reservoir

FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class MachineNote:
    """What it ran on: device ("cpu", "cuda"), backend of the kernels, threads."""

    device: str
    backend: str
    threads: int


@dataclass(frozen=True, kw_only=True)
class DroppedNote:
    """A frame that was left out, and why."""

    index: int
    reason: str


@dataclass(frozen=True, kw_only=True)
class FramesNote:
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
    dropped: tuple[DroppedNote, ...]
    alike: int
    not_replayed: int


@dataclass(frozen=True, kw_only=True)
class TrainingNote:
    """What training cost.

    Attributes:
        wall_seconds: From the first frame handed to the trainer to the last step.
        cpu_seconds: CPU time of the whole process in that time.
        cpu_waited_seconds: For how long threads of this run were ready and had no core, because
            other programs held them, summed; a resumed run counts only its own.
        startup_seconds: Before it: imports, reading and checking, kernels.
        steps, rays: How much was done.
        rays_per_second: By the wall clock.
        samples_per_ray: Mean.
        peak_memory_mb: Of the process, so far.
    """

    wall_seconds: float
    cpu_seconds: float
    cpu_waited_seconds: float
    startup_seconds: float
    steps: int
    rays: int
    rays_per_second: float
    samples_per_ray: float
    peak_memory_mb: float


@dataclass(frozen=True, kw_only=True)
class HeldOutNote:
    """How well frames are rendered that were never trained on, on white.

    Attributes:
        frames: Their numbers in the video.
        size: Width and height in pixels.
        psnr: Mean of the frames' PSNR over the whole picture, dB; null if nothing was scored.
        psnr_mask: The same over alpha > 0.5.
        ssim: Mean.
        verdict: What these figures mean: sharp, soft, blurred or failed (`avatar.sharpness`); null
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
    verdict: Verdict | None
    blur: float | None
    overlap: float | None
    lpips: float | None = None
    background: str = "white"
    poses: str = "given"

    @classmethod
    def of(cls, scores: tuple[Score, ...], size: tuple[int, int] | None) -> "HeldOutNote":
        """From the scores of the single frames."""
        return cls(
            frames=tuple(score.frame for score in scores),
            size=size,
            psnr=mean([score.psnr for score in scores]),
            psnr_mask=mean([score.psnr_mask for score in scores]),
            ssim=mean([score.ssim for score in scores]),
            verdict=verdict_of(scores),
            blur=typical_blur(score.blur for score in scores),
            overlap=typical_overlap(score.overlap for score in scores),
        )


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A spread of numbers: half of them are below p50, and 95 % below p95."""

    p50: float
    p95: float

    @classmethod
    def of(cls, numbers: Reservoir, *, scale: float = 1.0) -> "Spread":
        """Of what a reservoir has seen, times `scale`."""
        p50, p95 = (scale * numbers.percentile(percent) for percent in (50.0, 95.0))
        return cls(p50=p50, p95=p95)


@dataclass(frozen=True, kw_only=True)
class StreamNote:
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
    ingest_ms: Spread
    inbox_dropped: int
    ready_after_last_frame_seconds: float | None
    latency_ms: Spread
    lateness_ms: Spread
    inbox_depth: Spread


@dataclass(frozen=True, kw_only=True)
class PackageNote:
    """The package, beside the report, and how close its player is to the volume renderer."""

    path: str
    bytes: int
    seconds: float
    psnr_to_renderer: dict[str, float | None]


@dataclass(frozen=True, kw_only=True)
class CoverageNote:
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
    def of(cls, coverage: Coverage) -> "CoverageNote":
        """As things stand."""
        parts = {name: {"seen": part.seen, **part.sides} for name, part in coverage.parts().items()}
        return cls(seen=coverage.seen, well=coverage.well, advice=advice(coverage), parts=parts)


@dataclass(frozen=True, kw_only=True)
class ExtendedNote:
    """What became of earlier videos when this one was added.

    Attributes:
        videos: Names of the videos that were learnt before, in order.
        used: How many of their frames the avatar had been trained on.
        wall_seconds: How long it had been trained.
        recalled: Their key frames that were learnt from again.
        frames: Their held-out frames that were scored, by their numbers in their own video.
        video_of_frame: Of which of `videos` each of those is, counted from 1.
        psnr_before, psnr_after: Means over them before this video, and at the end, dB.
        largest_fall: Of any of them, dB; 0 if none fell.
    """

    videos: tuple[str, ...]
    used: int
    wall_seconds: float
    recalled: int
    frames: tuple[int, ...]
    video_of_frame: tuple[int, ...]
    psnr_before: float | None
    psnr_after: float | None
    largest_fall: float | None

    @classmethod
    def of(
        cls,
        before: tuple[Score, ...],
        after: tuple[Score, ...],
        *,
        videos: tuple[str, ...],
        video_of_frame: Sequence[int],
        used: int,
        wall_seconds: float,
        recalled: int,
    ) -> "ExtendedNote":
        """From the scores of the same frames before and after."""
        falls = [b.psnr - a.psnr for b, a in zip(before, after, strict=True)]
        return cls(
            videos=videos,
            used=used,
            wall_seconds=wall_seconds,
            recalled=recalled,
            frames=tuple(score.frame for score in before),
            video_of_frame=tuple(video_of_frame),
            psnr_before=mean([score.psnr for score in before]),
            psnr_after=mean([score.psnr for score in after]),
            largest_fall=max(0.0, *falls) if falls else None,
        )


@dataclass(frozen=True, kw_only=True)
class Report:
    """All of it. `package` is None if none was written, `cameras` if none were solved."""

    command: dict[str, Any]
    recipe: dict[str, Any]
    machine: MachineNote
    frames: FramesNote
    training: TrainingNote
    held_out: HeldOutNote
    curve: tuple[CurvePoint, ...]
    stream: StreamNote
    package: PackageNote | None
    held_out_refined: HeldOutNote | None = None
    coverage: CoverageNote | None = None
    extended: ExtendedNote | None = None
    cameras: dict[str, Any] | None = None
    format: int = FORMAT

    @property
    def verdict(self) -> Verdict | None:
        """What the avatar is, in a word: in fitted poses where it looks better in them."""
        fitted = self.held_out_refined
        return better(self.held_out.verdict, None if fitted is None else fitted.verdict)

    def to_json(self) -> str:
        """The text of report.json; what is not a number is null."""
        content = _plain(dataclasses.asdict(self) | {"verdict": self.verdict})
        order = ("format", "verdict", "command", "recipe", "machine", "frames", "training")
        order += ("held_out", "held_out_refined", "curve", "stream", "package", "coverage")
        order += ("extended", "cameras")
        return json.dumps({key: content[key] for key in order}, indent=1, allow_nan=False) + "\n"


def so_far(verdict: str | None) -> str | None:
    """The word for an avatar that is still learnt: nothing has failed then."""
    return "no person to be seen yet" if verdict == "failed" else verdict


def decibels(
    psnr: float | None, verdict: str | None, *, digits: int = 2, learning: bool = False
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
    word = so_far(verdict) if learning else verdict
    return f"{psnr:.{digits}f} dB" + (f" ({word})" if word else "")


def percent(share: float) -> str:
    """A share as people read it; only all of it is 100 %, and only nothing of it 0 %."""
    if 0.0 < share < 1.0:
        return f"{min(max(round(100.0 * share), 1), 99)} %"
    return f"{100.0 * share:.0f} %"


def mean(values: list[float]) -> float | None:
    """The mean of the finite ones; None if there are none."""
    finite = [value for value in values if math.isfinite(value)]
    return sum(finite) / len(finite) if finite else None


def _plain(value: Any) -> Any:
    """Numbers of a sensible length, and null for NaN and infinity."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value
