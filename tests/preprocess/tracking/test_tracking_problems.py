"""Frames at the picture's border, among others, or after a loss are found to be doubtful."""

from dataclasses import replace

import numpy as np
import pytest

from preprocess.tracking.keypoints import CroppedMask, PersonKeypoints
from preprocess.tracking.video_tracking import (
    ProblemFinder,
    TrackingProblem,
    touched_borders,
)

SIZE = (200, 100)


def person(x=100.0, *, radius=10.0, crowded=False):
    """A person who is a disc in a square of 64 pixels around it, at half the frame's resolution."""
    rows, columns = np.mgrid[:64, :64] + 0.5
    disc = np.hypot(rows - 32, columns - 32) < radius / 2
    return PersonKeypoints(
        image_px=np.array([x, 50.0])
        + radius * np.resize([[-1, 0], [1, 0], [0, -1], [0, 1]], (33, 2)),
        world_m=np.zeros((33, 3)),
        visibility=np.ones(33),
        presence=1.0,
        mask=CroppedMask(
            values=np.where(disc, 255, 0).astype(np.uint8),
            image_from_crop=np.array([[2.0, 0, x - 64], [0, 2.0, 50 - 64]]),
        ),
        crowded=crowded,
    )


def problems_of(*found):
    finder = ProblemFinder()
    return [set(finder.problems(each, SIZE)) for each in found]


def test_a_person_well_inside_the_frame_is_no_problem():
    assert problems_of(*[person()] * 3) == [set()] * 3


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


def test_shoes_that_touch_the_border_cut_nothing_off():
    standing = person(radius=51.0)
    ankles = np.clip(standing.image_px, None, [np.inf, 85.0])  # 15 px above the lower border
    touched = touched_borders(replace(standing, image_px=ankles), SIZE)
    assert touched == {TrackingProblem.TOP}


def test_a_person_found_far_from_the_last_place_may_be_another():
    far = problems_of(person(40.0), None, person(150.0), person(150.0))
    assert far == [set(), set(), {TrackingProblem.ELSEWHERE}, set()]
    assert problems_of(person(40.0), None, person(80.0)) == [set()] * 3
    assert problems_of(None, person(150.0)) == [set()] * 2


def test_another_person_nearby_is_a_problem():
    assert problems_of(person(crowded=True)) == [{TrackingProblem.CROWDED}]
