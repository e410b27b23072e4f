"""Evidence of where the person of a capture is: given masks, or a few images without masks.

Without any, masks are estimated in reduced images.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import Frame, FrameSource
from capture.source_opening import reopen
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.silhouette_objective import (
    MaskSample,
    SilhouetteObjective,
    reduce_masks,
    sample_masks,
)
from preprocess.body.body_pose import BodyPose, Motion
from preprocess.body.body_surface import (
    NEAR_PLANE_M,
    SILHOUETTE_PERSON_PX,
    SkinPoints,
)
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_sources import MaskSource
from preprocess.observation import associate_cameras
from preprocess.plugins import DEFAULT_SEGMENTER, make_segmenter

IMAGE_PERSON_PX = 130
"""Height of the person in the reduced images by the poses, px."""
ALIGNMENT_IMAGES = 8
"""Images to align to."""
ALIGNMENT_FRAMES = 240
"""Frames at the beginning of a video over which they are spread: decoding takes longest."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageSample:
    """One frame's reduced image, and the row of the frame's camera."""

    index: int
    camera_row: int
    rgb: UInt8[np.ndarray, "height width 3"]

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        height, width = self.rgb.shape[:2]
        return int(width), int(height)


def sample_video(
    geometry: CaptureGeometry, skin: SkinPoints, cameras: CameraTrack, source: FrameSource
) -> list[ImageSample]:
    """Decode images of frames that have a pose, spread over the beginning of a recording.

    Where frames without a pose are among these, later ones take their place. The body's height in
    the images determines their size.

    Raises:
        InputError: If cameras and frames do not belong together, or no image can be used.
    """
    camera_row, chosen = associate_cameras(cameras, source), source.selection
    count = min(source.frame_count or 1, max(1, ALIGNMENT_FRAMES // chosen.step))
    stride, found = chosen.step * max(1, count // ALIGNMENT_IMAGES), []
    some = slice(chosen.start + stride // 2 // chosen.step * chosen.step, chosen.stop, stride)
    size_px: tuple[int, int] | None = None
    for frame in reopen(source, some).frames():
        row = geometry.row_for_frame(frame.index)
        if (
            row is not None
            and "corrupt" not in frame.flags
            and frame.index not in cameras.frames_without_camera
        ):
            camera = camera_row(frame.index)
            seen = geometry.camera_at(camera, source.size_px)
            size_px = size_px or thumbnail_size_px(skin, geometry.motion[row], seen)
            rgb = cv2.resize(frame.rgb, size_px, interpolation=cv2.INTER_AREA)
            found.append(ImageSample(index=frame.index, camera_row=camera, rgb=np.asarray(rgb)))
        if len(found) == ALIGNMENT_IMAGES:
            break
    if not found:
        raise InputError(f"No image of {source.path} has both a pose and a camera.")
    return found


def thumbnail_size_px(skin: SkinPoints, pose: BodyPose, camera: Camera) -> tuple[int, int]:
    """Width and height of images in which the body is about `IMAGE_PERSON_PX` high; never larger.

    The camera is of the original image's size.
    """
    width, height = camera.size_px
    points = skin.posed(pose).astype(np.float64)
    depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
    tall = (
        float(np.ptp(camera.project(points)[:, 1])) if depth.min() > NEAR_PLANE_M else float(height)
    )
    tall = float(np.clip(tall, 1.0, 2.0 * height)) if np.isfinite(tall) else float(height)
    scale = min(1.0, IMAGE_PERSON_PX / tall)
    return max(8, round(width * scale)), max(8, round(height * scale))


def estimate_silhouettes(
    geometry: CaptureGeometry, skin: SkinPoints, samples: Sequence[ImageSample]
) -> SilhouetteObjective | None:
    """The objective of masks that are estimated in a few images; None if no person is found.

    The images are of one size (`sample_video`); the body may be off by a fifth of its size.
    """
    segment, masks = make_segmenter(DEFAULT_SEGMENTER, skin.shaped), list[MaskSample]()
    for sample in samples:
        row = geometry.row_for_frame(sample.index)
        if row is None:
            continue
        camera = geometry.camera_at(sample.camera_row, sample.size_px)
        frame = Frame(index=sample.index, time_s=0.0, rgb=sample.rgb)
        try:
            alpha = segment(frame, geometry.motion[row], camera)
        except InputError:  # the person is not there, or the body is out of the image
            continue
        if (alpha > 0.5).any():
            masks.append(MaskSample(index=sample.index, camera_row=sample.camera_row, alpha=alpha))
    if not masks:
        return None
    small = reduce_masks(masks, samples[0].size_px, SILHOUETTE_PERSON_PX)
    return SilhouetteObjective(samples=small, skin=skin)


class CaptureEvidence(NamedTuple):
    """Evidence of where the person of a capture is.

    Attributes:
        source: The frames; few are decoded, and none if there are mask files.
        masks: Given masks; None if there are none.
        cameras: Cameras of the frames' size.
    """

    source: FrameSource
    masks: MaskSource | None
    cameras: CameraTrack

    @property
    def has_masks(self) -> bool:
        """True if there are mask files, or alpha channels in their place."""
        return self.masks is not None

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

        The geometry tells where masks are estimated if there are none; `person_px` is the height of
        the person in the reduced masks.
        """
        try:
            if self.masks is None:
                images = sample_video(geometry, skin, self.cameras, self.source)
                return estimate_silhouettes(geometry, skin, images)
            return sample_masks(
                self.source, self.masks, self.cameras, skin, count=count, person_px=person_px
            )
        except InputError:
            return None
