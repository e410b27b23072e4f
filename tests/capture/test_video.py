"""Videos as they come from phones: whole, turned, cut off, rotten, HDR, or none at all."""

import os
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from capture.input_error import InputError
from capture.source_opening import GLANCES, describe_recording, glance, open_source, reopen
from capture.video import HLG, PEAK_NITS, PQ, WHITE_NITS, tone_map_hdr


def greys(frames) -> list[int]:
    return [round((float(frame.rgb[:, :28].mean()) - 20) / 11) for frame in frames]


def test_frames_come_in_order_with_their_timestamps_and_in_rgb(write_video):
    source = open_source(write_video(frames=20))
    frames = list(source.frames())
    assert source.frame_count == source.frames_in_file == 20
    assert source.size_px == (64, 48)
    assert not source.live
    assert [frame.index for frame in frames] == list(range(20))
    np.testing.assert_allclose([frame.time_s for frame in frames], np.arange(20) / 25, atol=1e-6)
    assert greys(frames) == list(range(20))
    red, blue = frames[0].rgb[10, 50], frames[0].rgb[40, 50]
    assert red[0] > 150 > 80 > red[2]
    assert blue[2] > 150 > 80 > blue[0]
    assert not source.warnings


def test_reading_again_starts_at_the_first_frame(write_video):
    source = open_source(write_video(frames=5))
    iterator = source.frames()
    next(iterator)
    assert greys(source.frames()) == [0, 1, 2, 3, 4]
    assert greys(iterator) == [1, 2, 3, 4]


@pytest.mark.parametrize(
    "chosen", [slice(3, 12, 4), slice(None, None, 7), slice(15, None), slice(0, 4), slice(2, 99)]
)
def test_a_selection_keeps_numbers_and_times(write_video, chosen):
    source = open_source(write_video(frames=20), frames=chosen)
    frames = list(source.frames())
    expected = list(range(20))[chosen]
    assert [frame.index for frame in frames] == greys(frames) == expected
    assert source.frame_count == len(expected)
    assert source.frames_in_file == 20
    np.testing.assert_allclose([f.time_s for f in frames], np.array(expected) / 25, atol=1e-6)
    assert not source.warnings


@pytest.mark.parametrize("chosen", [slice(-3, None), slice(4, 4), slice(0, 5, 0), slice(50, None)])
def test_a_selection_of_nothing_is_refused(write_video, chosen):
    with pytest.raises(InputError, match=r"(?i)frames"):
        open_source(write_video(frames=20), frames=chosen)


