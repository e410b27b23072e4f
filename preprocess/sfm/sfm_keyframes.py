"""Key frames: the sharpest picture of each stretch of the video, and where its person is."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from capture.image_folder import list_images
from capture.input_error import InputError
from capture.source import Frame, FrameSource

MAX_KEYFRAMES = 60
"""Most key frames of a video."""

MIN_TARGET_KEYFRAMES = 24
"""Number of key frames that is chosen from a short video, if it has that many frames."""

MIN_KEYFRAME_SPACING = 4
"""Frames per key frame beyond that number: the frames between are placed as well as key frames, in
a tenth of the time."""

MIN_KEYFRAMES = 8
"""Fewest key frames that can be solved."""

FEATURE_IMAGE_PX = 960
"""Longer side of the images that features are detected in, pixels."""

PERSON_MARGIN = 0.015
"""Width of the ignored border around the person; a fraction of the image's width."""

PersonMaskFn = Callable[[Frame, tuple[int, int]], Bool[np.ndarray, "height width"] | None]
"""Where the person is in a frame, in pixels of a given size; None if unknown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SfmKeyframe:
    """One picture that is solved by features.

    Attributes:
        index: Number of the frame.
        gray: The image.
        person_mask: Pixels that are ignored: the person, and a margin.
    """

    index: int
    gray: UInt8[np.ndarray, "height width"]
    person_mask: Bool[np.ndarray, "height width"]


def feature_image_size(size_px: tuple[int, int]) -> tuple[int, int]:
    """The size in which pictures are worked on: that of the frames, at most `FEATURE_IMAGE_PX`."""
    scale = min(1.0, FEATURE_IMAGE_PX / max(size_px))
    return max(1, round(size_px[0] * scale)), max(1, round(size_px[1] * scale))


def to_grayscale(frame: Frame, size_px: tuple[int, int]) -> UInt8[np.ndarray, "height width"]:
    """A frame's brightness in the size that is worked in."""
    grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    if frame.size_px == size_px:
        return grey
    return cv2.resize(grey, size_px, interpolation=cv2.INTER_AREA)


def select_keyframes(
    source: FrameSource,
    person_in: PersonMaskFn,
    report_progress: Callable[[float], None],
    max_keyframes: int = MAX_KEYFRAMES,
) -> Iterator[SfmKeyframe]:
    """The sharpest frame of each of some equal stretches of the video, in order.

    Sharpness is the variance of the picture's Laplacian.

    Args:
        source: The frames.
        person_in: Where the person is; frames without an answer are skipped.
        report_progress: Called with the fraction of the video that was examined.
        max_keyframes: Largest number of key frames.
    """
    total = source.frame_count or source.frames_in_file
    stretches = min(max_keyframes, total, max(MIN_TARGET_KEYFRAMES, total // MIN_KEYFRAME_SPACING))
    size_px = feature_image_size(source.size_px)
    best: tuple[float, SfmKeyframe] | None = None
    at = 0
    for frame in source.frames():
        place = source.selection.position(frame.index)
        report_progress(min((place + 1) / total, 1.0))
        stretch = min(place * stretches // total, stretches - 1)
        if stretch > at and best is not None:
            yield best[1]
            best = None
        at = max(at, stretch)
        if "corrupt" in frame.flags:
            continue
        grey = to_grayscale(frame, size_px)
        sharpness = float(cv2.Laplacian(grey, cv2.CV_32F).var())
        if best is not None and sharpness <= best[0]:
            continue
        person = person_in(frame, size_px)
        if person is not None:
            best = (
                sharpness,
                SfmKeyframe(index=frame.index, gray=grey, person_mask=dilate_person(person)),
            )
    if best is not None:
        yield best[1]


def dilate_person(person: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """The person with a margin all round."""
    side = 2 * max(1, round(PERSON_MARGIN * max(person.shape))) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return cv2.dilate(person.astype(np.uint8), disc) > 0


def write_keyframes(keys: Iterator[SfmKeyframe], images: Path, masks: Path) -> list[SfmKeyframe]:
    """Writes pictures and masks (0 where nothing is looked at), named by the frames' numbers.

    Raises:
        InputError: If there are too few.
    """
    images.mkdir(parents=True)
    masks.mkdir(parents=True)
    kept = []
    for key in keys:
        name = f"{key.index:06d}.png"
        cv2.imwrite(str(images / name), key.gray)
        cv2.imwrite(str(masks / f"{name}.png"), np.where(key.person_mask, 0, 255).astype(np.uint8))
        kept.append(key)
    if len(kept) < MIN_KEYFRAMES:
        raise InputError(
            f"Only {len(kept)} frames can be used to solve cameras; at least {MIN_KEYFRAMES} sharp "
            "ones were expected in which the person is known (a mask, or a pose)."
        )
    return kept


def read_keyframes(images: Path, masks: Path) -> list[SfmKeyframe]:
    """What `write_keyframes` wrote."""
    keys = []
    for path in list_images(images):
        grey = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        free = np.asarray(cv2.imread(str(masks / f"{path.name}.png"), cv2.IMREAD_GRAYSCALE))
        keys.append(SfmKeyframe(index=int(path.stem), gray=grey, person_mask=free == 0))
    return keys
