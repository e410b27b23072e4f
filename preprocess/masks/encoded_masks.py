"""Masks of all frames in one file: a video, or COCO's run-length encoding (RLE)."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Shaped, UInt8

from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from capture.source import FrameSelection
from capture.video import DecodedFrame, VideoFile

MAX_RLE_PIXELS = 1 << 28
"""Largest number of pixels of one run-length encoded mask."""

MAX_TRACK_FRAMES = 1_000_000
"""Largest frame number that a file of tracks may name."""

VIDEO_BLACK = 16.0
"""Brightness of a video up to which alpha is 0: compression rings around edges."""
VIDEO_WHITE = 239.0
"""Brightness of a video from which alpha is 1."""

RawMaskReader = Callable[[int], Shaped[np.ndarray, "height width"]]


def open_mask_video(path: Path) -> tuple[int, RawMaskReader]:
    """Number of frames of a mask video, and the function that reads one."""
    source = VideoFile(path, FrameSelection())
    return source.frames_in_file, _MaskVideo(source).read


class _MaskVideo:
    """Random access to a video's frames; fast in ascending order."""

    def __init__(self, video: VideoFile) -> None:
        self._video = video
        self._frames: Iterator[tuple[int, DecodedFrame]] = iter(())
        self._at = -1
        self._last: Float32[np.ndarray, "height width"] | None = None

    def read(self, row: int) -> Float32[np.ndarray, "height width"]:
        """Read the mask of one frame."""
        if row == self._at and self._last is not None:
            return self._last
        if row <= self._at or self._at < 0:
            self._frames = self._video.numbered()
        self._at, frame = next((item for item in self._frames if item[0] >= row), (-1, None))
        image = frame.rgb() if frame is not None and self._at == row else None
        if image is None:
            self._at = -1  # the next call decodes from the start
            raise InputError(f"Frame {row} of the masks {self._video.path} cannot be decoded.")
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        self._last = np.clip(
            (gray - np.float32(VIDEO_BLACK)) / np.float32(VIDEO_WHITE - VIDEO_BLACK), 0.0, 1.0
        )
        return self._last


def open_rle_masks(
    content: Any, path: Path, person: str | None = None
) -> tuple[int, RawMaskReader] | None:
    """Number of run-length encoded masks, and the function that decodes one; None without any.

    Accepts a list with one mask per frame (TRAM's masks.npy; an empty entry is an empty mask), a
    dictionary by file name, a COCO file with `images` and `annotations`, or PHALP's tracks. Several
    masks of a frame are united, except PHALP's: of these `person` selects a track, None the
    longest.
    """
    frames = _track_rle(content, person) if is_phalp_tracks(content) else _frame_rle(content)
    if not frames or not any(frames):
        return None
    first = next(codes for codes in frames if codes)[0]

    def read(row: int) -> UInt8[np.ndarray, "height width"]:
        codes = frames[row] or [{**first, "counts": None}]
        try:
            return np.bitwise_or.reduce([decode_rle(code) for code in codes])
        except (ValueError, KeyError, TypeError, IndexError, OverflowError) as cause:
            raise InputError(f"Mask {row} in {path} is no run-length code ({cause}).") from cause

    return len(frames), read


def is_phalp_tracks(content: Any) -> bool:
    """Recognize PHALP's tracks with masks: {image: {tid, mask, …}} of parallel lists."""
    if not isinstance(content, dict) or not content:
        return False
    return all(isinstance(one, dict) and {"tid", "mask"} <= one.keys() for one in content.values())


def _track_rle(content: Any, person: str | None) -> list[list[dict[str, Any]]]:
    """The masks of one track; frames in which PHALP only predicted it have none."""
    seen: dict[str, dict[int, Any]] = {}
    last = -1
    for place, frame in enumerate(content.values()):
        number = int(frame.get("time", place))
        last = max(last, number)
        guessed = frame.get("tracked_time", [0] * len(frame["tid"]))
        for who, mask, lost in zip(frame["tid"], frame["mask"], guessed, strict=True):
            if not lost:
                seen.setdefault(str(int(who)), {})[number] = mask
    if not 0 <= last < MAX_TRACK_FRAMES:
        return []
    most = max(seen, key=lambda who: len(seen[who]), default="")
    rows = seen.get(most if person is None else person, {})
    return [_as_rle_list(rows.get(number)) for number in range(last + 1)]


def _frame_rle(content: Any) -> list[list[dict[str, Any]]] | None:
    if isinstance(content, dict) and {"images", "annotations"} <= content.keys():
        images = sorted(
            content["images"], key=lambda image: natural_sort_key(Path(image["file_name"]))
        )
        found: dict[Any, list[Any]] = {image["id"]: [] for image in images}
        for one in content["annotations"]:
            found.setdefault(one["image_id"], []).append(one["segmentation"])
        return [_as_rle_list(codes) for codes in found.values()]
    if isinstance(content, dict) and not _is_rle(content):
        names = sorted(content, key=lambda name: natural_sort_key(Path(str(name))))
        listed = [content[name] for name in names]
    elif isinstance(content, list):
        listed = content
    else:
        return None
    if not all(_is_rle(one) or one is None or isinstance(one, list) for one in listed):
        return None
    return [_as_rle_list(one) for one in listed]


def _as_rle_list(one: Any) -> list[dict[str, Any]]:
    listed = [one] if _is_rle(one) else (one or [])
    return [code for code in listed if _is_rle(code)]


def _is_rle(thing: Any) -> bool:
    return isinstance(thing, dict) and {"size", "counts"} <= thing.keys()


def decode_rle(code: dict[str, Any]) -> UInt8[np.ndarray, "height width"]:
    """Decode a mask of COCO's RLE: lengths of runs of 0 and 1, down the columns.

    `counts` is a list, or text that holds each length in groups of five bits, the lowest first,
    from the third length on as the difference to the length two before (COCO's maskApi). None is an
    empty mask.

    Raises:
        ValueError: If the runs do not fill the image.
    """
    height, width = (int(side) for side in code["size"])
    if not 0 < height * width <= MAX_RLE_PIXELS:
        raise ValueError(f"a size of {height}x{width}")
    counts = [height * width] if code["counts"] is None else code["counts"]
    if isinstance(counts, str | bytes):
        counts = _run_lengths(counts.encode("latin1") if isinstance(counts, str) else counts)
    lengths = np.asarray(counts, dtype=np.int64).reshape(-1)
    if (lengths < 0).any() or lengths.sum() != height * width:
        raise ValueError(f"runs that do not fill {height}x{width} pixels")
    ones = np.repeat(np.arange(len(lengths)) % 2, lengths)
    return ones.reshape(width, height).T.astype(np.uint8)


def _run_lengths(text: bytes) -> list[int]:
    lengths: list[int] = []
    value = shift = 0
    for byte in text:
        group = byte - 48
        value |= (group & 0x1F) << shift
        shift += 5
        if shift > 60:
            raise ValueError("a run that is too long")
        if group & 0x20:
            continue
        if group & 0x10:
            value -= 1 << shift
        lengths.append(value + lengths[-2] if len(lengths) > 2 else value)
        value = shift = 0
    return lengths
