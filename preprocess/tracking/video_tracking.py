"""Tracks the person of a recording: key points in memory, masks as images in a folder.

Networks run on one thread; frames are decoded on another, and masks refined on a third. Frames
in which borders of the image or other persons make the track doubtful are marked.
"""

from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Int

from capture.input_error import InputError
from capture.source import AlphaMask, Frame, FrameSource, RgbImage
from capture.work_ahead import read_ahead
from preprocess.plugins import PersonTracker
from preprocess.tracking.keypoints import HIPS, CroppedMask, KeypointTrack, PersonKeypoints

BORDER_SAMPLES = 128
"""Places along each border of a frame at which the mask is read."""
ELSEWHERE = 0.6
"""Distance from the last place, in sides of the square around the person, that is worth a word."""
MIN_FRAMES = 4
"""Fewest frames with the person, or with a usable mask, that an avatar is made of."""
FRAMES_REFINED_AGAIN = 60
"""First frames of a film, of which those that are used have their masks made again in the end, when
the background behind them is known."""


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
    # neither fingers nor feet: shoes and fingertips that touch a border cut nothing off
    body = found.image_px[[0, 7, 8, *range(11, 17), *range(23, 29)]]
    low_xy, high_xy = body.min(axis=0), body.max(axis=0)
    margin = 0.05 * float(np.ptp(found.image_px, axis=0).max())
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
        if (found.mask.values[row[inside], column[inside]] > 127).sum() >= 2:
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


MaskRefinement = Callable[[RgbImage, CroppedMask, tuple[int, int]], AlphaMask]
"""Makes the mask of a frame, at a size, from a network's coarse one, frame by frame, in order."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedVideo:
    """Key points of a recording, and the times of all frames that were looked at, by their numbers.

    `interrupted` tells that tracking was stopped before the last frame.
    """

    keypoints: KeypointTrack
    frame_times_s: dict[int, float]
    interrupted: bool


@final
class VideoTracking:
    """Finds the person in each wanted frame of a recording."""

    def __init__(
        self,
        source: FrameSource,
        tracker: PersonTracker,
        refine: MaskRefinement,
        mask_folder: Path | None,
        before: TrackedVideo | None = None,
    ) -> None:
        """Read nothing yet; the result for frames `before` those of the source is returned, too.

        The folder, if any, exists, for a mask of every frame: an empty one without the person.
        """
        self._source, self._tracker, self._refine = source, tracker, refine
        self._mask_folder, self._before = mask_folder, before
        self._found, self._problems = dict[int, PersonKeypoints](), list[int]()
        self._times_s = {} if before is None else dict(before.frame_times_s)
        self._writing: list[Future[None]] = []
        self._is_complete = False

    def run(self) -> Generator[int, None, None]:
        """Go through the frames; yields how many are done, and may be left early."""
        finder, size_px = ProblemFinder(), self._source.size_px
        with ThreadPoolExecutor(max_workers=1, thread_name_prefix="masks") as pool:
            for frame in read_ahead(self._source.frames()):
                person = None if "corrupt" in frame.flags else self._tracker(frame.rgb)
                self._times_s[frame.index] = frame.time_s
                seen = finder.problems(person, size_px)
                if person is not None:
                    self._found[frame.index] = person
                    self._problems.append(sum(PROBLEM_BITS[each] for each in seen))
                if self._mask_folder is not None:
                    self._writing.append(pool.submit(self._write_mask, frame, person))
                while len(self._writing) > 8 or (self._writing and self._writing[0].done()):
                    self._writing.pop(0).result()
                yield len(self._times_s)
        if self._mask_folder is not None:
            self._refine_again()
        self._is_complete = True

    def result(self) -> TrackedVideo:
        """What was found until now; an `InputError` if the person was in too few frames."""
        for each in self._writing:
            each.result()
        times_s, frames = self._times_s, list(self._found)
        track = KeypointTrack.of(
            frames, list(self._found.values()), self._source.size_px, [times_s[n] for n in frames]
        )
        track = replace(track, problems=_mark_approach(np.array(self._problems, dtype=np.int64)))
        track = mark_passers_by(track)
        if self._before is not None:
            track = self._before.keypoints.join(track)
        _require_person(self._source, len(track), len(times_s), self._is_complete)
        return TrackedVideo(
            keypoints=track, frame_times_s=times_s, interrupted=not self._is_complete
        )

    def _refine_again(self) -> None:
        """Make the masks of the first frames again, by what later frames have shown."""
        left = set(list(self._found)[: -(-FRAMES_REFINED_AGAIN // self._source.selection.step)])
        for frame in read_ahead(self._source.frames()) if left else ():
            if frame.index in left:
                self._write_mask(frame, self._found[frame.index])
                left.remove(frame.index)
            if not left:
                return

    def _write_mask(self, frame: Frame, person: PersonKeypoints | None) -> None:
        assert self._mask_folder is not None
        mask = np.zeros(frame.rgb.shape[:2], dtype=np.uint8)
        if person is not None:
            alpha = self._refine(frame.rgb, person.mask, frame.size_px)
            mask = (alpha * 255.0 + 0.5).astype(np.uint8)
        _, code = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        (self._mask_folder / f"{frame.index:06d}.png").write_bytes(code.tobytes())


def _mark_approach(problems: Int[np.ndarray, "rows"]) -> Int[np.ndarray, "rows"]:
    """Mark frames right before others are seen to be near, too: not every frame is searched."""
    crowded = (problems & PROBLEM_BITS[TrackingProblem.CROWDED]) > 0
    near = [crowded[row : row + 5].any() for row in range(len(crowded))]
    return problems | np.array(near, dtype=np.int64) * PROBLEM_BITS[TrackingProblem.CROWDED]


def mark_passers_by(track: KeypointTrack) -> KeypointTrack:
    """Mark frames between another person and a jump of the hips: the other one was taken over.

    A person who jumps beside another one is that one, until the hips jump back, or twenty frames
    pass.
    """
    assert track.problems is not None
    bit, frames = PROBLEM_BITS[TrackingProblem.CROWDED], track.frames
    crowded, landings = (track.problems & bit) > 0, frames[_hip_jumps(track)]
    marked = crowded.copy()
    runs = find_runs(crowded)
    for first, last in zip(frames[runs[:, 0]], frames[runs[:, 1] - 1], strict=True):
        before = landings[(landings >= first - 20) & (landings <= first)]
        after = landings[(landings > last) & (landings <= last + 20)]
        start, end = min(before, default=first), max(after, default=last + 1)
        marked |= (frames >= start) & (frames < end)
    return replace(track, problems=track.problems | marked * bit)


def find_runs(flags: Bool[np.ndarray, "rows"]) -> Int[np.ndarray, "runs 2"]:
    """First row and end of each run of rows that are flagged."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return edges.reshape(-1, 2)


