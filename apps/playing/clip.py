"""Pictures to a clip, a moving picture, one picture or a folder of frames, whole or not at all."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from apps.playing.encoders import ClipEncoder, video_encoder
from apps.terminal.places import check_output_file, check_output_folder
from capture.atomic_files import atomic_file, atomic_folder
from capture.errors import InputError

CLIP_SUFFIXES = (".webm", ".mp4", ".gif", ".webp", ".png")
MAX_GIF_FPS = 50.0
"""Pictures a second of a GIF at most: browsers slow down what is faster."""

Rgba = UInt8[np.ndarray, "height width 4"]
Rgb = UInt8[np.ndarray, "height width 3"]
BackgroundBlend = Callable[[Rgba], Rgb]
"""Puts a picture with straight alpha on a background."""


def check_clip_path(path: Path, inputs: Iterable[Path], *, overwrite: bool) -> None:
    """Whether something can be written there.

    Args:
        path: A clip, a picture, or a folder for frames.
        inputs: What is read and must not be written to.
        overwrite: Whether a file that is there already may go.

    Raises:
        InputError: If the suffix is unknown, or something is there that must stay.
    """
    if path.suffix and path.suffix.lower() not in CLIP_SUFFIXES and not path.is_dir():
        raise InputError(
            f"{path} ends in {path.suffix!r}; a clip ends in {', '.join(CLIP_SUFFIXES)}, and a name "
            "without a suffix is a folder for PNG frames."
        )
    if path.is_dir():
        if path.suffix.lower() in CLIP_SUFFIXES:
            raise InputError(f"{path} is a folder, but its name is that of a clip. Name another.")
    elif path.exists() and path.suffix.lower() not in CLIP_SUFFIXES:
        raise InputError(f"{path} is a file; a folder for PNG frames was expected.")
    if path.suffix.lower() in CLIP_SUFFIXES:
        check_output_file(path, "--out", inputs, overwrite=overwrite)
    else:
        check_output_folder(path, "--out", inputs)


def choose_encoder(path: Path, blend: BackgroundBlend | None) -> ClipEncoder:
    """How a clip of that name is written here.

    Args:
        path: Decides by its suffix.
        blend: The background; None keeps alpha.

    Raises:
        InputError: If alpha cannot be kept there.
    """
    suffix = path.suffix.lower()
    if suffix == ".gif":
        hard = ", edges hard, for a GIF knows no half transparency" if blend is None else ""
        return ClipEncoder(description=f"a GIF of 256 colours a picture{hard}", write=_write_gif)
    if suffix == ".webp":
        return ClipEncoder(description="WebP, which browsers show like a picture", write=_write_webp)
    if suffix == ".png":
        return ClipEncoder(description="PNG", write=_write_png)
    if suffix not in CLIP_SUFFIXES:
        return ClipEncoder(description="PNG frames", write=_write_frames)
    return video_encoder(suffix, transparent=blend is None)


def write_clip(
    path: Path,
    images: Iterable[Rgba],
    *,
    fps: float,
    blend: BackgroundBlend | None,
    encoder: ClipEncoder,
    replace: bool | None = None,
) -> int:
    """Writes pictures as the encoder does.

    Args:
        path: Where to.
        pictures: With straight alpha, all of one size; at least one.
        fps: Pictures a second.
        blend: The background; None keeps alpha.
        encoder: From `choose_encoder`.
        replace: Whether a file that is there already may go, as of `atomic_file`.

    Returns:
        How many pictures were written.

    Raises:
        OSError: If the disk is full; then nothing is written.
    """
    is_file = path.suffix.lower() in CLIP_SUFFIXES
    with atomic_file(path, replace=replace) if is_file else atomic_folder(path) as part:
        shown = (picture if blend is None else blend(picture) for picture in images)
        return encoder.write(part, iter(shown), fps)


def _encode_png(picture: UInt8[np.ndarray, "height width channels"]) -> bytes:
    # OpenCV wants BGR(A), and its own writer does not say when the disk is full
    code = cv2.COLOR_RGBA2BGRA if picture.shape[2] == 4 else cv2.COLOR_RGB2BGR
    return cv2.imencode(".png", cv2.cvtColor(picture, code))[1].tobytes()


def _write_png(path: Path, pictures: Iterator[Rgba | Rgb], fps: float) -> int:
    path.write_bytes(_encode_png(next(pictures)))
    return 1


def _write_frames(folder: Path, pictures: Iterator[Rgba | Rgb], fps: float) -> int:
    count = 0
    for picture in pictures:
        (folder / f"{count:04d}.png").write_bytes(_encode_png(picture))
        count += 1
    return count


def _write_gif(path: Path, pictures: Iterator[Rgba | Rgb], fps: float) -> int:
    """A palette a picture: 46 dB on white, where one palette for all has 38 dB."""
    first, *others = [_binarize_alpha(picture) for picture in pictures]
    ends = np.round(100.0 * np.arange(2 + len(others)) / min(fps, MAX_GIF_FPS))  # hundredths of seconds
    frame_ms = [int(10 * step) for step in np.diff(ends)]
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    first.save(path, disposal=2 if first.mode == "RGBA" else 0, **moving)
    return 1 + len(others)


def _binarize_alpha(picture: Rgba | Rgb) -> Image.Image:
    if picture.shape[2] == 3:
        return Image.fromarray(picture)
    hard = picture.copy()
    hard[..., 3] = np.where(hard[..., 3] > 127, 255, 0)
    hard[hard[..., 3] == 0] = 0
    return Image.fromarray(hard)


def _write_webp(path: Path, pictures: Iterator[Rgba | Rgb], fps: float) -> int:
    first, *others = [Image.fromarray(picture) for picture in pictures]
    ends = np.round(1000.0 * np.arange(2 + len(others)) / fps)
    frame_ms = [max(1, int(step)) for step in np.diff(ends)]
    moving = {"save_all": True, "append_images": others, "duration": frame_ms, "loop": 0}
    first.save(path, format="WEBP", quality=90, method=3, **(moving if others else {}))
    return 1 + len(others)
