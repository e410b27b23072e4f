"""Masks of a capture's frames: read from files or alpha channels, or estimated from the images."""

from collections.abc import Callable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import final

import cv2
import numpy as np

from capture.atomic_files import RESERVED_PREFIX, OutputFileList
from capture.camera import Camera, same_aspect_ratio
from capture.image_folder import has_cutout_alpha, list_images, read_image
from capture.input_error import InputError
from capture.source import AlphaMask, Frame, FrameSource
from preprocess.body.body_pose import BodyPose
from preprocess.frame_association import associate_by_name, associate_by_order
from preprocess.masks.mask_files import Masks
from preprocess.masks.mask_refinement import GivenMaskRefiner
from preprocess.plugins import Segmenter

UNREFINED = GivenMaskRefiner(enabled=False)
"""Masks stay as they are."""


class MaskSource:
    """Masks of the frames of one capture, asked for in the frames' order.

    Attributes:
        origin: Where they come from, as the report says it.
        is_given: Whether they can be read before their frames are seen, and so tell where the
            person is, whatever the poses.
    """

    origin: str
    is_given = False

    @property
    def agreement(self) -> float | None:
        """Agreement of estimated masks with the posed body, if it is known."""
        return None

    @property
    def needs_all_frames(self) -> bool:
        """Return whether a mask depends on the frames before it."""
        return True

    @property
    def is_refined(self) -> bool:
        """Return whether given masks are refined, by the frames that were seen."""
        return False

    def check(self) -> None:
        """Raise an InputError if they do not belong to the frames."""

    def read(self, index: int, size_px: tuple[int, int]) -> AlphaMask:
        """Read the given mask of a frame's number, scaled; an InputError if there is none."""
        raise InputError(f"the mask of frame {index} is not known before the frame")

    def alpha(self, frame: Frame, scaled: Frame, pose: BodyPose, camera: Camera) -> AlphaMask:
        """The mask of a frame, in [0, 1]; an InputError if there is none.

        `scaled` is the frame, as it was filmed, at the mask's and the camera's size.
        """
        raise NotImplementedError

    def notes(self) -> Iterator[str]:
        """Messages for the user that need the frames to have come."""
        yield from ()


class GivenMasks(MaskSource):
    """Masks that are read, and refined where the frames that were seen show that they need it."""

    is_given = True

    def __init__(self, origin: str, refine: GivenMaskRefiner) -> None:
        """Read nothing yet."""
        self.origin, self.refine = origin, refine

    @property
    def needs_all_frames(self) -> bool:
        """Return whether they may be refined."""
        return not self.refine.keeps_given_masks

    @property
    def is_refined(self) -> bool:
        """Return whether they are refined, by the frames that were seen."""
        return self.refine.is_needed

    def alpha(self, frame: Frame, scaled: Frame, pose: BodyPose, camera: Camera) -> AlphaMask:
        """Read the mask of a frame, and refine it if that is needed."""
        if self.refine.keeps_given_masks:
            return self._of_frame(frame, scaled.size_px)
        return self.refine(frame.rgb, self._of_frame(frame, frame.size_px), scaled.size_px)

    def notes(self) -> Iterator[str]:
        """Say that they were refined."""
        if self.refine.note is not None:
            yield self.refine.note

    def _of_frame(self, frame: Frame, size_px: tuple[int, int]) -> AlphaMask:
        return self.read(frame.index, size_px)


@final
class StoredMasks(GivenMasks):
    """Masks of a file or a folder."""

    def __init__(
        self, files: Masks, source: FrameSource, refine: GivenMaskRefiner = UNREFINED
    ) -> None:
        """Read nothing yet; whether files and frames belong together is found when it matters."""
        super().__init__(files.path.name, refine)
        self.files, self._source = files, source

    @cached_property
    def row_of(self) -> Callable[[int], int]:
        """From a frame's number to its mask's row; an InputError if they do not fit together."""
        return associate_masks(self.files, self._source)

    def check(self) -> None:
        """Raise an InputError if files and frames do not belong together."""
        self.row_of  # noqa: B018 - it is found here

    def read(self, index: int, size_px: tuple[int, int]) -> AlphaMask:
        """Read the mask of a frame's number, which may be beyond the video's."""
        row = self.row_of(index)
        if not 0 <= row < self.files.count:
            raise InputError(f"There is no mask for frame {index} in {self.files.path}.")
        return self.files.alpha(row, size_px)

    def in_order_at_worst(self) -> "StoredMasks":
        """These masks, taken in order if there are more or fewer of them than frames."""
        masks = StoredMasks(self.files, self._source, self.refine)
        try:
            masks.check()
        except InputError:
            if not same_aspect_ratio(self.files.size_px, self._source.size_px):
                raise
            masks.row_of = int
        return masks


