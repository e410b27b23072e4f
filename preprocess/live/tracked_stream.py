"""A stream whose person is tracked while its frames come: a source, and poses and masks for it.

The first frames settle the person's proportions and the focal length. Each later frame is tracked
when it arrives, and its pose fitted to its key points and its mask together with those of the last
few frames. Frames that come while another is being tracked are left out, so tracking never falls
behind.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float32

from capture.camera import Camera
from capture.frame import Frame
from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack
from preprocess.fitting.tracked_frames import (
    FramePoseFitter,
    SeenPerson,
    fit_first_frames,
    reduced_size_px,
)
from preprocess.live.live_alignment import LiveAlignment
from preprocess.masks.mask_origin import Segmenter
from preprocess.observation import Observation
from preprocess.observe import DroppedFrame, compose_observation_builder, shrink_to_longer_side
from preprocess.tracking.keypoints import PersonKeypoints
from preprocess.tracking.person_tracker import PersonTracker
from preprocess.tracking.video_tracking import MaskRefinement

START_FRAMES = 8
"""Frames with the person from which proportions and focal length are fitted."""
MAX_LATENESS_S = 0.04
"""Time after it was due at which a frame is left out: another was being tracked."""
NOT_FOUND = "person not found"
"""Why a frame without the person is not used."""


@final
class TrackedStream:
    """A source of frames at their own times, of which only those are taken that can be tracked.

    Attributes:
        skipped: Number of frames that came while another was being tracked.
    """

    def __init__(self, source: FrameSource) -> None:
        """Nothing is read yet.

        Args:
            source: Its frames come at their own times, or as fast as they are taken.
        """
        self._source = source
        self._frames: Iterator[Frame] | None = None
        self._first: deque[Frame] = deque()
        self.skipped = 0
        self.path, self.size_px, self.selection = source.path, source.size_px, source.selection
        self.frames_in_file, self.frame_count = source.frames_in_file, source.frame_count
        self.duration_s, self.has_alpha = source.duration_s, source.has_alpha
        self.quarter_turns, self.started_at = source.quarter_turns, source.started_at
        self.live, self.paced, self.warnings = source.live, source.paced, source.warnings

    @property
    def waited_s(self) -> float:
        """How long it has been waited for frames, in all."""
        return self._source.waited_s

    @property
    def dropped(self) -> int:
        """Number of frames that the source has lost; those left out here are `skipped`."""
        return self._source.dropped

    def take_first(self) -> Frame | None:
        """Take a frame before the stream starts, which begins with it again; None at the end."""
        if self._frames is None:
            self._frames = self._taken()
        frame = next(self._frames, None)
        if frame is not None:
            self._first.append(frame)
        return frame

    def frames(self) -> Iterator[Frame]:
        """The frames that are taken, once."""
        frames = self._frames or self._taken()
        while self._first:
            yield self._first.popleft()
        yield from frames

    def count_frames(self) -> int:
        """As the source's own."""
        return self._source.count_frames()

    def close(self) -> None:
        """Close the source."""
        self._source.close()

    def _taken(self) -> Iterator[Frame]:
        for frame in self._source.frames():
            late = frame.due_s is not None and time.perf_counter() - frame.due_s > MAX_LATENESS_S
            if late:
                self.skipped += 1
            else:
                yield frame


@dataclass(frozen=True, eq=False, kw_only=True)
class StreamStart:
    """What the first frames of a stream have settled.

    Attributes:
        motion: Poses of these frames.
        shaped: The person.
        cameras: The camera, which stands still.
    """

    motion: Motion
    shaped: ShapedBody
    cameras: CameraTrack


