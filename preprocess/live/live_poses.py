"""Poses that a tracker still writes: read again whenever their file has changed."""

from collections.abc import Callable
from pathlib import Path
from typing import final

import numpy as np

from capture.input_error import InputError
from capture.source import Frame, PacingClock
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.poses.plausibility import invalidate_implausible_rows, require_plausible
from preprocess.poses.pose_format_registry import read_poses

MAX_WAIT_S = 2.0
"""So long after it was filmed a frame waits for its pose or its mask; then it is left out."""
POLL_INTERVAL_S = 0.02
MIN_EPOCH_TIME_S = 1e8
"""Times beyond this are no seconds of a clip."""
MAX_TIME_OFFSET_S = 0.02
"""Of a pose whose time is given: how far it may lie from its frame's."""


@final
class LivePoses:
    """The poses of a live source, which come late or not at all.

    A pose belongs to its frame by `frame`, by `time` (seconds from the first picture, or since
    1970), or, where the file has neither, by order.
    """

    def __init__(
        self,
        path: Path,
        pace: PacingClock,
        *,
        default_model: str,
        first_within_s: float,
        patience_s: float = MAX_WAIT_S,
        started_at: float = 0.0,
    ) -> None:
        """Waits for the first valid pose.

        Args:
            path: The file, which need not be there yet; it may be read while it is half written.
            pace: Its clock; ending it ends every wait.
            default_model: Body family of files that do not say theirs.
            first_within_s: How long the first valid pose may take.
            patience_s: How long after it was filmed a frame waits for its pose.
            started_at: When the source's first picture was taken, in seconds since 1970.

        Raises:
            InputError: If there is no valid pose after `first_within_s`, with the reason, or the
                first ones cannot be poses in radians and metres.
        """
        self._path, self._pace, self._patience_s = path, pace, patience_s
        self._default_model, self._started_at = default_model, started_at
        self._version: tuple[int, int] | None = None
        self._motion: Motion | None = None
        self._placed: Callable[[Motion], Motion] = lambda motion: motion
        self._row_of: dict[int, int] = {}
        self._trouble = f"There are no poses {path}."
        deadline = pace.now() + first_within_s
        while not self._has_any():
            if pace.now() >= deadline or pace.stopped:
                raise InputError(
                    f"{self._trouble} Within {first_within_s:.0f} s (--idle-seconds) a first valid "
                    "pose was expected there. Is the tracker running?"
                )
            pace.wait_until(pace.now() + POLL_INTERVAL_S)
            self._poll()

    @property
    def motion(self) -> Motion:
        """All poses that have come so far."""
        assert self._motion is not None
        return self._motion

    def set_placement(self, placed: Callable[[Motion], Motion]) -> None:
        """Brings these poses, and all that come, to the body and the cameras that are used."""
        self._placed, self._motion = placed, placed(self.motion)

    def wait_for_pose(self, frame: Frame) -> BodyPose | str:
        """The pose of a frame; waits for it. Or why there is none."""
        deadline = (self._pace.now() if frame.due_s is None else frame.due_s) + self._patience_s
        while (row := self._row(frame)) is None:
            if self._is_past(frame):
                return "no pose"
            if self._pace.now() >= deadline or self._pace.stopped:
                return f"no pose within {self._patience_s:g} s"
            self._pace.wait_until(min(deadline, self._pace.now() + POLL_INTERVAL_S))
            self._poll()
        return self.motion[row] if self.motion.valid[row] else "pose invalid"

    def _has_any(self) -> bool:
        return self._motion is not None and bool(self._motion.valid.any())

    def _row(self, frame: Frame) -> int | None:
        motion = self.motion
        if motion.frames is not None:
            return self._row_of.get(frame.index)
        if motion.times_s is None:
            return frame.index if frame.index < len(motion) else None
        gaps = np.abs(self._times() - frame.time_s)
        nearest = int(np.argmin(np.where(np.isnan(gaps), np.inf, gaps)))
        return nearest if gaps[nearest] <= MAX_TIME_OFFSET_S else None

    def _is_past(self, frame: Frame) -> bool:
        """Whether poses of later frames have come already."""
        if self.motion.frames is not None:
            return int(self.motion.frames.max()) > frame.index
        if self.motion.times_s is not None:
            return float(np.nanmax(self._times())) > frame.time_s + MAX_TIME_OFFSET_S
        return False

    def _times(self) -> np.ndarray:
        """Times from the first picture on."""
        times = self.motion.times_s
        assert times is not None
        return times - self._started_at if np.nanmax(times) > MIN_EPOCH_TIME_S else times

    def _poll(self) -> None:
        """Reads the file again if it has changed; a half-written one is left for the next look."""
        try:
            status = self._path.stat()
        except OSError:
            return
        version = (status.st_mtime_ns, status.st_size)
        if version == self._version:
            return
        try:
            read = read_poses(self._path, default_model=self._default_model)
        except InputError as cause:
            self._trouble = str(cause)
            return
        if not self._has_any() and read.valid.any():
            require_plausible(read, self._path)
        self._motion = self._placed(invalidate_implausible_rows(read))
        self._version = version
        if self._motion.frames is not None:
            self._row_of = {int(number): row for row, number in enumerate(self._motion.frames)}
