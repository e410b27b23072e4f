"""A live source's poses and masks, which come while it runs, joined to its frames."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from capture.errors import BadInput
from capture.frame import Frame
from capture.images import cuts_out
from capture.pace import Pace
from capture.source import Source
from preprocess.camera_file import CameraTrack
from preprocess.capture_folder import CapturePaths
from preprocess.fit.growing import GrowingFit
from preprocess.growing_poses import GrowingPoses
from preprocess.masks.choice import MaskChoice, choose_masks
from preprocess.masks.growing import GrowingMasks
from preprocess.masks.segmenter import Segmenter, segmenter_name
from preprocess.observation import Observation
from preprocess.observe import Dropped, joiner, own_alpha, shrunk

ALPHA_CAME_LATE = (
    "Some of the pictures have an alpha channel that cuts the person out, but those that were "
    "there at the start had none: masks were estimated. Learn from the finished folder, without "
    "--live, to use the alpha channel."
)


@dataclass(frozen=True, eq=False, kw_only=True)
class LiveParts:
    """What is written beside a live source by other programs.

    Attributes:
        poses: The tracker's.
        masks: The segmenter's; None if the alpha channel is the mask, or masks are estimated.
        choice: Which masks are used.
        pace: The clock by which both are waited for.
    """

    poses: GrowingPoses
    masks: GrowingMasks | None
    choice: MaskChoice
    pace: Pace

    @classmethod
    def open(
        cls,
        paths: CapturePaths,
        source: Source,
        pace: Pace,
        *,
        family: str,
        invert: bool | None,
        first_within_s: float,
        given_masks: Path | None = None,
    ) -> "LiveParts":
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
            BadInput: If no pose comes, or what --masks names is no folder.
        """
        named = given_masks if segmenter_name(given_masks) is None else None
        if named is not None and not named.is_dir():
            raise BadInput(
                f"There is no folder of masks {named}. Give --masks: the folder to which "
                "they will be written, or segmenter:grabcut to have them estimated."
            )
        poses = GrowingPoses(
            paths.poses, pace, default_model=family, first_within_s=first_within_s,
            started_at=source.started_at,
        )  # fmt: skip
        found = paths.masks if paths.masks is not None and paths.masks.is_dir() else None
        choice = choose_masks(given_masks, found, has_alpha=source.has_alpha)
        masks = None if choice.path is None else GrowingMasks(choice.path, pace, invert=invert)
        return cls(poses=poses, masks=masks, choice=choice, pace=pace)

    def observer(
        self,
        source: Source,
        cameras: CameraTrack,
        size_px: int | None,
        segment: Segmenter | None = None,
        fit: GrowingFit | None = None,
    ) -> Callable[[Frame], Observation | Dropped]:
        """What makes an observation of a frame, waiting for its pose and its mask.

        Args:
            source: The frames.
            cameras: One, that stands still.
            size_px: Longer side of the observations.
            segment: What estimates masks, where none are waited for.
            fit: What fits the poses to another body than their tracker's, if that is needed.

        Raises:
            BadInput: If there are many cameras: nobody knows yet whose they are.
        """
        if cameras.moves:
            raise BadInput(
                f"{cameras.source} holds {len(cameras.cameras)} cameras; a live source has one "
                "that stands still."
            )
        alpha_of = own_alpha if self.masks is None else self.masks.of
        target_px = shrunk(source.size_px, size_px)
        pose_of = self.poses.of
        if fit is not None and not fit.masked:
            pose_of = fit.posing(pose_of, cameras[0])
        seen = joiner(pose_of, alpha_of, lambda index: cameras[0], target_px, segment=segment)
        if self.choice.fallback:
            seen = _noticing_alpha(seen, source)
        return fit.observing(seen) if fit is not None and fit.masked else seen


def _noticing_alpha(
    seen: Callable[[Frame], Observation | Dropped], source: Source
) -> Callable[[Frame], Observation | Dropped]:
    """The same, with a warning once a picture comes whose alpha channel would have been a mask."""

    def observed(frame: Frame) -> Observation | Dropped:
        if cuts_out(frame.alpha) and ALPHA_CAME_LATE not in source.warnings:
            source.warnings.append(ALPHA_CAME_LATE)
        return seen(frame)

    return observed
