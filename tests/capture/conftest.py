"""Small videos and pictures, written and damaged on purpose."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.image_folder import silence_opencv

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
    def write(name: str = "video.mp4", frames: int = 20, pictures=None, codec="mp4v") -> Path:
        silence_opencv()
        path = tmp_path / name
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 25.0, SIZE)
        for rgb in [picture(i) for i in range(frames)] if pictures is None else pictures:
            writer.write(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        writer.release()
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
def index_first() -> Callable[[bytes], bytes]:
    """Moves an mp4's index to the front, as phones and web servers do."""

    def move(data: bytes) -> bytes:
        at = data.find(b"moov") - 4
        size = int.from_bytes(data[at : at + 4], "big")
        index = bytearray(data[at : at + size])
        table = index.find(b"stco")
        for entry in range(int.from_bytes(index[table + 8 : table + 12], "big")):
            place = slice(table + 12 + 4 * entry, table + 16 + 4 * entry)
            moved = int.from_bytes(index[place], "big") + size
            index[place] = moved.to_bytes(4, "big")
        head = int.from_bytes(data[:4], "big")
        return data[:head] + bytes(index) + data[head:at] + data[at + size :]

    return move


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


@pytest.fixture
def with_durations() -> Callable[[bytes, list[int]], bytes]:
    """Gives each frame of an mp4 whose index comes last a duration of its own, in its ticks."""

    def change(data: bytes, durations: list[int]) -> bytes:
        at = data.find(b"stts") - 4
        before = int.from_bytes(data[at : at + 4], "big")
        entries = b"".join((1).to_bytes(4, "big") + d.to_bytes(4, "big") for d in durations)
        count = len(durations).to_bytes(4, "big")
        table = (16 + len(entries)).to_bytes(4, "big") + b"stts" + bytes(4) + count + entries
        out = bytearray(data[:at] + table + data[at + before :])
        for kind in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
            place = out.find(kind) - 4
            size = int.from_bytes(out[place : place + 4], "big") + len(table) - before
            out[place : place + 4] = size.to_bytes(4, "big")
        return bytes(out)

    return change


@pytest.fixture
def with_pixel_aspect() -> Callable[[bytes, int, int], bytes]:
    """Writes the shape of a pixel into an mp4 whose index comes last."""

    def change(data: bytes, wide: int, high: int) -> bytes:
        box = b"".join(n.to_bytes(4, "big") for n in (16, int.from_bytes(b"pasp"), wide, high))
        out = bytearray(data)
        entry = out.find(b"stsd") + 12
        end = entry + int.from_bytes(out[entry : entry + 4], "big")
        kinds = (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd")
        for place in (entry, *(out.find(kind) - 4 for kind in kinds)):
            size = int.from_bytes(out[place : place + 4], "big") + len(box)
            out[place : place + 4] = size.to_bytes(4, "big")
        return bytes(out[:end]) + box + bytes(out[end:])

    return change
