"""Videos that are still being received: pieces in any order, breaks, and frames as they come."""

import threading

import av
import numpy as np
import pytest

from capture.input_error import InputError
from capture.received_video import ReceivedFile, ReceivedVideo
from capture.source import FrameSelection, PacingClock

FRAMES, SIZE = 12, (256, 192)


def film(path, codec, **options):
    """A small film; each frame is brighter than the one before."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options={"g": "4", **options})
        stream.width, stream.height = SIZE
        stream.pix_fmt = "yuv420p"
        for k in range(FRAMES):
            image = np.full((SIZE[1], SIZE[0], 3), 20 * k, dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return path.read_bytes()


def receive(path, content, size, piece=400):
    """A thread that sends pieces as the file asks for them; the order it asked in."""
    file, order = ReceivedFile(path, size), []

    def send():
        while not file.ended:
            offset = file.next_offset()
            order.append(offset)
            file.write(offset, content[offset : offset + piece])
            if size is None and file.received == len(content):
                file.end()

    return threading.Thread(target=send), order


def opened(path):
    return ReceivedVideo(path, FrameSelection(), PacingClock(), idle_s=5.0)


@pytest.mark.parametrize(
    ("name", "codec", "options", "how"),
    [
        ("film.mov", "mpeg4", {}, "whole"),
        ("film.mov", "libx265", {"x265-params": "log-level=none"}, "turned"),
        ("film.webm", "libvpx", {}, "whole"),
        ("film.webm", "libvpx", {}, "streamed"),
    ],
)
def test_every_frame_comes_upright_and_the_original_is_whole(
    tmp_path, turned_clockwise, name, codec, options, how
):
    if codec not in av.codecs_available:
        pytest.skip(f"PyAV has no {codec} here")
    content = film(tmp_path / f"made-{name}", codec, **options)
    content = turned_clockwise(content) if how == "turned" else content
    sender, _ = receive(tmp_path / name, content, None if how == "streamed" else len(content))
    sender.start()
    source = opened(tmp_path / name)
    frames = list(source.frames())
    sender.join()
    assert source.size_px == (SIZE[::-1] if how == "turned" else SIZE)
    assert [frame.size_px for frame in frames] == [source.size_px] * FRAMES
    assert np.all(np.diff([float(frame.rgb.mean()) for frame in frames]) > 0.0)
    assert (tmp_path / name).read_bytes() == content


def test_an_index_at_the_end_is_fetched_before_the_images(tmp_path):
    content = film(tmp_path / "made.mov", "mpeg4")
    sender, order = receive(tmp_path / "film.mov", content, len(content))
    sender.start()
    sender.join()
    index = content.index(b"moov") - 4
    assert order[1] == index
    assert sorted(order[1:])[0] == 400


def test_pieces_that_overlap_and_come_again_are_one_file(tmp_path):
    file = ReceivedFile(tmp_path / "film.webm", None)
    for offset, content in ((0, b"abcd"), (2, b"cdef"), (0, b"ab")):
        file.write(offset, content)
    assert (file.received, file.next_offset()) == (6, 6)
    assert file.path.read_bytes() == b"abcdef"


def test_a_film_that_ends_before_a_frame_says_why(tmp_path):
    file = ReceivedFile(tmp_path / "film.mp4", 5000)
    file.write(0, bytes(100))
    file.end("The phone fell silent for 30 s: the film ends here.")
    with pytest.raises(InputError, match="fell silent"):
        opened(file.path)
