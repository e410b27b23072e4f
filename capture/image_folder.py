"""A folder of images as frames, in natural order; reading and writing of one image."""

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageOps

from capture.input_error import InputError, counted
from capture.source import (
    ASSUMED_FPS,
    Frame,
    FrameSelection,
    FrameSource,
    RgbImage,
    shrink_to_longer_side,
)

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff"})
"""File endings of images that are read."""


def natural_sort_key(path: Path) -> list[tuple[int, str]]:
    """Sort `image_9` before `image_10`."""
    return [
        (int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)
    ]


def list_images(folder: Path) -> list[Path]:
    """The images in a folder, in natural order; an InputError if a pipe has the name of one."""
    images = (file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
    found = sorted((file for file in images if not file.name.startswith(".")), key=natural_sort_key)
    for file in found:
        refuse_pipe(file)
    return found


def refuse_pipe(path: Path) -> None:
    """Refuse what is neither a file nor a folder: it may be waited for without end."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(
            f"{path} is a pipe or a device; a file or a folder was expected. Store what comes from "
            "it in a file first, or name a camera as camera:0."
        )


def read_image(path: Path) -> tuple[RgbImage, UInt8[np.ndarray, "height width"] | None]:
    """One image as RGB, upright by its EXIF tag, and its alpha channel if it has one.

    An InputError if it cannot be decoded, or is not complete.
    """
    try:
        with Image.open(path) as stored:
            stored.load()
            image = ImageOps.exif_transpose(stored)
            if image.mode.startswith("I;16"):  # Pillow would clip it to 255
                image = Image.fromarray((np.asarray(image) >> 8).astype(np.uint8))
            has_alpha = image.has_transparency_data
            pixels = np.array(image.convert("RGBA" if has_alpha else "RGB"))  # writable
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as cause:
        raise InputError(
            f"{path} is no picture that can be decoded: it is empty, cut off or damaged ({cause})."
        ) from cause
    alpha = np.ascontiguousarray(pixels[..., 3]) if has_alpha else None
    return np.ascontiguousarray(pixels[..., :3]), alpha


def write_png(path: Path, picture: UInt8[np.ndarray, "..."]) -> None:
    """Write a gray, RGB or RGBA image; OpenCV's own writer does not say if the disk is full."""
    if picture.ndim == 3:
        kind = cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        picture = cv2.cvtColor(picture, kind)
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def has_cutout_alpha(alpha: UInt8[np.ndarray, "height width"] | None) -> bool:
    """Return whether an alpha channel cuts the person out: an opaque one does not."""
    return alpha is not None and float((alpha < 128).mean()) >= 0.01  # not rounded corners


def any_has_cutout_alpha(images: Sequence[Path]) -> bool:
    """Return whether the alpha channel of any of a few images, evenly spread, cuts the person out.

    One image proves nothing: matting tools write opaque ones at first, or where nothing is found.
    """
    able = [path for path in images if path.suffix.lower() not in (".jpg", ".jpeg")]
    places = np.linspace(0, len(able) - 1, min(5, len(able))).round().astype(int)
    for path in (able[place] for place in places):
        try:
            alpha = read_image(path)[1]
        except InputError:  # damaged or half written; another one says it
            continue
        if has_cutout_alpha(alpha):
            return True
    return False


def resize_frame(frame: Frame, size_px: tuple[int, int]) -> Frame:
    """The frame at another width and height."""
    if frame.size_px == size_px:
        return frame
    alpha = frame.alpha
    return replace(
        frame,
        rgb=cv2.resize(frame.rgb, size_px, interpolation=cv2.INTER_AREA),
        alpha=None if alpha is None else cv2.resize(alpha, size_px, interpolation=cv2.INTER_AREA),
    )


class ImageFolder(FrameSource):
    """A folder of images; image i was taken at i / 30 s."""

    def __init__(self, path: Path, selection: FrameSelection) -> None:
        """List the folder and read the first image that can be read."""
        super().__init__(path, selection)
        self._images = list_images(path)
        self.frames_in_file = len(self._images)
        self.frame_count = selection.count(self.frames_in_file)
        if not self.frame_count:
            raise InputError(
                f"{path} holds {counted(self.frames_in_file, 'picture')} "
                f"({', '.join(sorted(IMAGE_SUFFIXES))}); at least one was "
                f"expected from number {selection.start} on."
            )
        self.duration_s = selection.span(self.frames_in_file) / ASSUMED_FPS
        self.size_px = self._look()
        self.has_alpha = any_has_cutout_alpha(
            [p for i, p in enumerate(self._images) if selection.contains(i)]
        )

    def frames(self) -> Iterator[Frame]:
        """The selected images in order; every call starts from the first."""
        for index, path in enumerate(self._images):
            if not self.selection.contains(index):
                continue
            try:
                rgb, alpha = read_image(path)
            except InputError as cause:  # damaged, or the disk was unplugged
                self._warn(f"{cause} It was left out.")
                continue
            if self._is_of_size(path.name, rgb):
                yield Frame(index=index, time_s=index / ASSUMED_FPS, rgb=rgb, alpha=alpha)

    def glance(
        self, times_s: Sequence[float], apart_s: float, longer_px: int
    ) -> Iterator[tuple[Frame, Frame]]:
        """Yield reduced images near some times, each with the one that follows it."""
        del apart_s  # photographs may be far apart
        size_px = shrink_to_longer_side(self.size_px, longer_px)
        for time_s in times_s:
            place = min(round(time_s * ASSUMED_FPS), max(0, len(self._images) - 2))
            some = FrameSelection(start=place, stop=place + 2)
            pair = [resize_frame(frame, size_px) for frame in ImageFolder(self.path, some).frames()]
            if len(pair) == 2:
                yield pair[0], pair[1]

    def count_frames(self) -> int:
        """The number of images in the folder."""
        return len(self._images)

    def _look(self) -> tuple[int, int]:
        """Size of the first image that can be read."""
        for path in self._images:
            with suppress(InputError):
                rgb, _ = read_image(path)
                return rgb.shape[1], rgb.shape[0]
        raise InputError(f"None of the {len(self._images)} pictures in {self.path} can be decoded.")
