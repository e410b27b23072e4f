"""Video files, written from images by PyAV."""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import UInt8

from capture.input_error import InputError, quote_command
from capture.work_ahead import read_ahead

Pixels = UInt8[np.ndarray, "height width channels"]


@dataclass(frozen=True, kw_only=True)
class VideoCodec:
    """One way to encode a video, by FFmpeg's names; described for the user."""

    name: str
    pixel_format: str
    options: dict[str, str] = field(default_factory=dict)
    description: str

    def check_available(self) -> None:
        """Refuse an encoder that this build of PyAV lacks, as those of some distributions do."""
        if self.name not in av.codecs_available:
            install = quote_command(sys.executable, "-m", "pip", "install", "--force-reinstall")
            raise InputError(
                f"PyAV {av.__version__} here cannot write {self.description.split(',')[0]}: it was "
                f"built without {self.name}, which its wheels have: {install} --only-binary av av. "
                "Other suffixes need other encoders (.mp4, .webm, .webp, .gif)."
            )


_VP9 = {"crf": "22", "b:v": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"}
H264 = VideoCodec(
    name="libx264",
    pixel_format="yuv420p",
    options={"crf": "17", "preset": "medium"},
    description="H.264, which plays everywhere",
)
"""For .mp4."""
VP9 = VideoCodec(
    name="libvpx-vp9", pixel_format="yuv420p", options=_VP9, description="VP9, which browsers play"
)
"""For .webm."""
VP9_ALPHA = VideoCodec(
    name="libvpx-vp9",
    pixel_format="yuva420p",
    options={**_VP9, "auto-alt-ref": "0"},  # alpha needs frames that hide no others
    description="VP9 with alpha, which Chrome and Firefox show",
)
"""For .webm with transparency."""
FFV1 = VideoCodec(name="ffv1", pixel_format="bgr0", description="FFV1, which is lossless")
"""For .mp4 and .mkv whose pixels matter: every bit is kept."""


def write_video(path: Path, images: Iterable[Pixels], fps: float, codec: VideoCodec) -> int:
    """Write images of one size, RGB or RGBA with straight alpha, as a video; return their number.

    The file's suffix selects the container. An OSError if the disk is full.
    """
    count = 0
    with open_video_writer(path, fps, codec) as write:
        for image in read_ahead(images):
            write(image)
            count += 1
    return count


@contextmanager
def open_video_writer(
    path: Path, fps: float, codec: VideoCodec
) -> Iterator[Callable[[Pixels], None]]:
    """Open a video to write; yield the function that appends an image (see `write_video`)."""
    codec.check_available()
    is_rgb = codec.pixel_format == "bgr0"
    container_options = {"movflags": "+faststart"} if path.suffix.lower() == ".mp4" else {}
    with av.open(str(path), "w", options=container_options) as container:
        stream: Any = container.add_stream(
            codec.name, rate=Fraction(fps).limit_denominator(10_000), options=dict(codec.options)
        )
        stream.pix_fmt = codec.pixel_format
        if not is_rgb:  # tags of ITU-T H.273, so that every player shows the same colors
            context = stream.codec_context
            context.colorspace = context.color_primaries = context.color_trc = 1  # BT.709
            context.color_range = ColorRange.MPEG
        count = 0

        def write(image: Pixels) -> None:
            nonlocal count
            height, width = image.shape[:2]
            if not is_rgb:  # chroma has half the size
                image = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if not count:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(image), format="rgb24" if image.shape[2] == 3 else "rgba"
            )
            if is_rgb:
                frame = frame.reformat(format=codec.pixel_format)
            else:
                frame = frame.reformat(
                    format=codec.pixel_format,
                    src_color_range=ColorRange.JPEG,
                    dst_color_range=ColorRange.MPEG,
                    dst_colorspace=Colorspace.ITU709,
                )
            frame.pts = count
            container.mux(stream.encode(frame))
            count += 1

        yield write
        if count:
            container.mux(stream.encode(None))
