"""What shows where the person of a recording is: masks that are given, or estimated ones."""

from typing import NamedTuple

from capture.input_error import InputError
from capture.source import FrameSource
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.image_alignment import estimate_silhouettes, sample_video
from preprocess.alignment.silhouette_objective import SilhouetteObjective, sample_masks
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import SILHOUETTE_PERSON_PX, SkinPoints
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_files import Masks
from preprocess.observation import associate_cameras, associate_masks


class CaptureEvidence(NamedTuple):
    """What shows where the person of a capture is.

    Attributes:
        source: The frames; few are decoded, and none if there are mask files.
        masks: The masks; None if the images have an alpha channel, or there are none.
        cameras: Cameras of the frames' size.
    """

    source: FrameSource
    masks: Masks | None
    cameras: CameraTrack

    @property
    def has_masks(self) -> bool:
        """Whether there are mask files, or alpha channels in their place."""
        return self.masks is not None or self.source.has_alpha

    def geometry(self, motion: Motion) -> CaptureGeometry:
        """The geometry of a motion, as the files state it."""
        return CaptureGeometry.of(motion, self.cameras, self.source)

    def silhouettes(
        self,
        skin: SkinPoints,
        geometry: CaptureGeometry,
        count: int,
        person_px: int = SILHOUETTE_PERSON_PX,
    ) -> SilhouetteObjective | None:
        """The objective of a few masks; None where parts do not fit (reported elsewhere).

        Args:
            skin: The person.
            geometry: Poses and cameras: where masks are estimated if there are none.
            count: Number of frames.
            person_px: Height of the person in the reduced masks, px.
        """
        try:
            if not self.has_masks:
                images = sample_video(geometry, skin, self.cameras, self.source)
                return estimate_silhouettes(geometry, skin, images)
            rows = (
                associate_masks(self.masks, self.source),
                associate_cameras(self.cameras, self.source),
            )
            return sample_masks(
                self.source, self.masks, *rows, skin, count=count, person_px=person_px,
                excluded_frames=self.cameras.frames_without_camera,
            )  # fmt: skip
        except InputError:
            return None
