"""Clips, animations, images and folders of frames, over a background or with alpha."""

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageColor

from apps.cli.output_paths import check_output_file, check_output_folder
from capture.atomic_files import atomic_file, atomic_folder
from capture.image_folder import read_image
from capture.input_error import InputError
from capture.video_encoder import ClipEncoder, video_encoder

TRANSPARENT = "transparent"
"""Value of --background that keeps alpha."""
CLIP_SUFFIXES = (".webm", ".mp4", ".gif", ".webp", ".png")
"""Suffixes of the files that can be written; a name without one is a folder of frames."""
MAX_GIF_FPS = 50.0
"""Frame rate above which browsers slow a GIF down."""

Rgba = UInt8[np.ndarray, "height width 4"]
Rgb = UInt8[np.ndarray, "height width 3"]
BackgroundBlend = Callable[[Rgba], Rgb]
"""Composites an image with straight alpha over a background."""


def background_compositor(color_or_path: str) -> BackgroundBlend:
    """Return a function that composites images with straight alpha over a background.

    Args:
        color_or_path: A color ("white", "#203040", "rgb(10, 20, 30)"), or the path of an image, of
            which the center is shown.

    Raises:
        InputError: If it is neither.
    """
    try:
        color = np.array(ImageColor.getrgb(color_or_path)[:3], dtype=np.uint8)
    except ValueError:
        color = None
    if color is not None:
        return lambda rgba: _composite_over(rgba, np.broadcast_to(color, (*rgba.shape[:2], 3)))
    path = Path(color_or_path)
    if not path.is_file():
        raise InputError(
            f"--background {color_or_path} is neither a color (white, #203040), nor {TRANSPARENT}, "
            "nor an existing image."
        )
    picture, _ = read_image(path)
    fitted = lru_cache(1)(lambda width, height: _crop_to_cover(picture, width, height))
    return lambda rgba: _composite_over(rgba, fitted(rgba.shape[1], rgba.shape[0]))


def _composite_over(rgba: Rgba, behind: Rgb) -> Rgb:
    alpha = rgba[..., 3:].astype(np.uint16)
    mixed = rgba[..., :3] * alpha + behind * (255 - alpha) + 127
    return (mixed // 255).astype(np.uint8)


def _crop_to_cover(
    picture: UInt8[np.ndarray, "_ _ 3"], width: int, height: int
) -> UInt8[np.ndarray, "height width 3"]:
    rows, columns = picture.shape[:2]
    scale = max(width / columns, height / rows)
    wide, high = max(width, round(columns * scale)), max(height, round(rows * scale))
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    scaled = cv2.resize(picture, (wide, high), interpolation=how)
    left, top = (wide - width) // 2, (high - height) // 2
    return scaled[top : top + height, left : left + width]


def check_clip_path(path: Path, inputs: Iterable[Path], *, overwrite: bool) -> None:
    """Check that a clip can be written.

    Args:
        path: A clip, an image, or a folder for frames.
        inputs: Files that are read and must not be written to.
        overwrite: Whether an existing file may be replaced.

    Raises:
        InputError: If the suffix is unknown, or the path may not be written.
    """
    if path.suffix and path.suffix.lower() not in CLIP_SUFFIXES and not path.is_dir():
        raise InputError(
            f"{path} ends in {path.suffix!r}, but a clip must end in {', '.join(CLIP_SUFFIXES)}; "
            "a name without a suffix is a folder for PNG frames."
        )
    if path.is_dir():
        if path.suffix.lower() in CLIP_SUFFIXES:
            raise InputError(
                f"{path} is a folder, but its name is that of a clip. Choose another name."
            )
    elif path.exists() and path.suffix.lower() not in CLIP_SUFFIXES:
        raise InputError(f"{path} is a file, but must be a folder for PNG frames.")
    if path.suffix.lower() in CLIP_SUFFIXES:
        check_output_file(path, "--out", inputs, overwrite=overwrite)
    else:
        check_output_folder(path, "--out", inputs)


def choose_encoder(path: Path, blend: BackgroundBlend | None) -> ClipEncoder:
    """Choose the encoder by the suffix of a path.

    Args:
        path: Clip to write.
        blend: The background; None keeps alpha.

    Raises:
        InputError: If the format has no alpha.
    """
    suffix = path.suffix.lower()
    if suffix == ".gif":
        hard = ", binary transparency" if blend is None else ""
        return ClipEncoder(description=f"a GIF of 256 colors per frame{hard}", write=_write_gif)
    if suffix == ".webp":
        return ClipEncoder(description="animated WebP", write=_write_webp)
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
    """Encode images as a clip, whole or not at all.

    Args:
        path: File or folder to write.
        images: With straight alpha, all of one size; at least one.
        fps: Frames per second.
        blend: The background; None keeps alpha.
        encoder: From `choose_encoder`.
        replace: Whether an existing file may be replaced, as in `atomic_file`.

    Returns:
        The number of frames written.

    Raises:
        OSError: If the disk is full; then nothing is written.
    """
    is_file = path.suffix.lower() in CLIP_SUFFIXES
    with atomic_file(path, replace=replace) if is_file else atomic_folder(path) as part:
        shown = (picture if blend is None else blend(picture) for picture in images)
        return encoder.write(part, iter(shown), fps)


def _encode_png(picture: UInt8[np.ndarray, "height width channels"]) -> bytes:
    # OpenCV expects BGR(A); its own file writer does not report a full disk
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
    """Write a palette per frame: 46 dB on white, against 38 dB with one palette for all."""
    first, *others = [_binarize_alpha(picture) for picture in pictures]
    ends = np.round(
        100.0 * np.arange(2 + len(others)) / min(fps, MAX_GIF_FPS)
    )  # hundredths of seconds
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
