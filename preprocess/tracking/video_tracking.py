"""Tracks the person of a recording: key points in memory, masks as pictures in a folder.

Networks run on one thread; masks are refined and written on another, so two cores are busy.
"""

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.tracking.keypoint_track import KeypointTrack
from preprocess.tracking.keypoints import CroppedMask, PersonKeypoints
from preprocess.tracking.person_tracker import PersonTracker
from preprocess.tracking.tracking_problems import PROBLEM_BITS, ProblemFinder

MIN_FOUND = 8
"""Fewest frames in which the person must be found; 4 of fewer than 16 frames."""
FRAMES_REFINED_AGAIN = 60
"""First frames whose masks are made again in the end, when the background behind them is known."""
QUEUED_MASKS = 8
"""Most masks that wait to be written."""


@runtime_checkable
class MaskRefinement(Protocol):
    """Makes the mask of a frame from a network's coarse one, frame by frame, in order."""

    def __call__(
        self,
        rgb: UInt8[np.ndarray, "height width 3"],
        mask: CroppedMask,
        size_px: tuple[int, int],
    ) -> Float32[np.ndarray, "rows columns"]:
        """Estimate how far each pixel is person, in [0, 1], at a size."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedVideo:
    """What tracking found in a recording.

    Attributes:
        keypoints: Key points of the frames in which the person was found.
        frame_times_s: Time of each frame that was looked at, by its number, seconds.
        interrupted: Whether tracking was stopped before the last frame.
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
        source: The recording.
        tracker: Follows the person.
        refine: Makes masks of the frames' size from the tracker's.
        mask_folder: Existing folder; a mask is written for every frame, an empty one where the
            person was not found. None writes none.
        advance: Called with the number of frames done.
        stop: Ends tracking early once it is set; what was found until then is returned.
        before: What was found in the frames before those of `source`; it is returned with the rest.

    Raises:
        InputError: If the person is found in too few frames.
        OSError: If a mask cannot be written.
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
    track = replace(track, problems=np.array(problems, dtype=np.int64))
    if before is not None:
        track, times = before.keypoints.join(track), before.frame_times_s | times
    _require_person(source, len(track), len(times))
    return TrackedVideo(keypoints=track, frame_times_s=times, interrupted=interrupted)


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
    path: Path,
    rgb: UInt8[np.ndarray, "height width 3"],
    person: PersonKeypoints | None,
    refine: MaskRefinement,
) -> None:
    height, width = rgb.shape[:2]
    mask = np.zeros((height, width), dtype=np.uint8)
    if person is not None:
        mask = (refine(rgb, person.mask, (width, height)) * 255.0 + 0.5).astype(np.uint8)
    _, code = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    path.write_bytes(code.tobytes())


def _require_person(source: FrameSource, found: int, total: int) -> None:
    """Raise InputError if the person was found in too few of the frames."""
    if found and found >= min(MIN_FOUND, max(1, total // 4)):
        return
    where = "none" if not found else f"only {found}"
    raise InputError(
        f"A person was found in {where} of {total} frames of {source.path}. Tracking needs one "
        "person, from head to feet in the picture, upright, in good light, at least a quarter of "
        "its height. Is the video rotated, or does it start before the person comes in "
        "(--frames), or is --person more than there are? Poses of another tracker can be given "
        "with --poses."
    )
