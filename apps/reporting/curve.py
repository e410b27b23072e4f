"""The learning curve: scores of held-out frames over training time."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """How well held-out frames were rendered at some second of training.

    Attributes:
        wall_seconds, cpu_seconds: Training time so far.
        frames_seen: Frames trained on so far.
        psnr, psnr_mask: Means over the frames that were scored at this mark, dB.
        verdict: What the scores mean, in a word (`avatar.sharpness`).
        frames: Which those were, each with its own PSNR of the whole picture: they need not be the
            same at every mark, so that only a frame's own scores tell whether it fell.
    """

    wall_seconds: float
    cpu_seconds: float
    frames_seen: int
    psnr: float | None
    psnr_mask: float | None
    verdict: str | None = None
    frames: tuple[tuple[int, float], ...] = ()

    @classmethod
    def again(cls, content: dict[str, Any]) -> "CurvePoint":
        """From what a checkpoint kept."""
        frames = content.get("frames", [])
        return cls(**{**content, "frames": tuple((frame, psnr) for frame, psnr in frames)})


def largest_fall(curve: Sequence[CurvePoint]) -> float | None:
    """How far any held-out frame has fallen below its own best by a later mark, dB.

    None if no frame was scored twice.
    """
    best: dict[int, float] = {}
    falls: list[float] = []
    for frame, value in (pair for point in curve for pair in point.frames):
        if frame in best:
            falls.append(best[frame] - value)
        best[frame] = max(best.get(frame, value), value)
    return max(0.0, *falls) if falls else None
