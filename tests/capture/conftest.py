"""Small videos and pictures, written and damaged on purpose."""

from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

SIZE = (64, 48)


def picture(index: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Grey on the left by frame number (mod 20); red above blue on the right."""
    width, height = size
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[:, : width // 2] = 20 + 11 * (index % 20)
    rgb[: height // 2, width // 2 :, 0] = 220
    rgb[height // 2 :, width // 2 :, 2] = 220
    return rgb


@pytest.fixture
def write_video(tmp_path) -> Callable[..., Path]:
    """Writes a video; an mp4's index comes first, as phones and web servers write it."""

    def write(
        name="video.mp4", frames=20, pictures=None, codec="mpeg4", times_s=None, pixel_aspect=1
    ) -> Path:
        path = tmp_path / name
        options = {"movflags": "+faststart"} if name.endswith(".mp4") else {}
        with av.open(str(path), "w", options=options) as container:
            stream = container.add_stream(codec, rate=25 if times_s is None else 600)
            stream.width, stream.height = SIZE
            stream.pix_fmt = "bgr0" if codec == "ffv1" else "yuv420p"
            stream.codec_context.sample_aspect_ratio = pixel_aspect
            shown = [picture(i) for i in range(frames)] if pictures is None else pictures
            for index, rgb in enumerate(shown):
                frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
                frame.pts = index if times_s is None else round(600 * times_s[index])
                container.mux(stream.encode(frame))
            container.mux(stream.encode(None))
        return path

    return write


@pytest.fixture
def write_images(tmp_path) -> Callable[..., Path]:
    def write(count: int = 12, name: str = "shots", suffix: str = ".png") -> Path:
        folder = tmp_path / name
        folder.mkdir()
        for index in range(count):
            bgr = cv2.cvtColor(picture(index), cv2.COLOR_RGB2BGR)
            cv2.imwrite(str(folder / f"shot_{index}{suffix}"), bgr)
        return folder

    return write


@pytest.fixture
def turned_clockwise() -> Callable[[bytes], bytes]:
    """Writes "show me turned by 90° clockwise" into an mp4's track header."""

    def turn(data: bytes) -> bytes:
        out = bytearray(data)
        matrix = out.find(b"tkhd") + 4 + 4 + 20 + 8 + 8
        numbers = [0, 1 << 16, 0, -(1 << 16), 0, 0, 0, 0, 1 << 30]
        out[matrix : matrix + 36] = b"".join(n.to_bytes(4, "big", signed=True) for n in numbers)
        return bytes(out)

    return turn
