"""PyAV's decoder (extra `[video]`): it says which pictures are damaged, and turns HDR into SDR."""

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import UInt8

from capture.hdr import HDR_TRANSFERS, tone_map_hdr
from capture.images import has_cutout_alpha
from capture.shot import MAX_DECODE_FAILURES, DecoderFrame, unreadable_video_error


def import_pyav() -> Any:
    """The module, which is an extra: nothing is loaded where it is not used."""
    return importlib.import_module("av")


@final
class PyAvDecoder:
    """FFmpeg by PyAV; for 8 bits the same pixels as OpenCV's."""

    knows_hdr = True

    def __init__(self, path: Path) -> None:
        """Opens the file once, to look at it, and decodes a picture.

        Raises:
            InputError: If it cannot be opened, or holds no video.
        """
        self._path = path
        av = import_pyav()
        try:
            with av.open(str(path)) as container:
                stream = container.streams.video[0]
                self.rate = float(stream.average_rate or 0.0)
                lasts_s = (container.duration or 0) / import_pyav().time_base
                self.claimed = int(stream.frames) or round(lasts_s * self.rate)
                self.deep = stream.codec_context.pix_fmt in HIGH_BIT_DEPTH_FORMATS
                first = next(self._frames(container, stream), None)
                self.leaves_alpha = first is not None and _has_transparency(first[0])
        except (av.FFmpegError, IndexError, ValueError, OSError) as cause:
            raise unreadable_video_error(path) from cause
        self.quarter_turns = 0 if first is None else int(first[0].rotation) // 90 % 4

    def decode(self) -> Iterator[DecoderFrame]:
        """The pictures in order; every call starts anew."""
        with import_pyav().open(str(self._path)) as container:
            stream = container.streams.video[0]
            start = stream.start_time or 0
            for frame, after_gap in self._frames(container, stream):
                ticks = 0 if frame.pts is None else frame.pts - start

                def rgb(frame: Any = frame) -> UInt8[np.ndarray, "height width 3"] | None:
                    return _decode_upright(frame)

                yield DecoderFrame(
                    time_s=float(ticks * stream.time_base),
                    after_gap=after_gap,
                    corrupt=bool(frame.is_corrupt),
                    rgb=rgb,
                )

    def _frames(self, container: Any, stream: Any) -> Iterator[tuple[Any, bool]]:
        """EvaluationFrames, and whether something before each could not be decoded."""
        stream.thread_type = "AUTO"
        packets, failures = container.demux(stream), 0
        while failures < MAX_DECODE_FAILURES:
            try:
                frames = next(packets).decode()
            except StopIteration:
                return
            except import_pyav().FFmpegError:
                failures += 1
                continue
            for frame in frames:
                yield frame, failures > 0
                failures = 0


HIGH_BIT_DEPTH_FORMATS = frozenset(
    {"yuv420p10le", "yuv422p10le", "yuv444p10le", "p010le", "yuv420p12le", "yuv422p12le"}
)
"""FFmpeg's names of pictures of more than 8 bits, as phones and cameras write them."""


def _has_transparency(frame: Any) -> bool:
    """Whether a frame has an alpha channel that is not opaque."""
    if not any(component.is_alpha for component in frame.format.components):
        return False
    return has_cutout_alpha(frame.to_ndarray(format="rgba")[..., 3])


def _decode_upright(frame: Any) -> UInt8[np.ndarray, "height width 3"] | None:
    try:
        if int(frame.color_trc) in HDR_TRANSFERS:
            rgb = tone_map_hdr(frame.to_ndarray(format="rgb48le"), int(frame.color_trc))
        else:
            rgb = frame.to_ndarray(format="rgb24")
    except (import_pyav().FFmpegError, ValueError):
        return None
    return np.ascontiguousarray(np.rot90(rgb, int(frame.rotation) // 90))
