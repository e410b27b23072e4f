"""What went wrong while a person was tracked, as runs of frames, and in words."""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from preprocess.tracking.keypoints import PersonKeypoints

BORDER_SAMPLES = 128
"""Places along each border of a frame at which the mask is read."""
MIN_TOUCHING = 2
"""Places with the person in them that make a touch."""
MAX_GAP = 3
"""Good frames between two bad runs that count as bad, too."""
ELSEWHERE = 0.6
"""Distance from the last place, in sides of the square around the person, that is worth a word."""


class TrackingProblem(Enum):
    """Kinds of frames in which a person's track is missing or doubtful; the value is in words."""

    ABSENT = "The person was out of the picture, or was not found,"
    CROWDED = "Another person was so near that the two may be mixed up"
    ELSEWHERE = "The person was found again in another place: perhaps it is another person,"
    LEFT = "The person touched the picture's left border"
    RIGHT = "The person touched the picture's right border"
    TOP = "The person touched the picture's upper border"
    BOTTOM = "The person touched the picture's lower border"


@dataclass(frozen=True, kw_only=True)
class TrackingEvent:
    """A run of frames with one problem.

    Attributes:
        problem: Its kind.
        first, last: Numbers of its first and last frame.
    """

    problem: TrackingProblem
    first: int
    last: int

    def describe(self, fps: float) -> str:
        """The event in words: "The person was out of the picture, … from 3.2 to 4.0 s."."""
        start, end = (f"{frame / fps:.1f}" for frame in (self.first, self.last))
        when = f"at {start} s" if start == end else f"from {start} to {end} s"
        return f"{self.problem.value} {when}."


class TrackingLog:
    """Collects what a tracker says, frame by frame."""

    def __init__(self) -> None:
        """Starts empty."""
        self._frames: list[int] = []
        self._problems: list[frozenset[TrackingProblem]] = []
        self._last_found: PersonKeypoints | None = None

    def add(self, frame: int, found: PersonKeypoints | None, size_px: tuple[int, int]) -> None:
        """Add the next frame that was tracked.

        Args:
            frame: Its number; later than the one before.
            found: The person in it; None if there was none.
            size_px: Width and height of the frame.
        """
        problems: set[TrackingProblem] = set()
        if found is None:
            problems.add(TrackingProblem.ABSENT)
        else:
            problems |= touched_borders(found, size_px)
            if found.crowded:
                problems.add(TrackingProblem.CROWDED)
            was_absent = bool(self._problems) and TrackingProblem.ABSENT in self._problems[-1]
            if was_absent and self._last_found and has_moved(self._last_found, found):
                problems.add(TrackingProblem.ELSEWHERE)
            self._last_found = found
        self._frames.append(frame)
        self._problems.append(frozenset(problems))

    def events(self) -> list[TrackingEvent]:
        """All runs of frames with a problem, in the order of their beginnings."""
        found = []
        for problem in TrackingProblem:
            rows = np.array([problem in problems for problems in self._problems]).nonzero()[0]
            breaks = np.flatnonzero(np.diff(rows) > MAX_GAP + 1) + 1
            found += [
                TrackingEvent(
                    problem=problem, first=self._frames[run[0]], last=self._frames[run[-1]]
                )
                for run in np.split(rows, breaks)
                if len(run)
            ]
        return sorted(found, key=lambda event: event.first)

    def share(self, problem: TrackingProblem) -> float:
        """Share of the frames that have a problem."""
        return sum(problem in each for each in self._problems) / max(1, len(self._problems))


def touched_borders(found: PersonKeypoints, size_px: tuple[int, int]) -> set[TrackingProblem]:
    """The borders of the frame that a person's mask touches."""
    width, height = size_px
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
