"""What makes a frame's track doubtful: borders of the picture, and other persons."""

from enum import Enum
from typing import final

import numpy as np

from preprocess.tracking.keypoints import PersonKeypoints

BORDER_SAMPLES = 128
"""Places along each border of a frame at which the mask is read."""
MIN_TOUCHING = 2
"""Places with the person in them that make a touch."""
BODY_POINTS = (0, 7, 8, *range(11, 17), *range(23, 29))
"""Key points of the body, without fingers, heels and toes."""
CUT_MARGIN = 0.05
"""Distance of a key point of the body from a border within which the person is cut there, person
heights. Shoes and fingertips that touch a border are farther: they cut nothing off."""
ELSEWHERE = 0.6
"""Distance from the last place, in sides of the square around the person, that is worth a word."""


class TrackingProblem(Enum):
    """Kinds of doubtful frames; the value is what a user reads."""

    CROWDED = "another person is so near that the two may be mixed up"
    ELSEWHERE = "the person was found again in another place, perhaps it is another person"
    LEFT = "the person is cut by the picture's left border"
    RIGHT = "the person is cut by the picture's right border"
    TOP = "the person is cut by the picture's upper border"
    BOTTOM = "the person is cut by the picture's lower border"


PROBLEM_BITS = {problem: 1 << place for place, problem in enumerate(TrackingProblem)}
"""The bit of each problem in the numbers that files hold."""


@final
class ProblemFinder:
    """Finds the problems of a track, frame by frame."""

    def __init__(self) -> None:
        """Starts without frames."""
        self._last_found: PersonKeypoints | None = None
        self._is_absent = False

    def problems(
        self, found: PersonKeypoints | None, size_px: tuple[int, int]
    ) -> frozenset[TrackingProblem]:
        """The problems of the next frame.

        Args:
            found: The person in it; None if there was none.
            size_px: Width and height of the frame.
        """
        if found is None:
            self._is_absent = True
            return frozenset()
        problems = touched_borders(found, size_px)
        if found.crowded:
            problems.add(TrackingProblem.CROWDED)
        if self._is_absent and self._last_found and has_moved(self._last_found, found):
            problems.add(TrackingProblem.ELSEWHERE)
        self._last_found, self._is_absent = found, False
        return frozenset(problems)


def touched_borders(found: PersonKeypoints, size_px: tuple[int, int]) -> set[TrackingProblem]:
    """The borders of the frame that cut a person: the mask touches them, key points are near."""
    width, height = size_px
    body = found.image_px[list(BODY_POINTS)]
    low_xy, high_xy = body.min(axis=0), body.max(axis=0)
    margin = CUT_MARGIN * float(np.ptp(found.image_px, axis=0).max())
    near = {
        TrackingProblem.LEFT: low_xy[0] < margin,
        TrackingProblem.RIGHT: high_xy[0] > width - margin,
        TrackingProblem.TOP: low_xy[1] < margin,
        TrackingProblem.BOTTOM: high_xy[1] > height - margin,
    }
    crop_from_image = np.linalg.inv(np.vstack([found.mask.image_from_crop, [0, 0, 1]]))[:2]
    inset = np.hypot(*found.mask.image_from_crop[:, 0])  # one of the mask's own pixels
    along = (np.arange(BORDER_SAMPLES) + 0.5) / BORDER_SAMPLES
    low, high = np.full(BORDER_SAMPLES, inset), np.ones(BORDER_SAMPLES)
    lines = {
        TrackingProblem.LEFT: (low, along * height),
        TrackingProblem.RIGHT: (high * width - inset, along * height),
        TrackingProblem.TOP: (along * width, low),
        TrackingProblem.BOTTOM: (along * width, high * height - inset),
    }
    rows, columns = found.mask.values.shape
    touched = set()
    for problem, (x, y) in lines.items():
        if not near[problem]:
            continue
        column, row = np.floor(crop_from_image @ np.array([x, y, high])).astype(int)
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        if (found.mask.values[row[inside], column[inside]] > 127).sum() >= MIN_TOUCHING:
            touched.add(problem)
    return touched


def has_moved(before: PersonKeypoints, after: PersonKeypoints) -> bool:
    """Whether two squares around a person are far from each other."""
    middles = []
    for found in (before, after):
        rows, columns = found.mask.values.shape
        middles.append(found.mask.image_from_crop @ [columns / 2, rows / 2, 1])
    side = before.mask.values.shape[1] * np.hypot(*before.mask.image_from_crop[:, 0])
    return bool(np.hypot(*(middles[1] - middles[0])) > ELSEWHERE * side)
