"""Tracks the person of a recording: key points in memory, masks as images in a folder.

Networks run on one thread; masks are refined and written on another, so two cores are busy. Frames
in which borders of the image or other persons make the track doubtful are marked.
"""

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Protocol, final, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32, Int

from capture.input_error import InputError
from capture.source import FrameSource, RgbImage
from preprocess.plugins import PersonTracker
from preprocess.tracking.keypoints import CroppedMask, KeypointTrack, PersonKeypoints

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
MIN_FOUND = 8
"""Fewest frames in which the person must be found; 4 of fewer than 16 frames."""
FRAMES_REFINED_AGAIN = 60
"""First frames whose masks are made again in the end, when the background behind them is known."""
APPROACH_FRAMES = 4
"""Frames before another person is seen to be near in which it may have come near."""
QUEUED_MASKS = 8
"""Most masks that wait to be written."""


class TrackingProblem(Enum):
    """Kinds of doubtful frames; the value is what a user reads."""

    CROWDED = "another person is so near that the two may be mixed up"
    ELSEWHERE = "the person was found again in another place, perhaps it is another person"
    LEFT = "the person is cut by the picture's left border"
    RIGHT = "the person is cut by the picture's right border"
    TOP = "the person is cut by the picture's upper border"
    BOTTOM = "the person is cut by the picture's lower border"


NOT_FOUND, ANOTHER_NEAR = "person not found", "another person near"
DISAGREEING = "body and mask that disagree"
"""Reasons for which tracked frames are not learnt from."""
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
        """Find the problems of the next frame; a frame without the person has none."""
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
    """Check whether the squares around a person in two frames are far from each other."""
    middles = []
    for found in (before, after):
        rows, columns = found.mask.values.shape
        middles.append(found.mask.image_from_crop @ [columns / 2, rows / 2, 1])
    side = before.mask.values.shape[1] * np.hypot(*before.mask.image_from_crop[:, 0])
    return bool(np.hypot(*(middles[1] - middles[0])) > ELSEWHERE * side)


@runtime_checkable
class MaskRefinement(Protocol):
    """Makes the mask of a frame from a network's coarse one, frame by frame, in order."""

    def __call__(
        self, rgb: RgbImage, mask: CroppedMask, size_px: tuple[int, int]
    ) -> Float32[np.ndarray, "rows columns"]:
        """Estimate how far each pixel is person, in [0, 1], at a size."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedVideo:
    """Key points of a recording, and the times of all frames that were looked at, by their numbers.

    `interrupted` tells that tracking was stopped before the last frame.
    """

    keypoints: KeypointTrack
    frame_times_s: dict[int, float]
    interrupted: bool


def track_video(
    source: FrameSource,
    tracker: PersonTracker,
    refine: MaskRefinement,
    mask_folder: Path | None,
    *,
    advance: Callable[[int], None] = lambda done: None,
    stop: threading.Event | None = None,
    before: TrackedVideo | None = None,
) -> TrackedVideo:
    """Find the person in each wanted frame of a recording.

    Args:
        mask_folder: Existing folder for a mask of every frame, an empty one where the person was
            not found; None writes none.
        advance: Called with the number of frames done.
        stop: Ends tracking early once it is set; what was found until then is returned.
        before: Result for the frames before those of `source`; it is returned with the rest.
    """
    frames, problems = list[int](), list[int]()
    found: list[PersonKeypoints] = []
    finder, times = ProblemFinder(), dict[int, float]()
    waiting: list[Future[None]] = []
    interrupted = False
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="masks") as pool:
        for frame in source.frames():
            if stop is not None and stop.is_set():
                interrupted = True
                break
            person = None if "corrupt" in frame.flags else tracker(frame.rgb)
            times[frame.index] = frame.time_s
            seen = finder.problems(person, source.size_px)
            if person is not None:
                frames.append(frame.index)
                found.append(person)
                problems.append(sum(PROBLEM_BITS[each] for each in seen))
            if mask_folder is not None:
                path = _mask_path(mask_folder, frame.index)
                waiting.append(pool.submit(_write_mask, path, frame.rgb, person, refine))
            while len(waiting) > QUEUED_MASKS or (waiting and waiting[0].done()):
                waiting.pop(0).result()
            advance(len(times))
        for each in waiting:
            each.result()
    if mask_folder is not None and not interrupted:
        first = dict(zip(frames[:FRAMES_REFINED_AGAIN], found, strict=False))
        _refine_again(source, first, refine, mask_folder)
    track = KeypointTrack.of(frames, found, source.size_px, [times[number] for number in frames])
    track = replace(track, problems=_mark_approach(np.array(problems, dtype=np.int64)))
    if before is not None:
        track, times = before.keypoints.join(track), before.frame_times_s | times
    _require_person(source, len(track), len(times))
    return TrackedVideo(keypoints=track, frame_times_s=times, interrupted=interrupted)


def _mark_approach(problems: Int[np.ndarray, "rows"]) -> Int[np.ndarray, "rows"]:
    """Mark frames right before others are seen to be near, too: not every frame is searched."""
    crowded = (problems & PROBLEM_BITS[TrackingProblem.CROWDED]) > 0
    near = [crowded[row : row + APPROACH_FRAMES + 1].any() for row in range(len(crowded))]
    return problems | np.array(near, dtype=np.int64) * PROBLEM_BITS[TrackingProblem.CROWDED]


def _refine_again(
    source: FrameSource,
    found: Mapping[int, PersonKeypoints],
    refine: MaskRefinement,
    mask_folder: Path,
) -> None:
    """Make the masks of some frames again, by what later frames have shown."""
    left = set(found)
    for frame in source.frames():
        if frame.index in left:
            _write_mask(_mask_path(mask_folder, frame.index), frame.rgb, found[frame.index], refine)
            left.remove(frame.index)
        if not left:
            return


def _mask_path(folder: Path, index: int) -> Path:
    return folder / f"{index:06d}.png"


def _write_mask(
    path: Path, rgb: RgbImage, person: PersonKeypoints | None, refine: MaskRefinement
) -> None:
    height, width = rgb.shape[:2]
    mask = np.zeros((height, width), dtype=np.uint8)
    if person is not None:
        mask = (refine(rgb, person.mask, (width, height)) * 255.0 + 0.5).astype(np.uint8)
    _, code = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    path.write_bytes(code.tobytes())


def reason_left_out(track: KeypointTrack, frame: int) -> str:
    """Reason for which a frame that was tracked has no valid pose."""
    row = int(np.searchsorted(track.frames, frame))
    if row == len(track) or track.frames[row] != frame:
        return NOT_FOUND
    problems = 0 if track.problems is None else int(track.problems[row])
    is_crowded = problems & PROBLEM_BITS[TrackingProblem.CROWDED]
    return ANOTHER_NEAR if is_crowded else DISAGREEING


def _require_person(source: FrameSource, found: int, total: int) -> None:
    """Raise InputError if the person was found in too few of the frames."""
    if found and found >= min(MIN_FOUND, max(1, total // 4)):
        return
    where = "none" if not found else f"only {found}"
    raise InputError(
        f"A person was found in {where} of {total} frames of {source.path}. Tracking needs one "
        "person, from head to feet in the picture, upright, in good light, at least a quarter of "
        "its height. Is the video rotated (--rotate), or does it start before the person comes in "
        "(--frames), or is --person more than there are? Poses of another tracker can be given "
        "with --poses."
    )
