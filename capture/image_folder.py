"""A folder of images as frames, in natural order; reading and writing of one image."""

import io
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from capture.input_error import InputError
from capture.source import ASSUMED_FPS, Frame, FrameSelection, Recording

LOG_LEVEL_SILENT = 0
"""OpenCV's log level that prints nothing: our messages explain what is wrong with a file."""


@cache
def silence_opencv() -> None:
    """Silence OpenCV and its FFmpeg; to be called before a file is opened."""
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # read when FFmpeg is first used
    set_level = getattr(cv2, "setLogLevel", None)  # OpenCV 4 has it here, OpenCV 5 there
    (set_level or cv2.utils.logging.setLogLevel)(LOG_LEVEL_SILENT)


IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff"})
"""File endings of images that are read."""

EXIF_ORIENTATION = 0x0112
"""EXIF's tag of the orientation."""

EXIF_QUARTER_TURNS = {3: 2, 6: 3, 8: 1}
"""Counter-clockwise quarter turns that make a stored image upright, by EXIF's orientation."""

EXIF_TRANSPOSE = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""Pillow's operation that makes stored pixels upright, by EXIF's orientation."""

TIFF_MAGIC = (b"II*\x00", b"MM\x00*")
"""First bytes of TIFF files: their tags are EXIF's, and OpenCV turns their pixels in any mode."""

ALPHA_SAMPLES = 5
"""Number of images, evenly spread, whose alpha channel is examined."""

ALPHA_SUFFIXES = frozenset({".png", ".webp", ".bmp", ".tif", ".tiff"})
"""File endings of images that can have an alpha channel."""

MIN_TRANSPARENT_FRACTION = 0.01
"""Fraction of transparent pixels from which an alpha channel is a mask (not rounded corners)."""


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


def read_image(
    path: Path,
) -> tuple[UInt8[np.ndarray, "height width 3"], UInt8[np.ndarray, "height width"] | None]:
    """One upright image as RGB, and its alpha channel if it has one.

    Raises:
        InputError: If it cannot be decoded, or is not complete.
    """
    data = path.read_bytes()
    if not _is_complete(data):
        raise InputError(f"{path} is cut off; the file is not complete.")
    encoded = np.frombuffer(data, np.uint8)
    picture = _decode(encoded, cv2.IMREAD_UNCHANGED)
    if picture is None:
        raise InputError(f"{path} is no picture that can be decoded; it is empty or damaged.")
    alpha = None
    if picture.ndim == 3 and picture.shape[2] == 4:
        alpha = picture[..., 3]
        alpha = alpha if alpha.dtype == np.uint8 else (alpha >> 8).astype(np.uint8)
        alpha = np.ascontiguousarray(_rotate_alpha(alpha, data))
    picture = _decode(encoded, cv2.IMREAD_COLOR)  # 8 bits, turned upright by its EXIF tag
    if picture is None:
        raise InputError(f"{path} is a picture of a kind that cannot be read; expected 8-bit RGB.")
    rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    if alpha is not None and alpha.shape != rgb.shape[:2]:
        raise InputError(f"{path} has an EXIF rotation and an alpha channel; rotate its pixels.")
    return rgb, alpha


def write_png(path: Path, picture: UInt8[np.ndarray, "..."]) -> None:
    """Write a gray, RGB or RGBA image as PNG.

    Raises:
        OSError: If the disk is full, which OpenCV's own writer does not say.
    """
    if picture.ndim == 3:
        kind = cv2.COLOR_RGB2BGR if picture.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
        picture = cv2.cvtColor(picture, kind)
    path.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


def has_cutout_alpha(alpha: UInt8[np.ndarray, "height width"] | None) -> bool:
    """Return whether an alpha channel cuts the person out: an opaque one does not."""
    return alpha is not None and float((alpha < 128).mean()) >= MIN_TRANSPARENT_FRACTION


def any_has_cutout_alpha(images: Sequence[Path]) -> bool:
    """Return whether the alpha channel of any of a few images, evenly spread, cuts the person out.

    One image proves nothing: matting tools write opaque ones at first, or where nothing is found.
    """
    able = [path for path in images if path.suffix.lower() in ALPHA_SUFFIXES]
    places = np.linspace(0, len(able) - 1, min(ALPHA_SAMPLES, len(able))).round().astype(int)
    for path in (able[place] for place in places):
        try:
            alpha = read_image(path)[1]
        except (InputError, OSError):  # damaged or half written; another one says it
            continue
        if has_cutout_alpha(alpha):
            return True
    return False


