"""A stream whose person is tracked while its frames come: a source, and poses and masks for it.

Decoding, tracking and fitting run on threads of their own. The tracker takes the newest frame that
has been decoded, whenever it is free: what it finds is about now, and the frames that came
meanwhile are skipped. The first frames settle the person's proportions and the focal length. Later
poses are fitted to key points and masks a few at a time, together with those of the frames around
them, which therefore wait for a while.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import final

import numpy as np
from jaxtyping import Float32

from capture.camera import Camera
from capture.inbox import Inbox
from capture.input_error import InputError, counted
from capture.source import (
    Frame,
    FrameSource,
    PacingClock,
    WrappedSource,
    shrink_to_longer_side,
)
from preprocess.alignment.silhouette_objective import spaced_indices
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack
from preprocess.capture_session import Capture, ObservationSource
from preprocess.fitting.clip_fitting import SIGMA_LOG_FOCAL, SIGMA_LOG_LIVE_FOCAL
from preprocess.fitting.tracked_frames import (
    SeenPerson,
    StreamPoseFitter,
    fit_first_frames,
    reduced_size_px,
)
from preprocess.masks.mask_sources import MaskSource
from preprocess.observation import join_frame
from preprocess.plugins import PersonTracker
from preprocess.tracking.keypoints import PersonKeypoints
from preprocess.tracking.video_tracking import NOT_FOUND, MaskRefinement

START_FRAMES = 8
"""Frames with the person from which proportions and focal length are fitted."""
MIN_INTERVAL_S = 0.06
"""Time between two frames that are tracked: more of them teach no more, and their poses would
jitter, for the frames around a frame would span too short a time."""
QUEUED_FRAMES = 8
"""Most tracked frames that wait for the fit of their poses; what is tracked meanwhile is only
looked at, so that advice goes on while a trainer is being prepared."""
KEPT_BYTES = 160 << 20
"""Memory for skipped frames, until enough others are tracked."""
LEAST_FRAMES = 40
"""Frames that are tracked; where fewer were in time, skipped ones follow, while a user waits."""
FoundPerson = tuple[Frame, PersonKeypoints | None]
"""A frame and the person in it."""


@final
class SkippedFrames:
    """Frames that were not tracked in time; where memory is used up, every second one is kept."""

    def __init__(self) -> None:
        """Keep nothing yet."""
        self._kept: list[Frame] = []
        self._tracked_s: list[float] = []
        self._count, self._stride = 0, 1
        self._lock = threading.Lock()

    def add(self, frame: Frame) -> None:
        """Keep a frame, unless memory is used up and the one before it was kept."""
        with self._lock:
            if self._count % self._stride == 0:
                self._kept.append(frame)
            self._count += 1
            if len(self._kept) * frame.rgb.nbytes > KEPT_BYTES:
                self._kept, self._stride = self._kept[::2], 2 * self._stride

    def mark(self, time_s: float) -> None:
        """Take note of a tracked frame's time."""
        with self._lock:
            self._tracked_s.append(time_s)

    def take(self, count: int) -> list[Frame]:
        """Take evenly spread frames, in order; none near a tracked one, or near each other."""
        with self._lock:
            kept, self._kept = self._kept, []
        apart, times_s = list[Frame](), np.array([*self._tracked_s, -np.inf])
        for frame in kept:
            if np.abs(times_s - frame.time_s).min() >= MIN_INTERVAL_S:
                apart.append(frame)
                times_s[-1] = frame.time_s
        return [apart[place] for place in spaced_indices(len(apart), count)]


