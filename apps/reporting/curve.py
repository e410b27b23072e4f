"""The learning curve: scores of held-out frames over training time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """How well held-out frames were rendered at some second of training.

    Attributes:
        wall_seconds, cpu_seconds: Training time so far.
        frames_seen: EvaluationFrames trained on so far.
        psnr, psnr_mask: Means over the frames that were scored at this mark, dB.
        verdict: What the scores mean, in a word (`avatar.sharpness`).
        frames: Which those were, by their numbers in the video, each with its own PSNR of the whole
            picture: they need not be the same at every mark, so that only a frame's own scores tell
            whether it fell.
        video: Whose frames they are: 1 for the video that was learnt first.
    """

    wall_seconds: float
    cpu_seconds: float
    frames_seen: int
    psnr: float | None
    psnr_mask: float | None
    verdict: str | None = None
    frames: tuple[tuple[int, float], ...] = ()
    video: int = 1

    @classmethod
    def from_checkpoint(cls, content: dict[str, Any]) -> "CurvePoint":
        """From what a checkpoint kept."""
        frames = content.get("frames", [])
        return cls(**{**content, "frames": tuple((frame, psnr) for frame, psnr in frames)})


def largest_drops(curve: Sequence[CurvePoint]) -> dict[tuple[int, int], float]:
    """How far each held-out frame fell below its own best by a later mark, dB; 0 if it did not.

    By video and number, of the frames that were scored more than once.
    """
    best: dict[tuple[int, int], float] = {}
    falls: dict[tuple[int, int], float] = {}
    for point in curve:
        for number, value in point.frames:
            frame = point.video, number
            if frame in best:
                falls[frame] = max(falls.get(frame, 0.0), best[frame] - value)
            best[frame] = max(best.get(frame, value), value)
    return falls


def largest_drop(curve: Sequence[CurvePoint]) -> float | None:
    """The largest of `largest_drops`, dB; None if no frame was scored twice."""
    return max(largest_drops(curve).values(), default=None)
