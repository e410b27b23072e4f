"""The first look at a recording: what a few frames show before minutes are spent on all of them.

Is the person upright, alone, whole and lit, and does the camera stand still? Answers come with the
number of frames that they rest on.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import final

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from capture.source import Frame, FrameSource, RgbImage
from capture.source_opening import glance
from preprocess.masks.color_models import DARK_LEVEL, DarkFilmBrightener
from preprocess.tracking.blazepose import distance_in_sides, find_persons
from preprocess.tracking.blazepose_networks import (
    BlazePoseDetector,
    BlazePoseLandmarks,
    FoundLandmarks,
    PersonSquare,
)
from preprocess.tracking.keypoints import MIN_PRESENCE
from preprocess.tracking.video_tracking import TrackingProblem, touched_borders

GrayPicture = UInt8[np.ndarray, "rows columns"]
"""A reduced image, or a mask of it."""

CELL_PX = 24
"""Side of the squares of which each has one corner that is followed, px: all parts of the picture
count alike, however much stronger a title's corners are."""
MIN_CORNERS = 12
"""Fewest corners of the background of which a motion is believed."""
STILL_SHARE = 0.01
"""Most that the background shifts from place to place before a camera that stands, longer sides."""


class CameraMotion(Enum):
    """Kinds of camera motion; the value is what a user reads."""

    STILL = "the camera stands still"
    HELD = "the camera is held in the hand"
    TURNS = "the camera turns on the spot"
    WALKS = "the camera is carried around"
    MOVES = "the camera moves"


@dataclass(frozen=True, kw_only=True)
class FirstLook:
    """What a few frames, evenly spread over a recording, show.

    Attributes:
        frames: Number of places that were looked at; of them
        found: those that show a person,
        rotations: by the degrees clockwise that would turn the largest one upright,
        crowded: those that show another person nearly as large,
        cut: and those in which a border of the image cuts the person, by border.
        level: Brightness of the lightest parts, 98th percentile, 0 to 255.
        motion: How the camera moves; None if the background shows too few corners.
        shift: Largest shift of the background from one place to the next, or where it cannot be
            followed so far, from one frame to one 0.2 s later; longer sides.
    """

    frames: int
    found: int
    rotations: Mapping[int, int]
    crowded: int
    cut: Mapping[TrackingProblem, int]
    level: float
    motion: CameraMotion | None
    shift: float

    @property
    def rotation(self) -> int:
        """Degrees clockwise that would turn the person upright in most of the frames."""
        return max(self.rotations, key=lambda degrees: self.rotations[degrees], default=0)

    def describe(self) -> str:
        """All in one sentence, for people."""
        if not self.found:
            return f"First look at {self.frames} frames: no person was found in them."
        parts = [f"a person in {self.found}"]
        parts.append("another one beside it" if self.crowded else "no other person")
        parts.append("cut by a border" if self.cut else "from head to feet")
        if self.motion is not None:
            parts.append(self.motion.value)
        return f"First look at {self.frames} frames: {', '.join(parts)}."

    def advice(self, *, tracks: bool = True, has_cameras: bool = False) -> Iterator[str]:
        """What is wrong or limited, and what can be done, for people.

        `tracks` means that no poses are given; `has_cameras`, that cameras are, or are solved.
        """
        of = f"of {self.found} frames"
        if self.rotation:
            side = "head down" if self.rotation == 180 else "on its side"
            yield (
                f"The person is {side} in {self.rotations[self.rotation]} {of}. If the video is "
                f"turned, add --rotate {self.rotation}: else the avatar is turned, too."
            )
        if self.crowded:
            followed = "The one whom the poses follow is learnt"
            if tracks:
                followed = "The larger one is followed, or the one that --person names"
            yield (
                f"Another person is in {self.crowded} {of}. {followed}; frames in which they are "
                "near each other may be lost."
            )
        for border, count in self.cut.items():
            what = f"{border.value} in {count} {of}".capitalize()
            most = "If so in most of the video, it is refused: film again, or choose --frames."
            is_refused = tracks and 2 * count > self.found
            yield f"{what}. {most if is_refused else 'What is outside is a guess.'}"
        if self.level < DARK_LEVEL:
            found = "It is brightened to find the person; the" if tracks else "The"
            yield (
                f"The film is dark: its lightest parts reach {self.level:.0f} of 255. {found} "
                "avatar will be as dark, and noisy."
            )
        if not has_cameras:
            yield from self._camera_advice(tracks=tracks)

    def _camera_advice(self, *, tracks: bool) -> Iterator[str]:
        shift = f"its background shifts by up to {self.shift:.0%} of the longer side in 0.2 s"
        solved = {
            CameraMotion.WALKS: "its way",
            CameraMotion.TURNS: "how it turns, and its focal length",
            CameraMotion.MOVES: "how it moves",
        }
        if self.motion in solved:
            poses = "Poses are found for" if tracks else "Poses must be in"
            yield (
                f"{self.motion.value.capitalize()} ({shift}). {poses} each frame's own camera; "
                f"--cameras solve finds {solved[self.motion]}, too, if the background has "
                "structure."
            )


