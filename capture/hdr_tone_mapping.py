"""Tone mapping of HDR video (HLG, PQ) to the 8-bit sRGB of other images."""

from functools import cache

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16

from capture.source import RgbImage

PQ = 16
"""Transfer characteristics of SMPTE ST 2084 (code of ITU-T H.273)."""
HLG = 18
"""Transfer characteristics of ARIB STD-B67 (code of ITU-T H.273)."""
HDR_TRANSFERS = frozenset({PQ, HLG})
"""Codes of all HDR transfer curves."""
WHITE_NITS = 203.0
"""Luminance of diffuse white in HDR (ITU-R BT.2408), which maps to white; cd/m²."""
PEAK_NITS = 1000.0
"""Luminance of the brightest highlight that stays distinct; cd/m²."""
TONE_MAP_KNEE = 0.75
"""Fraction of white from which light is compressed, so that the peak becomes white."""
BT709_FROM_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
"""Linear BT.709 from linear BT.2020 (ITU-R BT.2087)."""
STRIP_ROWS = 16
"""Rows that are converted at once: those of a 4K image stay in the processor's cache."""
LUT_SIZE = 4096
"""Entries of the table from code values to linear light (12 bits)."""


def tone_map_hdr(rgb: UInt16[np.ndarray, "height width 3"], curve: int) -> RgbImage:
    """8-bit sRGB of a 16-bit image in BT.2020 with an HDR curve.

    Light is linearised, white scaled to `WHITE_NITS` and colors converted to BT.709; above the knee
    all three channels are compressed by one factor, which preserves hues.
    """
    strips = range(0, len(rgb), STRIP_ROWS)
    return np.concatenate([_tone_map_strip(rgb[top : top + STRIP_ROWS], curve) for top in strips])


def _tone_map_strip(
    rgb: UInt16[np.ndarray, "rows width 3"], curve: int
) -> UInt8[np.ndarray, "rows width 3"]:
    light = np.take(_linear_light_lut(curve), rgb >> 4)
    if curve == HLG:  # the display's gamma of 1.2 for the luminance (ITU-R BT.2100)
        luma = light @ np.array([0.2627, 0.6780, 0.0593], np.float32)
        light *= np.power(np.maximum(luma, 1e-6), np.float32(0.2))[..., None]
    light *= np.float32(PEAK_NITS / WHITE_NITS)
    light = cv2.transform(light, BT709_FROM_BT2020)
    brightest = np.maximum(light[..., 0], np.maximum(light[..., 1], light[..., 2]))
    brightest = np.maximum(brightest, np.float32(1e-6))
    light *= (_compress_highlights(brightest) / brightest)[..., None]
    codes = np.clip(light * np.float32(LUT_SIZE - 1), 0.0, LUT_SIZE - 1).astype(np.uint16)
    return np.take(_srgb_lut(), codes)


def _compress_highlights(light: Float32[np.ndarray, "..."]) -> Float32[np.ndarray, "..."]:
    """Light up to the knee as it is, and the rest on a smooth curve that ends at the peak in 1.

    y = k + r t / (1 + t (1 - r / s)) with t = (x - k) / r, r = 1 - k and s = peak - k: slope 1 at
    the knee, 1 at the peak.
    """
    room, span = 1.0 - TONE_MAP_KNEE, PEAK_NITS / WHITE_NITS - TONE_MAP_KNEE
    t = (light - np.float32(TONE_MAP_KNEE)) / np.float32(room)
    bent = TONE_MAP_KNEE + room * t / (1.0 + t * (1.0 - room / span))
    return np.where(t > 0.0, np.minimum(bent, 1.0), light).astype(np.float32)


@cache
def _linear_light_lut(curve: int) -> Float32[np.ndarray, "4096"]:
    """Linear light of each code, 1 at the peak of 1,000 nits."""
    code = np.linspace(0.0, 1.0, LUT_SIZE)
    if curve == HLG:
        a, b, c = 0.17883277, 0.28466892, 0.55991073
        light = np.where(code <= 0.5, code**2 / 3.0, (np.exp((code - c) / a) + b) / 12.0)
    else:
        m1, m2, c1, c2, c3 = 0.1593017578125, 78.84375, 0.8359375, 18.8515625, 18.6875
        root = code ** (1.0 / m2)
        light = 10000.0 * (np.maximum(root - c1, 0.0) / (c2 - c3 * root)) ** (1.0 / m1)
        light = np.minimum(light / PEAK_NITS, 1.0)
    return light.astype(np.float32)


@cache
def _srgb_lut() -> UInt8[np.ndarray, "4096"]:
    light = np.linspace(0.0, 1.0, LUT_SIZE)
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1.0 / 2.4) - 0.055)
    return np.round(255.0 * code).astype(np.uint8)
