"""This project's own tracker: BlazePose's two networks, and the following of one person.

The detector finds persons in a frame. From then on the square for the next frame comes from the
key points of this one, and the detector is needed only when the person is lost.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import UInt8

from capture.input_error import InputError
from preprocess.tracking.blazepose_detector import BlazePoseDetector, PersonDetection
from preprocess.tracking.blazepose_landmarks import BlazePoseLandmarks, FoundLandmarks
from preprocess.tracking.keypoints import PersonKeypoints
from preprocess.tracking.person_square import PersonSquare

MIN_PRESENCE = 0.5
"""Least probability of a person in the square; below it the person is lost."""
MAX_STEP = 0.2
"""Farthest that a person moves in one frame, in sides of the square; farther is someone else."""
MAX_GROWTH = 1.4
"""Most that a person grows or shrinks in the picture in one frame."""
MAX_STEP_AFTER_LOSS = 0.1
"""How much farther than `MAX_STEP` a lost person may be, for each frame since."""
SEARCH_SIDE = 1.5
"""Side of the area around the last place that is searched, in sides of the person's square."""


@dataclass(frozen=True, kw_only=True)
class LastPlace:
    """Where the person was when it was seen last.

    Attributes:
        square: The person's square.
        frames_ago: Frames since then.
    """

    square: PersonSquare
    frames_ago: int = 1

    def strangeness(self, square: PersonSquare) -> float:
        """How unlikely it is that a square shows the same person; above 1 it does not."""
        reach = MAX_STEP + MAX_STEP_AFTER_LOSS * (self.frames_ago - 1)
        step = np.hypot(square.x - self.square.x, square.y - self.square.y) / self.square.side
        growth = abs(np.log(square.side / self.square.side)) / np.log(MAX_GROWTH)
        return max(float(step) / reach, float(growth) * MAX_STEP / reach)


class BlazePoseTracker:
    """Follows one person through the frames of a video."""

    def __init__(self, person: int | None = None) -> None:
        """Loads the networks.

        Args:
            person: Whom to follow, counted from left to right from 1, in the first frame that
                shows so many; the largest one if it is not given.

        Raises:
            InputError: If that number is below 1.
        """
        if person is not None and person < 1:
            raise InputError(f"--person {person}: persons are counted from 1, the leftmost one.")
        self._detect = BlazePoseDetector()
        self._find_landmarks = BlazePoseLandmarks()
        self._person = person
        self._last: LastPlace | None = None

    def __call__(self, rgb: UInt8[np.ndarray, "height width 3"]) -> PersonKeypoints | None:
        """Find the person in the next frame; None where there is none."""
        found = self._follow(rgb) or self._find(rgb)
        if found is not None:
            self._last = LastPlace(square=found.square)
            return found.keypoints
        if self._last is not None:
            self._last = replace(self._last, frames_ago=self._last.frames_ago + 1)
        return None

    def _follow(self, rgb: UInt8[np.ndarray, "height width 3"]) -> FoundLandmarks | None:
        """The person, where the last frame's key points say; None if it is not there."""
        if self._last is None or self._last.frames_ago > 1:
            return None
        return self._accept(self._find_landmarks(rgb, self._last.square))

    def _accept(self, found: FoundLandmarks) -> FoundLandmarks | None:
        """What was found, if it is a person, and the same one as before."""
        if found.keypoints.presence < MIN_PRESENCE:
            return None
        if self._last is not None and self._last.strangeness(found.square) > 1:
            return None
        return found

    def _find(self, rgb: UInt8[np.ndarray, "height width 3"]) -> FoundLandmarks | None:
        """The person, found by the detector; None if it is nowhere."""
        for detection in self._candidates(rgb):
            # The detector's square is rough; the key points found in it give a better one.
            rough = self._find_landmarks(rgb, detection.square)
            if rough.keypoints.presence < MIN_PRESENCE:
                continue
            found = self._accept(self._find_landmarks(rgb, rough.square))
            if found is not None:
                return found
        return None

    def _candidates(self, rgb: UInt8[np.ndarray, "height width 3"]) -> list[PersonDetection]:
        """Detections that may be the person, the most likely one first."""
        last = self._last
        if last is None:
            return self._choose(self._search(rgb))
        around = replace(last.square, side=SEARCH_SIDE * last.square.side, angle=0.0)
        for detections in (self._detect(rgb), self._detect(rgb, around)):
            likely = [each for each in detections if last.strangeness(each.square) <= 1]
            if likely:
                return sorted(likely, key=lambda each: last.strangeness(each.square))
        return []

    def _choose(self, detections: list[PersonDetection]) -> list[PersonDetection]:
        """The person to follow, of those in a frame; none if it is not there yet."""
        if self._person is None:
            return sorted(detections, key=lambda each: -each.square.side)
        from_left = sorted(detections, key=lambda each: each.square.x)
        return from_left[self._person - 1 : self._person]

    def _search(self, rgb: UInt8[np.ndarray, "height width 3"]) -> list[PersonDetection]:
        """All persons in a frame."""
        return self._detect(rgb)