def look_at(source: FrameSource) -> FirstLook:
    """Look at a few frames of a recording; nothing else of it is decoded."""
    pairs, finder, brighten = glance(source), PersonFinder(), DarkFilmBrightener()
    first = [pair[0] for pair in pairs]
    seen = [finder.find(brighten(frame.rgb)) for frame in first]
    found = [each for each in seen if each.persons]
    cut: Counter[TrackingProblem] = Counter()
    for each in found:
        cut.update(touched_borders(each.persons[0].keypoints, each.size_px))
    masks = [each.background() for each in seen]
    motion, shift = camera_motion(pairs, masks)
    return FirstLook(
        frames=len(first),
        found=len(found),
        rotations=Counter(each.rotation for each in found),
        crowded=sum(len(each.persons) > 1 for each in found),
        cut=cut,
        level=max((float(np.percentile(frame.rgb, 98)) for frame in first), default=0.0),
        motion=motion,
        shift=shift,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Glimpse:
    """The persons of one frame, the largest first, and the turn that makes that one upright."""

    size_px: tuple[int, int]
    persons: Sequence[FoundLandmarks]
    rotation: int

    def background(self) -> UInt8[np.ndarray, "height width"]:
        """255 off the persons, 0 on them, at the frame's size."""
        mask = np.full(self.size_px[::-1], 255, np.uint8)
        for each in self.persons:
            points = each.keypoints.image_px
            margin = 0.1 * float(np.ptp(points, axis=0).max())
            low = np.clip(points.min(axis=0) - margin, 0.0, None).astype(int)
            high = np.clip(points.max(axis=0) + margin, 0.0, None).astype(int)
            mask[low[1] : high[1], low[0] : high[0]] = 0
        return mask


@final
class PersonFinder:
    """Finds the persons of single frames, whichever way up they are."""

    def __init__(self) -> None:
        """Load the networks."""
        self._detect, self._landmarks = BlazePoseDetector(), BlazePoseLandmarks()

    def find(self, rgb: RgbImage) -> _Glimpse:
        """Find the persons; where none is upright, also in the frame turned by 90 degrees."""
        persons = self.persons(rgb)
        upright = [each for each in persons if _rotation(each) == 0]
        rotation = 0
        if not upright:
            turned = [(k, self.persons(np.ascontiguousarray(np.rot90(rgb, -k)))) for k in (1, 2, 3)]
            best, surest = max(
                ((k, max((e.keypoints.presence for e in each if not _rotation(e)), default=0.0))
                 for k, each in turned), key=lambda pair: pair[1],
            )  # fmt: skip
            rotation = 90 * best if surest > MIN_PRESENCE else 0
        return _Glimpse(size_px=(rgb.shape[1], rgb.shape[0]), persons=persons, rotation=rotation)

    def follow(self, rgb: RgbImage, square: PersonSquare | None) -> FoundLandmarks | None:
        """Find the person where it was in an earlier frame, else the largest one."""
        if square is not None:
            found = self._landmarks(rgb, square)
            change = abs(np.log(found.square.side / square.side))
            if distance_in_sides(square, found.square) + change > 0.1:
                found = self._landmarks(rgb, found.square)
            if found.keypoints.presence >= MIN_PRESENCE:
                return found
        return next(iter(self.persons(rgb)), None)

    def persons(self, rgb: RgbImage) -> list[FoundLandmarks]:
        """Find the largest person and others nearly as large, the largest first."""
        squares = [each.square for each in find_persons(rgb, self._detect, self._landmarks)]
        persons = [self._landmarks(rgb, square) for square in squares]
        persons.sort(key=lambda each: -each.square.side)
        return [
            each
            for each in persons
            if each.keypoints.presence >= MIN_PRESENCE
            and each.square.side > 0.5 * persons[0].square.side
        ]


def _rotation(found: FoundLandmarks) -> int:
    """Degrees clockwise, a multiple of 90, that turn a person about upright."""
    return -90 * round(found.square.angle / (np.pi / 2)) % 360


def camera_motion(
    pairs: Sequence[tuple[Frame, Frame]], backgrounds: Sequence[UInt8[np.ndarray, "height width"]]
) -> tuple[CameraMotion | None, float]:
    """How the camera moves, by corners of the background, and the largest shift of these.

    Pairs are frames soon after one another; `backgrounds` is 255 where the first shows background.
    """
    grays = [[_reduced_gray(frame.rgb) for frame in pair] for pair in pairs]
    masks = [
        cv2.resize(mask, gray[0].shape[::-1], interpolation=cv2.INTER_NEAREST)
        for mask, gray in zip(backgrounds, grays, strict=True)
    ]
    far = [
        _shift(one[0], other[0], cv2.bitwise_and(mask, next_mask))
        for one, other, mask, next_mask in zip(grays, grays[1:], masks, masks[1:], strict=False)
    ]
    near = [_shift(one, other, mask) for (one, other), mask in zip(grays, masks, strict=True)]
    followed = [each for each in near if each is not None]
    if len(followed) < max(2, len(pairs) // 2):
        return None, 0.0
    stays = [each.share for each in far if each is not None and each.share < 0.08]
    if 2 * len(stays) > len(far):  # some places are hidden by the person
        shift = max(stays)
        return CameraMotion.STILL if shift < STILL_SHARE else CameraMotion.HELD, shift
    # smaller shifts do not tell turning from walking
    planes = [each.plane for each in followed if each.share > 0.02]
    shift = max(each.share for each in followed)
    # a background too plain to be recognized from far; 0.001 is half a pixel, a hand trembles more
    if max(stays, default=0.0) < STILL_SHARE and shift < 0.001:
        return CameraMotion.STILL, shift
    one_plane = float(np.median(planes)) if len(planes) > 1 else 0.8  # share of the corners in it
    if one_plane >= 0.9:
        return CameraMotion.TURNS, shift
    return CameraMotion.WALKS if one_plane <= 0.75 else CameraMotion.MOVES, shift


@dataclass(frozen=True, kw_only=True)
class _Shift:
    """Median shift of corners in longer sides, and the share of them that move as one plane."""

    share: float
    plane: float


def _reduced_gray(rgb: RgbImage) -> GrayPicture:
    scale = min(1.0, 480 / max(rgb.shape[:2]))
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def _corners(gray: GrayPicture, mask: GrayPicture) -> Float32[np.ndarray, "corners 1 2"]:
    """The sharpest corner of each square of the background that has one, (column, row)."""
    sharpness = np.where(mask > 0, cv2.cornerMinEigenVal(gray, blockSize=3), 0.0)
    corners = []
    for top in range(0, gray.shape[0], CELL_PX):
        for left in range(0, gray.shape[1], CELL_PX):
            cell = sharpness[top : top + CELL_PX, left : left + CELL_PX]
            row, column = np.unravel_index(cell.argmax(), cell.shape)
            if 255.0 / 2.0 * np.sqrt(cell[row, column]) > 1.5:  # levels a pixel; noise is below
                corners.append((left + column, top + row))
    return np.array(corners, np.float32).reshape(-1, 1, 2)


def _shift(one: GrayPicture, other: GrayPicture, mask: GrayPicture) -> _Shift | None:
    """The motion of the background between two images; None if it cannot be followed."""
    corners = _corners(one, mask)
    if len(corners) < MIN_CORNERS:
        return None
    moved, ahead, _ = cv2.calcOpticalFlowPyrLK(one, other, corners, corners.copy(), maxLevel=4)
    back, behind, _ = cv2.calcOpticalFlowPyrLK(other, one, moved, moved.copy(), maxLevel=4)
    is_same = (ahead.ravel() > 0) & (behind.ravel() > 0)
    is_same &= np.abs(back - corners).max(axis=(1, 2)) < 1.0
    start: Float[np.ndarray, "corners 2"] = corners[is_same, 0]
    end: Float[np.ndarray, "corners 2"] = moved[is_same, 0]
    if len(start) < max(MIN_CORNERS, len(corners) // 4):
        return None
    _, inliers = cv2.findHomography(start, end, cv2.RANSAC, 1.0)
    return _Shift(
        share=float(np.median(np.linalg.norm(end - start, axis=1))) / max(one.shape),
        plane=0.0 if inliers is None else float(inliers.mean()),
    )
