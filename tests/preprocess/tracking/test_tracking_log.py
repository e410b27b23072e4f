"""Tests of `preprocess/tracking/tracking_log.py`."""

import numpy as np
import pytest

from preprocess.tracking.keypoints import CroppedMask, PersonKeypoints
from preprocess.tracking.tracking_log import TrackingLog, TrackingProblem, touched_borders

SIZE = (200, 100)


def person(x=100.0, *, radius=10.0, crowded=False):
    """A person who is a disc in a square of 64 pixels around it, at half the frame's resolution."""
    rows, columns = np.mgrid[:64, :64] + 0.5
    disc = np.hypot(rows - 32, columns - 32) < radius / 2
    return PersonKeypoints(
        image_px=np.zeros((33, 2)),
        world_m=np.zeros((33, 3)),
        visibility=np.ones(33),
        presence=1.0,
        mask=CroppedMask(
            values=np.where(disc, 255, 0).astype(np.uint8),
            image_from_crop=np.array([[2.0, 0, x - 64], [0, 2.0, 50 - 64]]),
        ),
        crowded=crowded,
    )


def log_of(*found):
    log = TrackingLog()
    for row, each in enumerate(found):
        log.add(10 + row, each, SIZE)
    return log


def runs(log):
    return [(event.problem, event.first, event.last) for event in log.events()]


def test_a_person_well_inside_the_frame_is_no_problem():
    assert runs(log_of(*[person()] * 5)) == []


@pytest.mark.parametrize(
    ("x", "problem"), [(6.0, TrackingProblem.LEFT), (194.0, TrackingProblem.RIGHT)]
)
def test_a_mask_that_reaches_a_border_touches_it(x, problem):
    assert touched_borders(person(x), SIZE) == {problem}
    inside = 100 + 0.85 * (x - 100)
    assert touched_borders(person(inside), SIZE) == set()


def test_a_mask_as_high_as_the_frame_touches_both_borders():
    both = {TrackingProblem.TOP, TrackingProblem.BOTTOM}
    assert touched_borders(person(radius=51.0), SIZE) == both


def test_frames_with_a_problem_are_runs_and_short_gaps_belong_to_them():
    seen, hidden = person(), None
    log = log_of(hidden, seen, hidden, seen, seen, seen, seen, seen, hidden)
    assert runs(log) == [(TrackingProblem.ABSENT, 10, 12), (TrackingProblem.ABSENT, 18, 18)]
    assert log.share(TrackingProblem.ABSENT) == pytest.approx(1 / 3)


def test_a_person_found_far_from_the_last_place_may_be_another():
    log = log_of(person(40.0), None, person(150.0), person(150.0))
    assert (TrackingProblem.ELSEWHERE, 12, 12) in runs(log)
    near = log_of(person(40.0), None, person(80.0), person(80.0))
    assert (TrackingProblem.ELSEWHERE, 12, 12) not in runs(near)
    assert runs(log_of(None, person(150.0))) == [(TrackingProblem.ABSENT, 10, 10)]


def test_events_are_described_in_seconds():
    log = log_of(*[None] * 9, person(crowded=True))
    absent, crowded = log.events()
    assert absent.describe(10.0) == (
        "The person was out of the picture, or was not found, from 1.0 to 1.8 s."
    )
    assert crowded.describe(10.0).endswith("may be mixed up at 1.9 s.")
