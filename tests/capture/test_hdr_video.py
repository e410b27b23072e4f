"""HDR is brought to the colors of other pictures."""

import av
import numpy as np
import pytest

from capture.source_opening import open_source
from capture.video import HLG, PEAK_NITS, PQ, WHITE_NITS, tone_map_hdr


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
