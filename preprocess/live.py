"""A live source's poses and masks, which come while it runs, joined to its frames."""

from collections.abc import Callable
from dataclasses import dataclass

from capture.errors import BadInput
from capture.frame import Frame
from capture.pace import Pace
from capture.source import Source
from preprocess.camera_file import CameraTrack
from preprocess.capture_folder import CapturePaths
from preprocess.fit.growing import GrowingFit
from preprocess.growing_poses import GrowingPoses
from preprocess.masks.growing import GrowingMasks
from preprocess.masks.segmenter import Segmenter
from preprocess.observation import Observation
from preprocess.observe import Dropped, joiner, own_alpha, shrunk


@dataclass(frozen=True, eq=False, kw_only=True)
class LiveParts:
    """What is written beside a live source by other programs.

    Attributes:
        poses: The tracker's.
        masks: The segmenter's; None if the pictures have an alpha channel.
        pace: The clock by which both are waited for.
    """

    poses: GrowingPoses
    masks: GrowingMasks | None
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
        estimated: bool = False,
    ) -> "LiveParts":
        """Waits for the first pose.

        Args:
            paths: Where the parts lie or will lie.
            source: The frames.
            pace: The clock by which parts are waited for.
            family: Body family of pose files that do not say theirs.
            invert: Whether the person is dark in the masks; None finds out.
            first_within_s: How long the first pose may take.
            estimated: Whether masks will be estimated, so that none are waited for.

        Raises:
            BadInput: If no pose comes, or there is no folder of masks where one is needed.
        """
        masks = None
        if not (source.has_alpha or estimated):
            if paths.masks is None or not paths.masks.is_dir():
                raise BadInput(
                    f"There is no folder of masks {paths.masks}. Give --masks: the folder to which "
                    "they will be written, or segmenter:grabcut to have them estimated."
                )
            masks = GrowingMasks(paths.masks, pace, invert=invert)
        poses = GrowingPoses(
            paths.poses, pace, default_model=family, first_within_s=first_within_s,
            started_at=source.started_at,
        )  # fmt: skip
        return cls(poses=poses, masks=masks, pace=pace)

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
        return fit.observing(seen) if fit is not None and fit.masked else seen