@final
class TrackedStream(WrappedSource):
    """A source of frames of which the tracker takes the newest one whenever it is free.

    Where frames are not `skippable`, they wait instead. Frames are handed over once their poses are
    fitted. If fewer than `LEAST_FRAMES` were tracked, some that were skipped follow, from the first
    on again.

    Attributes:
        count: Number of frames that came.
        tracked_later: Number of tracked frames that had been skipped.
        search: Finds the person in a frame, on a thread of its own; the second argument tells
            whether the frame has just come.
        on_frame: Called with each frame and what was found, in order.
        on_end: Called after the last frame, and before frames come from the first on again; all
            are ready then.
        is_ready: Tells whether a frame may be handed over.
    """

    def __init__(self, source: FrameSource) -> None:
        """Wrap a source whose frames come at their own times, or as fast as they are taken."""
        super().__init__(source)
        self._decoded: Inbox[Frame] | None = None
        self._tracked: Inbox[FoundPerson] | None = None
        self._waiting, self._skipped = deque[Frame](), SkippedFrames()
        self._pace, self._last_s, self._taken = PacingClock(), -np.inf, 0
        self.count = self.tracked_later = 0
        self.search: Callable[[Frame, bool], PersonKeypoints | None] = lambda frame, is_new: None
        self.on_frame: Callable[[Frame, PersonKeypoints | None], None] = lambda frame, found: None
        self.on_end: Callable[[], None] = lambda: None
        self.is_ready: Callable[[Frame], bool] = lambda frame: True

    def take_next(self) -> bool:
        """Take and look at the next frame; return whether there was one."""
        found = self._next_found()
        if found is not None:
            self._look(found)
        return found is not None

    def frames(self) -> Iterator[Frame]:
        """The frames that are tracked, once; those that `take_next` took already come first."""
        while True:
            yield from self._take_ready()
            found = self._next_found()
            if found is None or found[0].time_s < self._last_s:
                self.on_end()
                yield from self._take_ready()
                self._last_s = -np.inf
            if found is None:
                return
            self._look(found)

    def _take_ready(self) -> Iterator[Frame]:
        while self._waiting and self.is_ready(self._waiting[0]):
            yield self._waiting.popleft()

    def _next_found(self) -> FoundPerson | None:
        if self._tracked is None:
            self._tracked = Inbox(self._found(), capacity=QUEUED_FRAMES)
        began = time.perf_counter()
        found = next(self._tracked.items(max_items=1), None)
        self._pace.waited_s += time.perf_counter() - began
        return found

    def _look(self, found: FoundPerson) -> None:
        self._last_s, self._taken = max(self._last_s, found[0].time_s), self._taken + 1
        self._waiting.append(found[0])
        if self._taken >= LEAST_FRAMES:
            self._skipped.take(0)
        self.on_frame(*found)

    def _skip(self, frame: Frame) -> None:
        """Keep a frame that was not tracked in time, unless enough others were."""
        if self._taken < LEAST_FRAMES:
            self._skipped.add(frame)

    def close(self) -> None:
        """End the source and the threads that read it."""
        super().close()
        for inbox in (self._decoded, self._tracked):
            if inbox is not None:
                inbox.close()

    def _found(self) -> Iterator[FoundPerson]:
        """Track the newest frame again and again, then skipped ones; on the tracker's thread."""
        self._decoded = Inbox(self._counted(), capacity=1, live=self.skippable, on_drop=self._skip)
        last_s = -np.inf
        for frame in self._decoded.items(max_items=1):
            if frame.due_s is not None and frame.time_s - last_s < MIN_INTERVAL_S:
                continue
            last_s, found = frame.time_s, self.search(frame, True)
            if self.skippable and not self._has_room():
                self._skip(frame)
            else:
                self._skipped.mark(frame.time_s)
                yield frame, found
        self.all_came = True
        for frame in self._skipped.take(max(0, LEAST_FRAMES - self._taken)):
            self.tracked_later += 1
            yield replace(frame, due_s=None), self.search(frame, False)

    def _counted(self) -> Iterator[Frame]:
        for frame in self._source.frames():
            self.count += 1
            yield frame

    def _has_room(self) -> bool:
        """Wait for room for a tracked frame, but not long."""
        deadline = time.perf_counter() + 0.3  # then it looks on, while as many wait
        while self._tracked is not None and self._tracked.pending >= QUEUED_FRAMES:
            if time.perf_counter() > deadline:
                return False
            time.sleep(0.01)
        return True