def _hip_jumps(track: KeypointTrack) -> Bool[np.ndarray, "rows"]:
    """Rows to which the hips come by a change of their speed that is more than a person's."""
    jumps = np.zeros(len(track), dtype=bool)
    if len(track) < 3 or track.times_s is None:
        return jumps
    hips = track.image_px[:, HIPS].mean(axis=1)
    tall = max(1.0, float(np.median(np.ptp(track.image_px[:, :, 1], axis=1))))
    apart = np.diff(track.frames)
    ways = np.diff(hips, axis=0) / tall / apart[:, None]
    changes = np.linalg.norm(np.diff(ways, axis=0), axis=1)
    frame_s = float(np.median(np.diff(track.times_s) / apart))
    # errors of key points: 0.02 heights, and 4 medians, which they pass in one of 60,000 frames
    usual = max(0.02, 4.0 * float(np.median(changes)))
    jumps[2:] = changes > usual + 9.0 * frame_s**2 * apart[1:]  # body heights / s²
    return jumps


def reason_left_out(track: KeypointTrack, frame: int) -> str:
    """Reason for which a frame that was tracked has no valid pose."""
    row = int(np.searchsorted(track.frames, frame))
    if row == len(track) or track.frames[row] != frame:
        return NOT_FOUND
    problems = 0 if track.problems is None else int(track.problems[row])
    is_crowded = problems & PROBLEM_BITS[TrackingProblem.CROWDED]
    return ANOTHER_NEAR if is_crowded else DISAGREEING


def _require_person(source: FrameSource, found: int, total: int, is_complete: bool) -> None:
    """Raise InputError if the person was found in too few of the frames, or few could be read."""
    if is_complete and total < MIN_FRAMES <= (source.frame_count or 0):
        raise InputError(
            f"{source.path} breaks off after {total} of {source.frame_count} frames; an avatar "
            f"needs {MIN_FRAMES} at least. Copy it again from the camera."
        )
    if found and found >= min(8, max(1, total // 4)):
        return
    where = "none" if not found else f"only {found}"
    raise InputError(
        f"A person was found in {where} of {total} frames of {source.path}. Tracking needs one "
        "person, from head to feet in the picture, upright, in good light, at least a quarter of "
        "its height. Is the video rotated (--rotate), or does it start before the person comes in "
        "(--frames), or is --person more than there are? Poses of another tracker can be given "
        "with --poses."
    )
