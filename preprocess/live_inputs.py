"""A live source's poses and masks, which other programs still write, joined to its frames.

Each frame waits for its pose and its mask; the file of poses is read again whenever it has changed.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
from jaxtyping import Float32

from capture.image_folder import has_cutout_alpha, list_images
from capture.input_error import InputError
from capture.source import Frame, FrameSource, PacingClock
from preprocess.alignment.mask_alignment import LiveAlignment
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.cameras.camera_file import CameraTrack
from preprocess.capture_paths import CapturePaths, MaskOrigin, choose_mask_origin
from preprocess.masks.mask_files import Masks, read_mask
from preprocess.masks.mask_refinement import GivenMaskRefiner
from preprocess.observation import (
    DroppedFrame,
    Observation,
    alpha_channel_mask,
    compose_observation_builder,
    shrink_to_longer_side,
)
from preprocess.plugins import Segmenter, segmenter_name
from preprocess.poses.plausibility import invalidate_implausible_rows, require_plausible
from preprocess.poses.pose_format_registry import read_poses

MAX_WAIT_S = 2.0
"""So long after it was filmed a frame waits for its pose or its mask; then it is left out."""
POLL_INTERVAL_S = 0.02
MIN_EPOCH_TIME_S = 1e8
"""Times beyond this are no seconds of a clip."""
MAX_TIME_OFFSET_S = 0.02
"""Of a pose whose time is given: how far it may lie from its frame's."""
LATE_ALPHA_WARNING = (
    "Some of the pictures have an alpha channel that cuts the person out, but those that were "
    "there at the start had none: masks were estimated. Learn from the finished folder, without "
    "--live, to use the alpha channel."
)


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


def check_mask_folder(named: Path | None) -> None:
    """Refuse what --masks names for a live source, unless it is a folder or a segmenter.

    Raises:
        InputError: If it is neither.
    """
    if named is not None and segmenter_name(named) is None and not named.is_dir():
        raise InputError(
            f"There is no folder of masks {named}. Give --masks: the folder to which "
            "they will be written, or segmenter:blazepose to have them estimated."
        )


class _InvertedMask(InputError):  # noqa: N818 - a finding, not an error
    """A mask that is inverted unlike those before it: waiting does not help."""


@final
class LiveMasks:
    """The masks of a live source: a folder of images, written one after the other.

    A mask belongs to the image of the same name; a camera's frames have no names: there it is the
    last number in the mask's name that counts. Unless it is given, the polarity is that of most
    masks so far, of the first if they are even; masks of the other polarity are refused.
    """

    def __init__(
        self, path: Path, pace: PacingClock, *, invert: bool | None, patience_s: float = MAX_WAIT_S
    ) -> None:
        """Remember the folder; masks are read on demand.

        Args:
            path: The folder.
            pace: Clock of the source; stopping it ends every wait.
            invert: Whether the person is dark; None detects it from the masks.
            patience_s: Time after its capture that a frame waits for its mask, seconds.
        """
        self._path, self._pace, self._invert, self._patience_s = path, pace, invert, patience_s
        self._by_name: dict[str, Path] = {}
        self._by_number: dict[int, Path] = {}
        self._ways: list[bool] = []

    def wait_for_mask(
        self, frame: Frame, size_px: tuple[int, int]
    ) -> Float32[np.ndarray, "height width"]:
        """Wait for the mask of a frame and scale it to an image's size.

        Raises:
            InputError: If it did not come in time, cannot be read, has another aspect ratio, or is
                inverted unlike most.
        """
        deadline = (self._pace.now() if frame.due_s is None else frame.due_s) + self._patience_s
        while True:
            try:
                path = self._find_file(frame)
                if path is not None:
                    return self._read(path, size_px)
                trouble = InputError(f"no mask within {self._patience_s:g} s")
            except _InvertedMask:
                raise
            except InputError as cause:  # the file may be half written
                trouble = cause
            if self._pace.now() >= deadline or self._pace.stopped:
                raise trouble
            self._pace.wait_until(min(deadline, self._pace.now() + POLL_INTERVAL_S))

    def _read(self, path: Path, size_px: tuple[int, int]) -> Float32[np.ndarray, "height width"]:
        stored = read_mask(path)
        if self._invert is not None:
            return Masks(path, 1, lambda row: stored, invert=self._invert).alpha(0, size_px)
        if not stored.any():  # an empty mask has no polarity
            return np.zeros(size_px[::-1], dtype=np.float32)
        before = self._majority_inverted()
        try:
            turned = Masks(path, 1, lambda row: stored, invert=None).inverted
        except InputError:  # full or undecidable; the reading below refuses what is no mask
            if before is None:
                raise
            return Masks(path, 1, lambda row: stored, invert=before).alpha(0, size_px)
        alpha = Masks(path, 1, lambda row: stored, invert=turned).alpha(0, size_px)
        self._ways.append(turned)
        if turned != self._majority_inverted():
            raise _InvertedMask(f"{path.name} is inverted unlike most masks so far")
        return alpha

    def _majority_inverted(self) -> bool | None:
        """Whether the person is dark in most masks so far; None if there was none."""
        if not self._ways:
            return None
        dark = 2 * sum(self._ways) - len(self._ways)
        return dark > 0 if dark else self._ways[0]

    def _find_file(self, frame: Frame) -> Path | None:
        found = self._known_file(frame)
        if found is None and self._path.is_dir():
            self._by_name, self._by_number = {}, {}
            for path in list_images(self._path):
                self._by_name[path.stem] = path
                numbers = re.findall(r"\d+", path.stem)
                if numbers:
                    self._by_number[int(numbers[-1])] = path
            found = self._known_file(frame)
        return found

    def _known_file(self, frame: Frame) -> Path | None:
        if frame.name is not None:
            return self._by_name.get(frame.name)
        return self._by_number.get(frame.index)


