"""A live source's poses and masks, which come while it runs, joined to its frames."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from capture.image_folder import has_cutout_alpha
from capture.input_error import InputError
from capture.source import Frame, FrameSource, PacingClock
from preprocess.cameras.camera_file import CameraTrack
from preprocess.capture_paths import CapturePaths
from preprocess.live.live_alignment import LiveAlignment
from preprocess.live.live_masks import LiveMasks, check_mask_folder
from preprocess.live.live_poses import LivePoses
from preprocess.masks.given_mask_refinement import GivenMaskRefiner
from preprocess.masks.mask_origin import MaskOrigin, Segmenter, choose_mask_origin
from preprocess.observation import (
    DroppedFrame,
    Observation,
    alpha_channel_mask,
    compose_observation_builder,
    shrink_to_longer_side,
)

LATE_ALPHA_WARNING = (
    "Some of the pictures have an alpha channel that cuts the person out, but those that were "
    "there at the start had none: masks were estimated. Learn from the finished folder, without "
    "--live, to use the alpha channel."
)


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
