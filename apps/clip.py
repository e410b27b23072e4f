"""Pictures to a clip or a folder of frames, whole or not at all."""

import errno
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

from apps.whole import whole_file, whole_folder
from capture.errors import BadInput
from capture.quiet import silence_opencv

FOURCC = {".webm": "VP80", ".mp4": "mp4v"}
"""VP8 plays in every browser and is encoded three times as fast as VP9."""
CLIPS = (".webm", ".mp4", ".gif")

Rgba = UInt8[np.ndarray, "height width 4"]
Rgb = UInt8[np.ndarray, "height width 3"]
Blend = Callable[[Rgba], Rgb]
"""Puts a picture with straight alpha on a background."""


def check_clip(path: Path) -> None:
    """Whether something can be written there.

    Raises:
        BadInput: If the suffix is unknown, or a folder holds something other than frames.
    """
    if path.suffix and path.suffix.lower() not in CLIPS and not path.is_dir():
        raise BadInput(
            f"{path} ends in {path.suffix!r}; a clip ends in {', '.join(CLIPS)}, and a name "
            "without a suffix is a folder for PNG frames."
        )
    if path.is_dir():
        if path.suffix.lower() in CLIPS:
            raise BadInput(f"{path} is a folder, but its name is that of a clip. Name another.")
        others = [f.name for f in path.iterdir() if not re.fullmatch(r"\d{4,}\.png", f.name)]
        if others:
            raise BadInput(
                f"{path} holds {others[0]} and would be replaced by frames. Name an empty or a new "
                "folder."
            )
    elif path.exists() and path.suffix.lower() not in CLIPS:
        raise BadInput(f"{path} is a file; a folder for PNG frames was expected.")


def write_clip(path: Path, pictures: Iterable[Rgba], *, fps: float, blend: Blend) -> int:
    """Writes pictures by the path's suffix; without one, as RGBA frames 0000.png, 0001.png, …

    Args:
        path: Where to.
        pictures: With straight alpha, all of one size.
        fps: Pictures a second.
        blend: The background of clips; frames keep their alpha.

    Returns:
        How many pictures were written.

    Raises:
        OSError: If the disk is full; then nothing is written.
    """
    suffix = path.suffix.lower()
    if suffix not in CLIPS:
        with whole_folder(path) as part:
            return _write_frames(part, pictures)
    with whole_file(path) as part:
        if suffix == ".gif":
            return _write_gif(part, (blend(picture) for picture in pictures), fps)
        return _write_video(part, (blend(picture) for picture in pictures), fps, FOURCC[suffix])


def _write_frames(folder: Path, pictures: Iterable[Rgba]) -> int:
    count = 0
    for picture in pictures:
        # OpenCV wants BGRA, and its own writer does not say when the disk is full
        code = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGBA2BGRA))[1]
        (folder / f"{count:04d}.png").write_bytes(code.tobytes())
        count += 1
    return count


def _write_gif(path: Path, pictures: Iterator[Rgb], fps: float) -> int:
    first, *others = [Image.fromarray(picture) for picture in pictures]
    frame_ms = max(20, round(1000.0 / fps))  # browsers slow down anything shorter
    first.save(path, save_all=True, append_images=others, duration=frame_ms, loop=0)
    return 1 + len(others)


def _write_video(path: Path, pictures: Iterator[Rgb], fps: float, code: str) -> int:
    silence_opencv()
    path.write_bytes(bytes(1 << 16))  # OpenCV does not say that there is no room; Python does
    writer, count = None, 0
    try:
        for picture in pictures:
            even = _even(picture)
            if writer is None:
                size_px = (even.shape[1], even.shape[0])
                fourcc = cv2.VideoWriter.fourcc(*code)
                with _quiet():
                    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, fps, size_px)
                if not writer.isOpened():
                    raise BadInput(
                        f"This OpenCV cannot write {code} video. Choose another of "
                        f"{', '.join(CLIPS)}, or a folder of frames."
                    )
            writer.write(np.ascontiguousarray(even[..., ::-1]))
            count += 1
    finally:
        if writer is not None:
            writer.release()
    _check_video(path, count)
    return count


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps FFmpeg from saying on stderr that WebM names its codecs in another way."""
    sys.stderr.flush()
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _even(picture: Rgb) -> UInt8[np.ndarray, "even_height even_width 3"]:
    """Video codecs want even sizes: the last row or column is doubled where needed."""
    height, width = picture.shape[:2]
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _check_video(path: Path, count: int) -> None:
    """OpenCV does not say when it could not write; so the file is read again."""
    video, found = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG), 0
    while video.grab():
        found += 1
    video.release()
    if found != count:
        raise OSError(errno.ENOSPC, f"only {found} of {count} frames could be written", str(path))
