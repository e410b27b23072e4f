"""What training says while it goes on. Bars, pages, reports and checkpoints listen."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class FrameArrived:
    """The trainer has been given a frame.

    Attributes:
        index: The frame's number in its source.
        held_out: Whether it will be scored instead of learnt from.
    """

    index: int
    held_out: bool


@dataclass(frozen=True, kw_only=True)
class WaitingForFrame:
    """There is nothing to learn from yet; it has been waited for a moment."""


@dataclass(frozen=True, kw_only=True)
class Stepped:
    """A step was made.

    Attributes:
        step: How many there have been.
        wall_seconds: Training time so far.
        loss: Mean of its rays.
        samples_per_ray: Mean of its rays.
        frames_seen: Frames trained on so far.
    """

    step: int
    wall_seconds: float
    loss: float
    samples_per_ray: float
    frames_seen: int


@dataclass(frozen=True, kw_only=True)
class HeldOutScore:
    """How well one held-out frame is rendered, on white.

    Attributes:
        frame: Its index in the source.
        psnr: Of the whole frame, dB.
        psnr_mask: Where alpha > 0.5, dB.
        ssim: In [-1, 1].
        blur: Equivalent blur, as a share of the person's height (`avatar.evaluation.sharpness`); NaN if it
            was not measured.
        overlap: Of the rendered alpha with the mask, in [0, 1]; NaN if it was not measured.
    """

    frame: int
    psnr: float
    psnr_mask: float
    ssim: float
    blur: float = math.nan
    overlap: float = math.nan


@dataclass(frozen=True, kw_only=True)
class Evaluated:
    """Held-out frames that have arrived so far were scored.

    Attributes:
        wall_seconds, cpu_seconds: Training time so far.
        frames_seen: Frames trained on so far.
        scores: One a frame.
    """

    wall_seconds: float
    cpu_seconds: float
    frames_seen: int
    scores: tuple[HeldOutScore, ...]


@dataclass(frozen=True, kw_only=True)
class Warned:
    """Something the user should know, and that does not stop the run."""

    message: str


@dataclass(frozen=True, kw_only=True)
class Finished:
    """The last step was made.

    Attributes:
        wall_seconds, cpu_seconds: Training time.
        steps, rays, samples: How much was done.
    """

    wall_seconds: float
    cpu_seconds: float
    steps: int
    rays: int
    samples: int


TrainEvent = FrameArrived | WaitingForFrame | Stepped | Evaluated | Warned | Finished