@final
class LiveTracking:
    """Poses and masks of a stream's frames, tracked as they come; takes the place of `LiveInputs`.

    Attributes:
        stream: The frames.
        times_s: Time of each frame that was looked at, by its number.
        lost: Frames in which the person was not found.
    """

    def __init__(
        self, stream: TrackedStream, tracker: PersonTracker, refine: MaskRefinement
    ) -> None:
        """Nothing is read yet.

        Args:
            stream: The frames.
            tracker: Follows the person.
            refine: Makes masks from the tracker's.
        """
        self.stream = stream
        self.times_s: dict[int, float] = {}
        self.lost: list[int] = []
        self._tracker, self._refine = tracker, refine
        self._waiting: dict[int, SeenPerson | None] = {}
        self._poses: dict[int, BodyPose] = {}
        self._fitter: FramePoseFitter | None = None

    def start(self, shaped: ShapedBody, camera: Camera, *, fixed_body: bool = False) -> StreamStart:
        """Track the first frames, and fit person and camera to them.

        Args:
            shaped: The body's mean shape, or the person of a finished avatar.
            camera: Its focal length is a guess.
            fixed_body: Whether `shaped` is the person.

        Raises:
            InputError: If the stream ends before the person was found.
        """
        seen: list[SeenPerson] = []
        while len(seen) < START_FRAMES and (frame := self.stream.take_first()) is not None:
            found = self._look(frame, seen[0].mask.shape[::-1] if seen else None)
            self._waiting[frame.index] = found
            if found is not None:
                seen.append(found)
        if not seen:
            raise InputError(
                f"No person was found in {self.stream.path} ({len(self.times_s)} frames were "
                "searched). Tracking needs one person, from head to feet in the picture."
            )
        motion, person, camera = fit_first_frames(seen, shaped, camera, fixed=fixed_body)
        height, width = seen[0].mask.shape
        self._fitter = FramePoseFitter(person, camera, (width, height))
        self._poses = {each.number: motion[row] for row, each in enumerate(seen)}
        source = "focal length fitted to the first frames"
        return StreamStart(
            motion=motion,
            shaped=person,
            cameras=CameraTrack(cameras=(camera,), source=source),
        )

    def observation_builder(
        self,
        source: FrameSource,
        cameras: CameraTrack,
        size_px: int | None,
        segment: Segmenter | None = None,
        fit: LiveAlignment | None = None,
    ) -> Callable[[Frame], Observation | DroppedFrame]:
        """What makes an observation of a frame: tracks it, unless it is one of the first.

        Args:
            source: The frames.
            cameras: The camera.
            size_px: Longer side of the observations.
            segment, fit: Not used: masks and poses are tracked.
        """
        assert segment is None
        assert fit is None
        target_px = shrink_to_longer_side(source.size_px, size_px)
        masks: dict[int, PersonKeypoints] = {}

        def pose_of(frame: Frame) -> BodyPose | str:
            seen = self._seen(frame)
            if seen is None:
                return NOT_FOUND
            assert self._fitter is not None
            masks.clear()
            masks[frame.index] = seen.keypoints
            return self._fitter.fit(seen, self._poses.pop(frame.index, None))

        def alpha_of(frame: Frame, size_px: tuple[int, int]) -> Float32[np.ndarray, "rows columns"]:
            return self._refine(frame.rgb, masks[frame.index].mask, size_px)

        return compose_observation_builder(pose_of, alpha_of, lambda index: cameras[0], target_px)

    def final_notes(self) -> Iterator[str]:
        """What could not be said before the frames came."""
        looked = len(self.times_s)
        if self.stream.skipped:
            yield (
                f"{self.stream.skipped} of {looked + self.stream.skipped} frames were left out: "
                "they came while another was being tracked."
            )
        if self.lost:
            times = [self.times_s[number] for number in self.lost]
            yield (
                f"The person was not found in {len(self.lost)} of {looked} frames, between "
                f"{min(times):.1f} and {max(times):.1f} s."
            )

    def _seen(self, frame: Frame) -> SeenPerson | None:
        if frame.index in self._waiting:
            return self._waiting.pop(frame.index)
        assert self._fitter is not None
        return self._look(frame, self._fitter.mask_px)

    def _look(self, frame: Frame, mask_px: tuple[int, int] | None) -> SeenPerson | None:
        """Find the person in a frame; masks are reduced to a size, if there is one already."""
        self.times_s[frame.index] = frame.time_s
        found = self._tracker(frame.rgb)
        if found is None:
            self.lost.append(frame.index)
            return None
        size_px = mask_px or reduced_size_px(found, frame.size_px)
        return SeenPerson(
            number=frame.index,
            time_s=frame.time_s,
            keypoints=found,
            mask=found.mask.resample(frame.size_px, size_px),
        )