def exif_orientation(data: bytes) -> int:
    """EXIF's orientation of an encoded image, 1 to 8; 1 (upright) where there is none."""
    tagged = data.startswith(TIFF_MAGIC) or any(
        mark in data for mark in (b"Exif", b"eXIf", b"EXIF")
    )
    if not tagged:  # looking closer would decode a PNG
        return 1
    try:
        with Image.open(io.BytesIO(data)) as picture:
            found = picture.getexif().get(EXIF_ORIENTATION, 1)
    except Exception:  # damaged tags; of many types, and OpenCV leaves the picture as it is, too
        return 1
    return found if found in EXIF_TRANSPOSE else 1


def _rotate_alpha(
    alpha: UInt8[np.ndarray, "_ _"], data: bytes
) -> UInt8[np.ndarray, "height width"]:
    """An alpha channel as it was stored, made upright as OpenCV makes the colors."""
    found = exif_orientation(data)
    if found == 1 or data.startswith(TIFF_MAGIC):
        return alpha
    return np.asarray(Image.fromarray(alpha).transpose(EXIF_TRANSPOSE[found]))


def _decode(encoded: UInt8[np.ndarray, "bytes"], mode: int) -> np.ndarray | None:
    silence_opencv()
    try:
        return cv2.imdecode(encoded, mode) if len(encoded) else None
    except cv2.error:  # sizes that OpenCV refuses
        return None


def _is_complete(data: bytes) -> bool:
    """Return whether a PNG or JPEG has its end: some decoders fill a missing rest in silence."""
    if data.startswith(b"\x89PNG"):
        return b"IEND" in data[-1024:]
    if data.startswith(b"\xff\xd8"):
        return b"\xff\xd9" in data[-65536:]
    return True


def _reduce(frame: Frame, longer_px: int) -> Frame:
    scale = min(1.0, longer_px / max(frame.size_px))
    size_px = [max(1, round(side * scale)) for side in frame.size_px]
    return replace(frame, rgb=cv2.resize(frame.rgb, size_px, interpolation=cv2.INTER_AREA))


class ImageFolder(Recording):
    """A folder of images; image i was taken at i / 30 s."""

    def __init__(self, path: Path, selection: FrameSelection) -> None:
        """List the folder and read the first image that can be read."""
        super().__init__(path, selection)
        self._images = list_images(path)
        self.frames_in_file = len(self._images)
        self.frame_count: int | None = selection.count(self.frames_in_file)
        if not self.frame_count:
            raise InputError(
                f"{path} holds {self.frames_in_file} pictures ({', '.join(sorted(IMAGE_SUFFIXES))})"
                f"; at least one was expected from number {selection.start} on."
            )
        self.duration_s: float | None = selection.span(self.frames_in_file) / ASSUMED_FPS
        self.size_px, self.quarter_turns = self._look()
        self.has_alpha = any_has_cutout_alpha(
            [p for i, p in enumerate(self._images) if selection.contains(i)]
        )

    def frames(self) -> Iterator[Frame]:
        """The selected images in order; every call starts from the first."""
        previous = None
        for index, path in enumerate(self._images):
            if not self.selection.contains(index):
                continue
            try:
                rgb, alpha = read_image(path)
            except (InputError, OSError) as cause:  # damaged, or the disk was unplugged
                self._warn(f"{cause} It was left out.")
                continue
            if rgb.shape[1::-1] != self.size_px:
                self._warn(
                    f"{path.name} has {rgb.shape[1]}x{rgb.shape[0]} px, the first picture "
                    f"{self.size_px[0]}x{self.size_px[1]}. It was left out."
                )
                continue
            repeated = previous is not None and np.array_equal(rgb, previous)
            flags = frozenset({"repeated"} if repeated else ())
            yield Frame(index=index, time_s=index / ASSUMED_FPS, rgb=rgb, flags=flags, alpha=alpha)
            previous = rgb

    def glance(
        self, times_s: Sequence[float], apart_s: float, longer_px: int
    ) -> Iterator[tuple[Frame, Frame]]:
        """Yield reduced images near some times, each with the one that follows it."""
        del apart_s  # photographs may be far apart
        for time_s in times_s:
            place = min(round(time_s * ASSUMED_FPS), max(0, len(self._images) - 2))
            some = FrameSelection(start=place, stop=place + 2)
            pair = [_reduce(frame, longer_px) for frame in ImageFolder(self.path, some).frames()]
            if len(pair) == 2:
                yield pair[0], pair[1]

    def count_frames(self) -> int:
        """The number of images in the folder."""
        return len(self._images)

    def _look(self) -> tuple[tuple[int, int], int]:
        """Size of the first image that can be read, and its counter-clockwise quarter turns."""
        for path in self._images:
            try:
                rgb, _ = read_image(path)
            except InputError:
                continue
            turns = EXIF_QUARTER_TURNS.get(exif_orientation(path.read_bytes()), 0)
            return (rgb.shape[1], rgb.shape[0]), turns
        raise InputError(f"None of the {len(self._images)} pictures in {self.path} can be decoded.")