def test_a_turned_video_comes_upright(write_video, turned_clockwise):
    path = write_video(frames=4)
    path.write_bytes(turned_clockwise(path.read_bytes()))
    source = open_source(path)
    frames = list(source.frames())
    assert source.size_px == (48, 64) == frames[0].size_px
    upper_right_is_now_lower_right = frames[0].rgb[50, 40]
    assert upper_right_is_now_lower_right[0] > 150 > 80 > upper_right_is_now_lower_right[2]


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_a_video_that_lies_on_its_side_is_turned_clockwise(write_video, degrees):
    path = write_video(frames=4)
    stored, turned = open_source(path), open_source(path, rotate=degrees)
    frame = next(iter(turned.frames()))
    assert turned.size_px == frame.size_px == (stored.size_px if degrees == 180 else (48, 64))
    expected = np.rot90(next(iter(stored.frames())).rgb, -degrees // 90)
    np.testing.assert_array_equal(frame.rgb, expected)
    again = next(iter(reopen(turned, slice(2, 3)).frames()))
    assert (again.index, again.size_px) == (2, turned.size_px)


def test_a_recording_is_described_before_its_frames_are_read(write_video):
    path = write_video(frames=20)
    described = f"{path.name}: 20 frames of 64x48 px, 25 a second"
    assert describe_recording(open_source(path)) == described
    some = open_source(path, frames=slice(0, 20, 2))
    assert describe_recording(some).startswith(f"{path.name}: 10 of 20 frames")


def test_a_glance_decodes_a_few_places_from_the_first_to_the_last(write_video):
    source = open_source(write_video(frames=60), rotate=90)
    pairs = glance(source)
    assert len(pairs) == GLANCES
    numbers = [first.index for first, _ in pairs]
    assert numbers == sorted(set(numbers))
    assert numbers[0] < 10
    assert numbers[-1] > 40
    for first, second in pairs:
        assert 4 <= second.index - first.index <= 6  # 0.2 s
        assert first.size_px == source.size_px
    assert glance(open_source(write_video(frames=3))) == []


def test_a_truncated_video_gives_what_is_there_and_says_so(write_video):
    path = write_video(frames=40)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    source = open_source(path)
    frames = list(source.frames())
    assert 5 < len(frames) < 40
    assert greys(frames[:-1]) == [i % 20 for i in range(len(frames) - 1)]  # the last one is cut
    warning = next(told for told in source.warnings if "only" in told)
    assert f"only {len(frames)} of 40 frames" in warning
    assert "truncated" in warning
    assert source.count_frames() == len(frames)
    before_the_damage = open_source(path, frames=slice(0, 4))
    assert len(list(before_the_damage.frames())) == 4
    assert not before_the_damage.warnings


def test_a_recording_without_its_index_is_refused_with_advice(write_video):
    path = write_video()
    data = path.read_bytes()
    path.write_bytes(data[: data.find(b"moov") - 4])
    with pytest.raises(InputError, match=path.name):
        open_source(path)


@pytest.mark.parametrize(
    ("content", "word"), [(b"", "0 bytes"), (b"hello", "cannot be"), (b"no video" * 99, "cannot")]
)
def test_what_is_no_video_is_refused_with_its_cause(tmp_path, content, word, capfd):
    path = tmp_path / "video.mp4"
    with pytest.raises(InputError, match=r"video\.mp4"):  # missing
        open_source(path)
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"video\.mp4 .*{word}"):
        open_source(path)
    assert capfd.readouterr().err == ""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize(("name", "given"), [("film", "film"), ("v.mp4", ""), ("images/0.png", "")])
def test_a_pipe_is_refused_and_not_waited_for(tmp_path, name, given):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    os.mkfifo(tmp_path / name)
    for place in (tmp_path / given, Path(os.devnull)):
        with pytest.raises(InputError, match="pipe or a device"):
            open_source(place)


def test_damaged_bytes_in_the_middle_lose_no_place(write_video, rng):
    noise = [rng.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(30)]
    path = write_video(pictures=noise)
    whole = {frame.index: frame.rgb for frame in open_source(path).frames()}
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 400] = bytes(400)
    path.write_bytes(data)
    source = open_source(path)
    frames = list(source.frames())
    assert len(frames) == 30 or source.warnings
    assert [f.index for f in frames] == [round(f.time_s * 25) for f in frames]
    np.testing.assert_array_equal(frames[3].rgb, whole[frames[3].index])


def test_a_container_that_does_not_count_is_counted_and_checked_by_time(write_video):
    path = write_video("video.webm", frames=60, codec="libvpx")
    assert not list(open_source(path).warnings)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    source = open_source(path)
    assert 0 < len(list(source.frames())) < 60
    assert "truncated" in source.warnings[0]


def test_a_variable_frame_rate_keeps_the_containers_times(write_video):
    times_s = np.concatenate([np.arange(10) / 60, 10 / 60 + np.arange(10) / 15])
    source = open_source(write_video(frames=20, times_s=times_s))
    frames = list(source.frames())
    np.testing.assert_allclose([frame.time_s for frame in frames], times_s, atol=1e-5)
    assert [frame.index for frame in frames] == greys(frames) == list(range(20))
    assert not source.warnings


def test_pixels_that_are_not_square_are_named_with_a_cure(write_video):
    assert not open_source(write_video(frames=2)).warnings
    (told,) = open_source(write_video(frames=2, pixel_aspect=Fraction(4, 3))).warnings
    assert "not square" in told
    assert "scale=iw*sar:ih,setsar=1" in told