@dataclass(frozen=True, eq=False, kw_only=True)
class LiveInputs:
    """What is written beside a live source by other programs.

    Attributes:
        poses: The tracker's.
        masks: The segmenter's; None if the alpha channel is the mask, or masks are estimated.
        choice: Which masks are used.
        pace: The clock by which both are waited for.
    """

    poses: LivePoses
    masks: LiveMasks | None
    choice: MaskOrigin
    pace: PacingClock

    @classmethod
    def open(
        cls,
        paths: CapturePaths,
        source: FrameSource,
        pace: PacingClock,
        *,
        family: str,
        invert: bool | None,
        first_within_s: float,
        given_masks: Path | None = None,
    ) -> "LiveInputs":
        """Waits for the first pose; then what there is by way of masks is what is used.

        Args:
            paths: Where the parts lie or will lie.
            source: The frames.
            pace: The clock by which parts are waited for.
            family: Body family of pose files that do not say theirs.
            invert: Whether the person is dark in the masks; None finds out.
            first_within_s: How long the first pose may take.
            given_masks: What --masks names, if it was given.

        Raises:
            InputError: If no pose comes, or what --masks names is no folder.
        """
        check_mask_folder(given_masks)
        poses = LivePoses(
            paths.poses, pace, default_model=family, first_within_s=first_within_s,
            started_at=source.started_at,
        )  # fmt: skip
        found = paths.masks if paths.masks is not None and paths.masks.is_dir() else None
        choice = choose_mask_origin(given_masks, found, has_alpha=source.has_alpha)
        masks = None if choice.path is None else LiveMasks(choice.path, pace, invert=invert)
        return cls(poses=poses, masks=masks, choice=choice, pace=pace)

    def observation_builder(
        self,
        source: FrameSource,
        cameras: CameraTrack,
        size_px: int | None,
        *,
        segment: Segmenter | None = None,
        refine: GivenMaskRefiner | None = None,
        fit: LiveAlignment | None = None,
    ) -> Callable[[Frame], Observation | DroppedFrame]:
        """What makes an observation of a frame, waiting for its pose and its mask.

        Args:
            source: The frames.
            cameras: One, that stands still.
            size_px: Longer side of the observations.
            segment: What estimates masks, where none are waited for.
            refine: What refines those that are.
            fit: What fits the poses to another body than their tracker's, if that is needed.

        Raises:
            InputError: If there are several cameras: their frames are not known yet.
        """
        if cameras.is_moving:
            raise InputError(
                f"{cameras.source} holds {len(cameras.cameras)} cameras; a live source has one "
                "that stands still."
            )
        alpha_of = alpha_channel_mask if self.masks is None else self.masks.wait_for_mask
        target_px = shrink_to_longer_side(source.size_px, size_px)
        pose_of = self.poses.wait_for_pose
        if fit is not None and not fit.uses_masks:
            pose_of = fit.align_poses(pose_of, cameras[0])
        seen = compose_observation_builder(
            pose_of, alpha_of, lambda index: cameras[0], target_px, segment=segment, refine=refine
        )
        if self.choice.is_fallback:
            seen = _warn_of_late_alpha(seen, source)
        return fit.align_observations(seen) if fit is not None and fit.uses_masks else seen


def _warn_of_late_alpha(
    seen: Callable[[Frame], Observation | DroppedFrame], source: FrameSource
) -> Callable[[Frame], Observation | DroppedFrame]:
    """The same, with a warning once a picture comes whose alpha channel would have been a mask."""

    def observed(frame: Frame) -> Observation | DroppedFrame:
        if has_cutout_alpha(frame.alpha) and LATE_ALPHA_WARNING not in source.warnings:
            source.warnings.append(LATE_ALPHA_WARNING)
        return seen(frame)

    return observed
