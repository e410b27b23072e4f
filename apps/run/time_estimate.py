"""How long a run takes: where learning stands, and what comes after it.

The constants are core-seconds of a free core at 540 px: of the package as the README has it, of
scoring as docs/evaluation.md has it, rounded up; fitting and report are estimates. What is made of
them is always called "about".
"""

PACKAGING_S = 12.0
"""Baking, fine-tuning, checking and writing a package."""
SCORE_S = 0.3
"""Rendering and scoring one held-out frame of `SCORED_PX`."""
SCORED_PX = 540
POSE_FIT_S = 0.6
"""Fitting the pose of one held-out frame, before it is scored twice."""
REPORT_S = 3.0


def post_training_seconds(
    held_out: int, longer_side_px: int, *, fit_poses: bool, slowdown: float = 1.0
) -> float:
    """Seconds from the last step to the report.

    Args:
        held_out: Frames that will be scored.
        longest_px: Their longer side.
        fitted: Whether poses are fitted to them, too.
        slowed: How many times slower the machine is than a free one.
    """
    scoring = SCORE_S * (longer_side_px / SCORED_PX) ** 2
    each = scoring + (POSE_FIT_S + 2.0 * scoring if fit_poses else 0.0)
    return slowdown * (PACKAGING_S + REPORT_S + held_out * each)


def expected_held_out(frames: int | None, hold_every: int, maximum: int) -> int:
    """How many of a video's frames will be held out, about; `most` if its length is unknown."""
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
    """Where learning stands, and what is still missing once its time is up.

    Args:
        wall_s, budget_s: Seconds that have gone by, and that were given.
        step: Training steps made.
        steps: Steps that were asked for in place of seconds, if they were.
        reading: Frames read so far and in all (None: unknown); None once all are read.
    """
    if steps:
        return f"step {step} of {steps}, {elapsed_s:.0f} s"
    if elapsed_s <= budget_s:
        return f"{elapsed_s:.0f} of {budget_s:g} s, step {step}"
    gone = f"{elapsed_s:.0f} s, more than the {budget_s:g} s that were given"
    if frames_read is None:
        return f"{gone}: the last steps"
    read, total = frames_read
    frames = f"{read} frames" if total is None else f"{read} of {total} frames"
    return f"{gone}, because every frame is trained on at least once: {frames} read, then it ends"
