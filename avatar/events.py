"""Events of a training run, for progress bars, pages, reports and checkpoints."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class FrameArrived:
    """A frame has reached the trainer, by its index in the source; held out, it is only scored."""

    index: int
    held_out: bool


@dataclass(frozen=True, kw_only=True)
class FrameLeftOut:
    """A frame that cannot be used; `reason` says why, in a few words."""

    index: int
    reason: str


@dataclass(frozen=True, kw_only=True)
class WaitingForFrame:
    """No frame has arrived yet; the trainer has waited for a moment."""


@dataclass(frozen=True, kw_only=True)
class Stepped:
    """A training step has been made; `step`, `wall_seconds` and `frames_seen` are totals so far."""

    step: int
    wall_seconds: float
    loss: float
    samples_per_ray: float
    frames_seen: int


@dataclass(frozen=True, kw_only=True)
class HeldOutScore:
    """Quality of one rendered held-out frame, on white.

    Attributes:
        psnr: Of the whole frame, as is `ssim`; dB.
        psnr_mask: PSNR where alpha > 0.5, dB.
        blur: Equivalent blur, as a share of the person's height (`image_metrics`); NaN if not
            measured.
        overlap: Soft IoU of the rendered alpha and the mask, in [0, 1]; NaN if not measured.
    """

    frame: int
    psnr: float
    psnr_mask: float
    ssim: float
    blur: float = math.nan
    overlap: float = math.nan


@dataclass(frozen=True, kw_only=True)
class Evaluated:
    """The held-out frames that have arrived so far have been scored, at a point of the training."""

    wall_seconds: float
    cpu_seconds: float
    frames_seen: int
    scores: tuple[HeldOutScore, ...]


@dataclass(frozen=True, kw_only=True)
class Warned:
    """A message for the user that does not stop the run."""

    message: str


@dataclass(frozen=True, kw_only=True)
class Presentable:
    """A user waits, and the avatar could be shown, though a second of training is left."""


@dataclass(frozen=True, kw_only=True)
class Finished:
    """The last step has been made; numbers are totals of the training."""

    wall_seconds: float
    cpu_seconds: float
    steps: int
    rays: int
    samples: int


TrainEvent = (
    FrameArrived | FrameLeftOut | WaitingForFrame | Stepped | Evaluated | Warned | Presentable
    | Finished
)  # fmt: skip