@final
class AlphaChannelMasks(GivenMasks):
    """The images' own alpha channel."""

    def __init__(self, source: FrameSource, refine: GivenMaskRefiner = UNREFINED) -> None:
        """Read nothing yet."""
        super().__init__("alpha channel", refine)
        self._source = source

    @cached_property
    def _paths(self) -> list[Path]:
        return list_images(self._source.path)  # only images have alpha channels

    def read(self, index: int, size_px: tuple[int, int]) -> AlphaMask:
        """Read the alpha channel of an image."""
        try:
            rgb, alpha = read_image(self._paths[index])
        except OSError as cause:
            raise InputError(f"image {index} cannot be read ({cause})") from cause
        frame = Frame(index=index, time_s=0.0, rgb=rgb, alpha=alpha).turn(self._source.rotate)
        if frame.size_px != self._source.size_px:
            raise InputError(f"image {index} is of another size than the others")
        return alpha_channel_mask(frame, size_px)

    def _of_frame(self, frame: Frame, size_px: tuple[int, int]) -> AlphaMask:
        return alpha_channel_mask(frame, size_px)


@final
class EstimatedMasks(MaskSource):
    """Masks that a segmenter finds in the images."""

    def __init__(self, segment: Segmenter) -> None:
        """Estimate nothing yet."""
        self.origin = f"estimated by {getattr(segment, 'name', type(segment).__name__)}"
        self._segment = segment

    @property
    def agreement(self) -> float | None:
        """Agreement with the posed body, if the segmenter knows it."""
        return getattr(self._segment, "agreement", None)

    def alpha(self, frame: Frame, scaled: Frame, pose: BodyPose, camera: Camera) -> AlphaMask:
        """Estimate the mask of a frame."""
        return self._segment(scaled, pose, camera)


def associate_masks(masks: Masks, source: FrameSource) -> Callable[[int], int]:
    """Map a frame's number to its mask's row; raises where they do not fit, or there is none."""
    if not same_aspect_ratio(masks.size_px, source.size_px):
        raise InputError(
            f"The masks in {masks.path} have {masks.size_px[0]}x{masks.size_px[1]} px, the frames "
            f"{source.size_px[0]}x{source.size_px[1]}; expected the same shape. Was the video "
            "cropped, rotated or stretched (ffmpeg -vf "
            f"scale={masks.size_px[0]}:{masks.size_px[1]} undoes that)?"
        )
    unfinished = masks.path.name.startswith(RESERVED_PREFIX)
    if masks.names is not None and (unfinished or OutputFileList(masks.path).exists()):  # our own
        rows = {int(name): row for row, name in enumerate(masks.names) if name.isdecimal()}
        if len(rows) == masks.count and max(rows) < source.frames_in_file:
            return partial(_row_by_name, rows, masks.path)
    if masks.names is not None and masks.count not in (source.frames_in_file, source.frame_count):
        named = associate_by_name(masks.names, source)
        if named is not None:
            return partial(_row_by_name, named, masks.path)
    return associate_by_order(masks.count, source, f"masks in {masks.path}")


def _row_by_name(named: dict[int, int], path: Path, index: int) -> int:
    """Row of a frame's mask by its name; some frames have none."""
    if index not in named:
        raise InputError(f"{path} holds none for frame {index}")
    return named[index]


def alpha_channel_mask(frame: Frame, size_px: tuple[int, int]) -> AlphaMask:
    """The image's own alpha channel, scaled; an InputError if it cuts nothing out."""
    if frame.alpha is None:
        raise InputError("the picture has no alpha channel")
    if not has_cutout_alpha(frame.alpha):
        raise InputError("the picture's alpha channel is opaque, unlike that of others")
    alpha = frame.alpha.astype(np.float32) / 255.0
    if frame.size_px == size_px:
        return alpha
    return cv2.resize(alpha, size_px, interpolation=cv2.INTER_AREA)
