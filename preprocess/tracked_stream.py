"""A stream whose person is tracked while its frames come: a source, and poses and masks for it.

The first frames settle the person's proportions and the focal length. Each later frame is tracked
when it arrives, and its pose fitted to its key points and its mask together with those of the
frames around it; once more when more frames have come after it. Frames that come while another is
being tracked are left out, so that tracking does not fall behind.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import final

import cv2
import numpy as np
from jaxtyping import Float32

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import Frame, FrameSource, WrappedSource
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.parametric_body import ShapedBody
from preprocess.cameras.camera_file import CameraTrack
from preprocess.capture_session import Capture
from preprocess.fitting.clip_fitting import SIGMA_LOG_FOCAL, SIGMA_LOG_LIVE_FOCAL
from preprocess.fitting.tracked_frames import (
    LAG_FRAMES,
    EarlierPoses,
    FramePoseFitter,
    SeenPerson,
    fit_first_frames,
    reduced_size_px,
)
from preprocess.masks.mask_sources import MaskSource
from preprocess.observation import (
    DroppedFrame,
    Observation,
    join_frame,
    shrink_to_longer_side,
)
from preprocess.observation_source import ObservationSource
from preprocess.plugins import PersonTracker
from preprocess.tracking.keypoints import PersonKeypoints
from preprocess.tracking.video_tracking import NOT_FOUND, MaskRefinement

START_FRAMES = 8
"""Frames with the person from which proportions and focal length are fitted."""
MAX_LATENESS_S = 0.04
"""Time after it was due at which a frame is left out: another was being tracked."""
MIN_INTERVAL_S = 0.06
"""Time between two frames that are taken: more of them teach no more, and their poses would jitter,
for the frames around a frame would span too short a time."""
MAX_SKIPPED = 5
"""Most frames in a row that are left out; a machine that is too busy to decode a recording at its
own speed falls behind instead."""


@final
class TrackedStream(WrappedSource):
    """A source of frames at their own times, of which only those are taken that can be tracked.

    Frames are handed over `LAG_FRAMES` after they came, so that their poses are fitted together
    with those of later frames. `on_frame` is called with each frame as soon as it is taken,
    `on_end` when the last frame has been used.
    """

    def __init__(self, source: FrameSource) -> None:
        """Wrap a source whose frames come at their own times, or as fast as they are taken."""
        super().__init__(source)
        self._frames: Iterator[Frame] | None = None
        self._waiting: deque[Frame] = deque()
        self._skipped = 0
        self.on_frame: Callable[[Frame], None] = lambda frame: None
        self.on_end: Callable[[], None] = lambda: None

    @property
    def dropped(self) -> int:
        """Number of frames that were lost, most of them while another was being tracked."""
        return self._source.dropped + self._skipped

    def take_next(self) -> bool:
        """Take and look at the next frame; return whether there was one."""
        if self._frames is None:
            self._frames = self._taken()
        frame = next(self._frames, None)
        if frame is not None:
            self._waiting.append(frame)
            self.on_frame(frame)
        return frame is not None

    def frames(self) -> Iterator[Frame]:
        """The frames that are taken, once; those that `take_next` took already come first."""
        going = True
        while going:
            while len(self._waiting) > LAG_FRAMES:
                yield self._waiting.popleft()
            going = self.take_next()
        while self._waiting:
            yield self._waiting.popleft()
        self.on_end()

    def _taken(self) -> Iterator[Frame]:
        skipped, last_s = 0, -np.inf  # since the last frame that was taken; its time
        for frame in self._source.frames():
            if frame.due_s is not None and frame.time_s - last_s < MIN_INTERVAL_S:
                continue
            late = frame.due_s is not None and time.perf_counter() - frame.due_s > MAX_LATENESS_S
            if late and skipped < MAX_SKIPPED:
                skipped += 1
                self._skipped += 1
            else:
                skipped, last_s = 0, frame.time_s
                yield frame


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

        `on_tracked` receives each frame that was searched, and the person in it.
        """
        self.stream, self._tracker, self._on_tracked = stream, tracker, on_tracked
        self.times_s: dict[int, float] = {}
        self.lost: list[int] = []
        self._seen: dict[int, SeenPerson] = {}
        self._mask_px: tuple[int, int] | None = None
        self._fitter: FramePoseFitter | None = None
        self._earlier: EarlierPoses | None = None
        stream.on_frame = self._track

    def start(
        self,
        shaped: ShapedBody,
        camera: Camera,
        *,
        fixed_body: bool = False,
        stated_focal: bool = False,
    ) -> tuple[Motion, ShapedBody, CameraTrack]:
        """Track the first frames, and fit them, the person and a static camera to each other.

        Args:
            shaped: The body's mean shape, or the person of a finished avatar.
            camera: Its focal length is not exact.
            fixed_body: Whether `shaped` is the person.
            stated_focal: Whether the focal length comes from a file and is no guess.
        """
        while len(self._seen) < START_FRAMES and self.stream.take_next():
            pass
        seen = list(self._seen.values())
        if not seen:
            raise InputError(
                f"No person was found in {self.stream.path} ({len(self.times_s)} frames were "
                "searched). Tracking needs one person, from head to feet in the picture."
            )
        motion, person, camera = fit_first_frames(
            seen, shaped, camera, fixed=fixed_body,
            sigma_log_focal=SIGMA_LOG_LIVE_FOCAL if stated_focal else SIGMA_LOG_FOCAL,
        )  # fmt: skip
        self._fitter, self._earlier = FramePoseFitter(person, camera), EarlierPoses(person, camera)
        self.stream.on_end = self._earlier.fit_rest
        for row, each in enumerate(seen):
            self._fitter.add(each, motion[row])
        source = "focal length fitted to the first frames"
        return motion, person, CameraTrack(cameras=(camera,), source=source)

    def pose_of(self, frame: Frame) -> BodyPose | str:
        """The pose of a frame that was tracked when it was taken, or why it has none; once."""
        if frame.index not in self._seen:
            return NOT_FOUND
        assert self._fitter is not None
        self.latest = self._seen.pop(frame.index)
        return self._fitter.pose(frame.index)

    def add_observation(self, observation: Observation) -> None:
        """Take the latest frame's pose and mask as evidence for those of earlier frames."""
        assert self._earlier is not None
        mask = cv2.resize(observation.alpha, self._mask_px, interpolation=cv2.INTER_AREA)
        self._earlier.add(replace(self.latest, mask=mask), observation.pose)

    def take_revised_poses(self) -> dict[int, BodyPose]:
        """Poses of earlier frames that were fitted again since the last call, by their numbers."""
        return {} if self._earlier is None else self._earlier.take()

    def notes(self) -> Iterator[str]:
        """Messages for the user that need the frames to have come."""
        looked = len(self.times_s)
        if self.lost:
            times = [self.times_s[number] for number in self.lost]
            yield (
                f"The person was not found in {len(self.lost)} of {looked} frames, between "
                f"{min(times):.1f} and {max(times):.1f} s."
            )

    def _track(self, frame: Frame) -> None:
        """Find the person in a frame, and fit its pose once there is a person to fit."""
        self.times_s[frame.index] = frame.time_s
        found = None if "corrupt" in frame.flags else self._tracker(frame.rgb)
        self._on_tracked(frame, found)
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
            self._fitter.add(seen)


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
        super().__init__(capture, tracking.stream)
        self._tracking = tracking
        target_px = shrink_to_longer_side(self.frames.size_px, capture.size_px)
        self._camera = capture.cameras[0].resize(target_px)

    def join(self, frame: Frame) -> Observation | DroppedFrame:
        """Join the next frame with its pose and mask."""
        item = join_frame(
            frame, self._tracking.pose_of, lambda index: self._camera, self.capture.masks
        )
        if isinstance(item, Observation):
            self._tracking.add_observation(item)
        return item

    def take_revised_poses(self) -> dict[int, BodyPose]:
        """Poses that were fitted again since the last call."""
        return self._tracking.take_revised_poses()

    def notes(self) -> Iterator[str]:
        """What tracking and masks have to say."""
        yield from self._tracking.notes()
        yield from super().notes()
