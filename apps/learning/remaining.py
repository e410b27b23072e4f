"""How long a run takes: where learning stands, and what comes after it.

The constants are core-seconds of a free core at 540 px: of the package as the README has it, of
scoring as docs/evaluation.md has it, rounded up; fitting and report are estimates. What is made of
them is always called "about".
"""

PACKAGE_S = 12.0
"""Baking, fine-tuning, checking and writing a package."""
SCORE_S = 0.3
"""Rendering and scoring one held-out frame of `SCORED_PX`."""
SCORED_PX = 540
FIT_S = 0.6
"""Fitting the pose of one held-out frame, before it is scored twice."""
REPORT_S = 3.0


def after_learning_s(held_out: int, longest_px: int, *, fitted: bool, slowed: float = 1.0) -> float:
    """Seconds from the last step to the report.

    Args:
        held_out: Frames that will be scored.
        longest_px: Their longer side.
        fitted: Whether poses are fitted to them, too.
        slowed: How many times slower the machine is than a free one.
    """
    scoring = SCORE_S * (longest_px / SCORED_PX) ** 2
    each = scoring + (FIT_S + 2.0 * scoring if fitted else 0.0)
    return slowed * (PACKAGE_S + REPORT_S + held_out * each)


def held_out_of(frames: int | None, every: int, most: int) -> int:
    """How many of a video's frames will be held out, about; `most` if its length is unknown."""
    if every == 0:
        return 0
    return most if frames is None else min(most, max(1, frames // every))


def how_far(
    *,
    wall_s: float,
    given_s: float,
    step: int,
    steps: int | None,
    reading: tuple[int, int | None] | None,
) -> str:
    """Where learning stands, and what is still missing once its time is up.

    Args:
        wall_s, given_s: Seconds that have gone by, and that were given.
        step: Training steps made.
        steps: Steps that were asked for in place of seconds, if they were.
        reading: Frames read so far and in all (None: unknown); None once all are read.
    """
    if steps:
        return f"step {step} of {steps}, {wall_s:.0f} s"
    if wall_s <= given_s:
        return f"{wall_s:.0f} of {given_s:g} s, step {step}"
    gone = f"{wall_s:.0f} s, more than the {given_s:g} s that were given"
    if reading is None:
        return f"{gone}: the last steps"
    read, total = reading
    frames = f"{read} frames" if total is None else f"{read} of {total} frames"
    return f"{gone}, because every frame is trained on at least once: {frames} read, then it ends"
