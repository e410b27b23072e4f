"""The color of every place of the person: stripes, cloth, skin and face as functions of place.

A place is a point of the undressed template (metres), never a pixel or a vertex: so colors stick
to the body in every pose and are as sharp as the picture can show.
"""

import numpy as np

from avatar.kernels.kernel_compiler import compile_kernel
from instant_avatar.studio.outfit import (
    BELT_Y,
    CUFF,
    EYE,
    HAIR,
    HEM,
    SHIRT,
    SHOE,
    SLEEVE,
    TROUSERS,
    Measures,
    Palette,
    neckline,
    smoothstep,
)

# What each row of a palette colors.
TONE, LIPS, HAIR_TONE, IRIS, CLOTH, STRIPE, TRIM, DENIM, DENIM_STRIPE, THREAD, UPPER, SOLE = range(
    12
)

SrgbColor = tuple[float, float, float]
"""sRGB in [0, 1]."""
SYMMETRY_PLANE_X = -0.002
"""The template's plane of symmetry."""
STRIPE_M = 0.04
"""Width of a stripe of shirt and trousers."""


@compile_kernel(nogil=True, forceinline=True)
def _hash(i: int, j: int, k: int, seed: int) -> np.float32:
    """A number in [-1, 1) that depends on all its bits."""
    h = np.uint32(i) * np.uint32(374761393) + np.uint32(j) * np.uint32(668265263)
    h = np.uint32(
        h + np.uint32(k) * np.uint32(2246822519) + np.uint32(seed) * np.uint32(3266489917)
    )
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(1274126177))
    h = np.uint32(h ^ (h >> np.uint32(16)))
    return np.float32(h) * np.float32(2.0 / 4294967296.0) - np.float32(1.0)


@compile_kernel(nogil=True)
def value_noise(x: float, y: float, z: float, cell: float, seed: np.uint32) -> float:
    """Smooth noise in [-1, 1] with a grain of `cell` metres.

    Seeds are `np.uint32`: for each plain integer in a kernel numba would compile it once more.
    """
    x, y, z = x / cell + 500.0, y / cell + 500.0, z / cell + 500.0
    i, j, k = int(x), int(y), int(z)
    u, v, w = smoothstep(x - i, 0.0, 1.0), smoothstep(y - j, 0.0, 1.0), smoothstep(z - k, 0.0, 1.0)
    total = 0.0
    for corner in range(8):
        a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
        total += weight * _hash(i + a, j + b, k + c, seed)
    return total


@compile_kernel(nogil=True, forceinline=True)
def _lerp(a: SrgbColor, b: SrgbColor, share: float) -> SrgbColor:
    return (
        a[0] + (b[0] - a[0]) * share,
        a[1] + (b[1] - a[1]) * share,
        a[2] + (b[2] - a[2]) * share,
    )


@compile_kernel(nogil=True, forceinline=True)
def _scale(a: SrgbColor, factor: float) -> SrgbColor:
    return a[0] * factor, a[1] * factor, a[2] * factor


@compile_kernel(nogil=True, forceinline=True)
def _swatch(palette: Palette, row: int) -> SrgbColor:
    return palette[row, 0], palette[row, 1], palette[row, 2]


@compile_kernel(nogil=True, forceinline=True)
def _stripe_wave(value: float, width: float, blur: float) -> float:
    """Square wave in [0, 1]: stripes of one width, edges `blur` metres soft."""
    phase = value / (2.0 * width)
    fold = abs(phase - np.floor(phase) - 0.5) * 2.0 * width  # 0 … width, one period = 2 widths
    return smoothstep(fold, 0.5 * width - blur, 0.5 * width + blur)


@compile_kernel(nogil=True)
def _shirt(
    x: float, y: float, z: float, palette: Palette, cut: Measures, checked: bool
) -> SrgbColor:
    side = abs(x - SYMMETRY_PLANE_X)
    on_sleeve = side > 0.172 and y > 0.08
    along = side if on_sleeve else y
    if on_sleeve:
        around = np.arctan2(z - 0.012, y - 0.255) * 0.055
    else:
        around = np.arctan2(x - SYMMETRY_PLANE_X, z - 0.03) * 0.14
    first = _stripe_wave(along + 0.004, STRIPE_M, 0.0015)
    cloth, stripe = _swatch(palette, CLOTH), _swatch(palette, STRIPE)
    if checked:
        second = _stripe_wave(around, STRIPE_M, 0.0015)
        thin = _stripe_wave(along + 0.02, 0.5 * STRIPE_M, 0.001) * _stripe_wave(
            around + 0.02, 0.02, 0.001
        )
        color = _lerp(cloth, stripe, 0.42 * first + 0.42 * second)
        color = _lerp(color, _swatch(palette, TRIM), 0.30 * thin)
    else:
        color = _lerp(cloth, stripe, first)
    edge = min(cut[SLEEVE] - side, y - cut[HEM], 0.9 * (neckline(x, z, cut) - y))
    color = _lerp(_swatch(palette, TRIM), color, smoothstep(edge, 0.019, 0.021))
    seam = min(abs(side - 0.172) if y > 0.08 else 1.0, abs(edge - 0.020))
    color = _scale(color, 0.80 + 0.20 * smoothstep(seam, 0.0008, 0.0035))
    pocket = max(abs(x - 0.075) - 0.042, abs(y - 0.150) - 0.048)
    if z > 0.06:
        color = _scale(color, 0.72 + 0.28 * smoothstep(abs(pocket), 0.0008, 0.0030))
        if pocket < 0.0 and y > 0.180:
            color = _lerp(_swatch(palette, TRIM), color, 0.25)
    grain = 0.060 * value_noise(x, y, z, 0.018, np.uint32(1)) + 0.040 * value_noise(
        x, y, z, 0.010, np.uint32(2)
    )
    return _scale(color, 1.0 + grain)