@final
class LiveTracking:
    """Poses of a stream's frames, tracked as they come.

    Attributes:
        times_s: Time of each frame that was looked at, by its number.
        lost: Numbers of the frames in which the person was not found.
        latest: The person in the frame whose pose was asked for last.
    """

    latest: SeenPerson

    def __init__(
        self,
        stream: TrackedStream,
        tracker: PersonTracker,
        on_tracked: Callable[[Frame, PersonKeypoints | None], object] = lambda *_: None,
    ) -> None:
        """Connect a stream with its tracker; nothing is read yet.

        `on_tracked` receives each frame that was searched, and the person in it, on the tracker's
        thread.
        """
        self.stream, self._tracker, self._on_tracked = stream, tracker, on_tracked
        self.times_s: dict[int, float] = {}
        self.lost: list[int] = []
        self._seen: dict[int, SeenPerson] = {}
        self._mask_px: tuple[int, int] | None = None
        self._poses: dict[int, BodyPose] = {}
        self._fitter: StreamPoseFitter | None = None
        stream.search, stream.on_frame = self._search, self._fit
        stream.is_ready = lambda frame: frame.index in self._poses or frame.index not in self._seen

    def start(
        self,
        shaped: ShapedBody,
        camera: Camera,
        *,
        fixed_body: bool = False,
        stated_focal: bool = False,
    ) -> tuple[Motion, ShapedBody, CameraTrack]:
        """Track the first frames, and fit them, the person and a static camera to each other.

        With `fixed_body`, `shaped` is a finished avatar's person, else the mean shape; with
        `stated_focal` the focal length comes from a file and is no guess, if not exact.
        """
        while len(self._seen) < START_FRAMES and self.stream.take_next():
            pass
        seen = sorted(self._seen.values(), key=lambda each: each.time_s)
        if not seen:
            raise InputError(
                f"No person was found in {self.stream.path} ({counted(len(self.times_s), 'frame')} "
                "searched). Tracking needs one person, from head to feet in the picture."
            )
        motion, person, camera = fit_first_frames(
            seen, shaped, camera, fixed=fixed_body,
            sigma_log_focal=SIGMA_LOG_LIVE_FOCAL if stated_focal else SIGMA_LOG_FOCAL,
        )  # fmt: skip
        self._fitter, self.stream.on_end = StreamPoseFitter(person, camera), self._end_of_pass
        for row, each in enumerate(seen):
            self._poses |= self._fitter.add(each, motion[row])
        source = "focal length fitted to the first frames"
        return motion, person, CameraTrack(cameras=(camera,), source=source)

    def pose_of(self, frame: Frame) -> BodyPose | str:
        """The pose of a frame that was tracked when it was taken, or why it has none; once."""
        if frame.index not in self._seen:
            return NOT_FOUND
        self.latest = self._seen.pop(frame.index)
        return self._poses.pop(frame.index)

    def notes(self) -> Iterator[str]:
        """Messages for the user that need the frames to have come."""
        looked, stream = len(self.times_s), self.stream
        if looked < stream.count:
            later = f", {stream.tracked_later} of them after the last one had come"
            yield (
                f"{looked} of {stream.count} frames were tracked"
                f"{later if stream.tracked_later else ''}."
            )
        if self.lost:
            times = [self.times_s[number] for number in self.lost]
            yield (
                f"The person was not found in {len(self.lost)} of {looked} frames, between "
                f"{min(times):.1f} and {max(times):.1f} s."
            )

    def _search(self, frame: Frame, is_new: bool) -> PersonKeypoints | None:
        """Find the person in a frame."""
        found = None if "corrupt" in frame.flags else self._tracker(frame.rgb)
        if is_new:
            self._on_tracked(frame, found)
        return found

    def _end_of_pass(self) -> None:
        """Fit what is left; the next frame is no neighbor of the last one."""
        assert self._fitter is not None
        self._poses |= self._fitter.finish()

    def _fit(self, frame: Frame, found: PersonKeypoints | None) -> None:
        """Add the person in a frame, whose pose is fitted with those of later ones."""
        self.times_s[frame.index] = frame.time_s
        if found is None:
            self.lost.append(frame.index)
            return
        if self._mask_px is None:
            self._mask_px = reduced_size_px(found, frame.size_px)
        seen = SeenPerson(
            number=frame.index,
            time_s=frame.time_s,
            keypoints=found,
            mask=found.mask.resample(frame.size_px, self._mask_px),
        )
        self._seen[frame.index] = seen
        if self._fitter is not None:
            self._poses |= self._fitter.add(seen)


@final
class TrackedMasks(MaskSource):
    """The tracker's own masks of a stream's frames, refined."""

    origin = "tracked"

    def __init__(self, tracking: LiveTracking, refine: MaskRefinement) -> None:
        """Refine nothing yet."""
        self._tracking, self._refine = tracking, refine

    def alpha(
        self, frame: Frame, scaled: Frame, pose: BodyPose, camera: Camera
    ) -> Float32[np.ndarray, "rows columns"]:
        """Refine the mask of the frame whose pose was asked for last."""
        return self._refine(frame.rgb, self._tracking.latest.keypoints.mask, scaled.size_px)


@final
class TrackedObservations(ObservationSource):
    """The observations of a stream whose person is tracked as its frames come."""

    def __init__(self, capture: Capture, tracking: LiveTracking) -> None:
        """Go on after the frames that tracking has started with."""
        target_px = shrink_to_longer_side(tracking.stream.size_px, capture.size_px)
        camera = capture.cameras[0].resize(target_px)
        super().__init__(
            capture,
            tracking.stream,
            lambda frame: join_frame(
                frame, tracking.pose_of, lambda index: camera, self.capture.masks
            ),
        )
        self._tracking = tracking

    def notes(self) -> Iterator[str]:
        """What tracking and masks have to say."""
        yield from self._tracking.notes()
        yield from super().notes()
