"""Time estimates of a run: progress of training, and duration of what follows it.

Durations are core-seconds of an idle core, rounded up: packaging as measured for the README,
scoring as measured for docs/evaluation.md, pose fitting and report as rough estimates.
"""

import math

PACKAGING_S = 12.0
"""Baking, fine-tuning, checking and writing a package, seconds."""
SCORE_S = 0.3
"""Rendering and scoring one held-out frame of `SCORED_PX`, seconds."""
SCORED_PX = 540
"""Longer side of the frame that `SCORE_S` was measured with, pixels."""
POSE_FIT_S = 0.6
"""Fitting the pose of one held-out frame, without the two scorings, seconds."""
REPORT_S = 3.0
"""Drawing and writing the report, seconds."""


def post_training_seconds(
    held_out: int,
    longer_side_px: int,
    *,
    fit_poses: bool,
    slowdown: float = 1.0,
    scoring_limit_s: float = math.inf,
) -> float:
    """Estimate the seconds from the last step to the report.

    Args:
        held_out: Number of frames to score.
        longer_side_px: Their longer side.
        fit_poses: Whether poses are fitted to them as well.
        slowdown: Factor by which the machine is slower than an idle one.
        scoring_limit_s: Seconds after which no more frames are scored.
    """
    scoring = SCORE_S * (longer_side_px / SCORED_PX) ** 2
    each = scoring + (POSE_FIT_S + scoring if fit_poses else 0.0)
    return slowdown * (PACKAGING_S + REPORT_S) + min(slowdown * held_out * each, scoring_limit_s)


def expected_held_out(frames: int | None, hold_every: int, maximum: int) -> int:
    """Estimate the number of held-out frames; `maximum` if the video's length is unknown."""
    if hold_every == 0:
        return 0
    return maximum if frames is None else min(maximum, max(1, frames // hold_every))


def describe_position(
    *,
    elapsed_s: float,
    budget_s: float,
    step: int,
    steps: int | None,
    frames_read: tuple[int, int | None] | None,
) -> str:
    """Describe the progress of training, and what remains once its time is up.

    Args:
        elapsed_s: Training time up to now.
        budget_s: Training time requested.
        step: Training steps made.
        steps: Training steps requested instead of a time; None otherwise.
        frames_read: Frames read up to now and in total (None: unknown); None once all are read.
    """
    if steps:
        return f"step {step} of {steps}, {elapsed_s:.0f} s"
    if elapsed_s <= budget_s:
        return f"{elapsed_s:.0f} of {budget_s:g} s, step {step}"
    elapsed = f"{elapsed_s:.0f} s (limit {budget_s:g} s)"
    if frames_read is None:
        return f"{elapsed}: last steps"
    read, total = frames_read
    frames = f"{read} frames" if total is None else f"{read} of {total} frames"
    return f"{elapsed}: finishing the first pass over the video, {frames} read"