@compile_kernel(nogil=True)
def _trousers(x: float, y: float, z: float, palette: Palette, cut: Measures) -> SrgbColor:
    side = abs(x - SYMMETRY_PLANE_X)
    axis_x = 0.118 + 0.040 * smoothstep(-y, 0.25, 1.1)
    axis_z = 0.020 - 0.055 * smoothstep(-y, 0.3, 1.1)
    angle = np.arctan2(z - axis_z, side - axis_x)
    color = _lerp(
        _swatch(palette, DENIM),
        _swatch(palette, DENIM_STRIPE),
        _stripe_wave(angle * 0.0764, STRIPE_M, 0.0015),
    )
    worn = np.exp(-(((y + 0.52) / 0.16) ** 2)) * smoothstep(z, 0.03, 0.10)
    color = _lerp(color, (0.78, 0.82, 0.88), 0.20 * worn)
    thread = min(abs(angle - 0.05) * 0.09, abs(y - cut[CUFF] - 0.028))
    if y > BELT_Y - 0.22 and z > 0.05:
        thread = min(thread, abs(np.hypot(side - 0.19, y + 0.15) - 0.11))
    color = _lerp(_swatch(palette, THREAD), color, 0.35 + 0.65 * smoothstep(thread, 0.0008, 0.0028))
    grain = 0.075 * value_noise(x, y, z, 0.018, np.uint32(3)) + 0.060 * value_noise(
        x, y, z, 0.010, np.uint32(4)
    )
    return _scale(color, 1.0 + grain)


@compile_kernel(nogil=True)
def _skin(x: float, y: float, z: float, palette: Palette) -> SrgbColor:
    tone = _swatch(palette, TONE)
    side = abs(x - SYMMETRY_PLANE_X)
    warm = 0.0
    if side > 0.78:
        warm = 0.35 * smoothstep(side, 0.84, 0.91)
    color = _scale(
        tone,
        1.0
        + 0.030 * value_noise(x, y, z, 0.020, np.uint32(5))
        + 0.015 * value_noise(x, y, z, 0.009, np.uint32(6)),
    )
    if y < 0.34 or z < 0.06:
        ear = smoothstep(0.040 - np.hypot(z - 0.066, y - 0.478), 0.0, 0.02) * smoothstep(
            side, 0.07, 0.085
        )
        return _lerp(color, _swatch(palette, LIPS), 0.5 * warm + 0.30 * ear)
    cheek = np.exp(-(((side - 0.045) / 0.018) ** 2) - ((y - 0.458) / 0.018) ** 2)
    nose = np.exp(-((side / 0.016) ** 2) - ((y - 0.462) / 0.012) ** 2) * smoothstep(z, 0.165, 0.185)
    color = _lerp(color, _swatch(palette, LIPS), 0.30 * cheek + 0.25 * nose)
    # The socket is a little darker, and so is the side of the nose.
    socket = np.exp(-(((side - 0.030) / 0.020) ** 2) - ((y - 0.506) / 0.011) ** 2)
    flank = np.exp(-(((side - 0.013) / 0.006) ** 2) - ((y - 0.480) / 0.020) ** 2)
    nostril = np.exp(-(((side - 0.008) / 0.0045) ** 2) - ((y - 0.4525) / 0.0030) ** 2)
    color = _scale(
        color, 1.0 - 0.16 * socket - 0.12 * flank - 0.45 * nostril * smoothstep(z, 0.165, 0.175)
    )
    if z > 0.12:
        color = _mouth(color, side, y, palette)
        color = _brow_and_lashes(color, side, y, palette)
    return color