def code_of(nits: float, curve: int) -> int:
    """The 16-bit code of grey light, by the curves' own definitions (ITU-R BT.2100)."""
    if curve == PQ:
        y = (nits / 10000.0) ** 0.1593017578125
        code = ((0.8359375 + 18.8515625 * y) / (1.0 + 18.6875 * y)) ** 78.84375
    else:
        scene = (nits / PEAK_NITS) ** (1.0 / 1.2)
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        code = np.sqrt(3 * scene) if scene <= 1 / 12 else a * np.log(12 * scene - b) + c
    return round(65535 * code)


def grey(nits: float, curve: int) -> np.ndarray:
    code = np.full((2, 3, 3), code_of(nits, curve), np.uint16)
    return tone_map_hdr(code, curve)[0, 0].astype(int)


@pytest.mark.parametrize("curve", [PQ, HLG])
@pytest.mark.parametrize("share", [0.02, 0.18, 0.5, 0.7])
def test_light_below_the_knee_keeps_its_share_of_white(curve, share):
    srgb = 1.055 * share ** (1 / 2.4) - 0.055
    assert np.abs(grey(share * WHITE_NITS, curve) - 255 * srgb).max() <= 2


@pytest.mark.parametrize("curve", [PQ, HLG])
def test_highlights_are_compressed_and_not_cut_off(curve):
    levels = [int(grey(nits, curve)[0]) for nits in (0.75 * 203, 203, 400, 700, 1000)]
    assert levels == sorted(set(levels))  # each brighter than the one before
    assert levels[-1] >= 254
    assert 220 < levels[1] < 245


def test_a_grey_stays_grey_and_a_skin_tone_stays_its_hue():
    assert np.ptp(grey(100.0, PQ)) <= 1
    wide = np.array([[1.0, 0.6, 0.45]]) * 120.0
    codes = np.array([[[code_of(n, PQ) for n in wide[0]]]], np.uint16)
    low = tone_map_hdr(codes, PQ)[0, 0].astype(float)
    bright = np.array([[[code_of(4 * n, PQ) for n in wide[0]]]], np.uint16)
    high = tone_map_hdr(bright, PQ)[0, 0].astype(float)

    def hue(rgb):
        linear = (rgb / 255) ** 2.2
        return linear / linear.max()

    np.testing.assert_allclose(hue(low), hue(high), atol=0.02)


@pytest.fixture
def write_hdr(tmp_path):
    def write(curve: int, name: str = "hdr.mp4"):
        path = tmp_path / name
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx265", rate=30)
            stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p10le"
            context = stream.codec_context
            context.color_trc, context.color_primaries, context.colorspace = curve, 9, 9
            context.color_range = 1
            context.options = {"x265-params": "log-level=none", "preset": "ultrafast"}
            for index in range(6):
                frame = av.VideoFrame(128, 96, "yuv420p10le")
                for plane, level in zip(frame.planes, (700, 512, 512), strict=True):
                    rows = np.full((plane.height, plane.line_size // 2), level, np.uint16)
                    plane.update(rows.tobytes())
                frame.pts = index
                frame.color_trc, frame.color_primaries, frame.colorspace = curve, 9, 9
                for packet in stream.encode(frame):
                    container.mux(packet)
            for packet in stream.encode(None):
                container.mux(packet)
        return path

    return write


@pytest.mark.parametrize("curve", [PQ, HLG])
def test_an_hdr_video_comes_in_sdr_and_without_a_warning(write_hdr, curve):
    source = open_source(write_hdr(curve))
    frames = list(source.frames())
    expected = tone_map_hdr(np.full((1, 1, 3), round((700 - 64) / 876 * 65535), np.uint16), curve)
    assert len(frames) == 6
    assert np.abs(frames[0].rgb.astype(int) - expected.astype(int)).max() <= 3
    assert not source.warnings