@compile_kernel(nogil=True)
def _mouth(color: SrgbColor, side: float, y: float, palette: Palette) -> SrgbColor:
    share = side / 0.027
    if share >= 1.0:
        return color
    round_ = 1.0 - share * share
    upper = (
        0.4290 + 0.0045 * share * share + 0.0100 * round_ - 0.0025 * np.exp(-((side / 0.004) ** 2))
    )
    lower = 0.4290 + 0.0045 * share * share - 0.0120 * np.sqrt(round_)
    inside = smoothstep(upper - y, -0.0008, 0.0012) * smoothstep(y - lower, -0.0008, 0.0015)
    color = _lerp(color, _swatch(palette, LIPS), 0.80 * inside)
    parting = smoothstep(0.0019 - abs(y - 0.4290 - 0.0045 * share * share), 0.0, 0.0012)
    return _scale(color, 1.0 - 0.55 * parting)


@compile_kernel(nogil=True)
def _brow_and_lashes(color: SrgbColor, side: float, y: float, palette: Palette) -> SrgbColor:
    dark = _scale(_swatch(palette, HAIR_TONE), 0.75)
    along = (side - 0.012) / 0.042
    if 0.0 < along < 1.0:
        ridge = 0.5240 + 0.0055 * np.sin(2.6 * along) - 0.0040 * along
        thick = 0.0034 * (1.0 - 0.60 * along)
        brow = smoothstep(thick - abs(y - ridge), -0.0008, 0.0014) * smoothstep(along, 0.0, 0.10)
        color = _lerp(color, dark, 0.85 * brow)
    rim = np.hypot((side - 0.0305) / 0.0165, (y - 0.5022) / 0.0080)
    lash = smoothstep(1.17 - rim, 0.0, 0.12) * smoothstep(y, 0.5020, 0.5060)
    below = smoothstep(1.25 - rim, 0.0, 0.15) * (1.0 - smoothstep(y, 0.5000, 0.5020))
    return _lerp(color, _scale(dark, 0.6), 0.85 * lash + 0.22 * below)


@compile_kernel(nogil=True)
def _eye(x: float, y: float, palette: Palette) -> SrgbColor:
    from_iris = np.hypot(abs(x - SYMMETRY_PLANE_X) - 0.0300, y - 0.5035)
    iris = _scale(_swatch(palette, IRIS), 0.75 + 40.0 * from_iris)
    color = _lerp(iris, (0.94, 0.93, 0.90), smoothstep(from_iris, 0.0058, 0.0068))
    color = _lerp((0.04, 0.03, 0.03), color, smoothstep(from_iris, 0.0026, 0.0034))
    glint = np.hypot(x - SYMMETRY_PLANE_X - np.sign(x) * 0.0300 - 0.0020, y - 0.5055)
    return _lerp((1.0, 1.0, 1.0), color, smoothstep(glint, 0.0010, 0.0018))


@compile_kernel(nogil=True)
def _hair(x: float, y: float, z: float, palette: Palette) -> SrgbColor:
    along = np.arctan2(x - SYMMETRY_PLANE_X, z - 0.05)
    strand = value_noise(along * 0.30, 0.25 * y, 0.1 * z, 0.012, np.uint32(7))
    strand += 0.6 * value_noise(along * 0.30, 0.25 * y, 0.1 * z, 0.005, np.uint32(8))
    return _scale(_swatch(palette, HAIR_TONE), 1.0 + 0.30 * strand)


@compile_kernel(nogil=True)
def _shoe(x: float, y: float, z: float, palette: Palette) -> SrgbColor:
    side = abs(abs(x - SYMMETRY_PLANE_X) - 0.162)
    upper = _swatch(palette, UPPER)
    lace = (
        smoothstep(0.022 - side, 0.0, 0.002)
        * smoothstep(z, 0.035, 0.040)
        * smoothstep(0.105 - z, 0.0, 0.004)
    )
    upper = _lerp(upper, _swatch(palette, SOLE), 0.8 * lace * _stripe_wave(z, 0.007, 0.0015))
    toe = abs(z - 0.125) if y > -1.20 else 1.0
    upper = _scale(upper, 0.82 + 0.18 * smoothstep(toe, 0.001, 0.004))
    color = _lerp(_swatch(palette, SOLE), upper, smoothstep(y, -1.2085, -1.2065))
    return _scale(color, 1.0 + 0.04 * value_noise(x, y, z, 0.015, np.uint32(9)))


@compile_kernel(nogil=True)
def albedo_at(
    material: int, x: float, y: float, z: float, palette: Palette, measures: Measures, checked: bool
) -> SrgbColor:
    """sRGB color of a place before any light falls on it; may leave [0, 1] by a little."""
    if material == SHIRT:
        return _shirt(x, y, z, palette, measures, checked)
    if material == TROUSERS:
        return _trousers(x, y, z, palette, measures)
    if material == SHOE:
        return _shoe(x, y, z, palette)
    if material == HAIR:
        return _hair(x, y, z, palette)
    if material == EYE:
        return _eye(x, y, palette)
    return _skin(x, y, z, palette)
