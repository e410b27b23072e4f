"""The edge objective: how a few images' edges follow the outlines of the masks."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Complex64, Float, Float32, UInt8
from scipy import fft

from capture.input_error import InputError
from capture.source import FrameSource
from capture.source_opening import open_source
from preprocess.alignment.capture_geometry import FULL_WINDOW, CaptureGeometry, VideoTransform
from preprocess.alignment.silhouette_objective import spaced_indices
from preprocess.body.body_surface import signed_distance_px

EDGE_BLUR_PX = 1.0
"""Gaussian σ, px, before gradients are taken."""


def outward_normals(
    signed_distance: Float32[np.ndarray, "height width"],
) -> Float32[np.ndarray, "height width 2"]:
    """Unit vector (x, y) of each pixel along which the distance from a shape grows.

    Args:
        signed_distance: The distance, in any unit.
    """
    sides = [
        cv2.Sobel(signed_distance, cv2.CV_32F, 1, 0),
        cv2.Sobel(signed_distance, cv2.CV_32F, 0, 1),
    ]
    slope = np.stack(sides, axis=-1)
    length = np.linalg.norm(slope, axis=-1, keepdims=True) + np.float32(1e-6)
    return np.asarray(slope / length, dtype=np.float32)


def color_gradients(
    rgb: UInt8[np.ndarray, "height width 3"],
) -> Float32[np.ndarray, "height width 3 2"]:
    """Gradient of each channel to the right and down, by Sobel's filter after a slight blur."""
    smooth = cv2.GaussianBlur(rgb.astype(np.float32), (0, 0), EDGE_BLUR_PX)
    sides = [cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)]
    return np.stack(sides, axis=-1)


def gradient_along(
    rgb: UInt8[np.ndarray, "height width 3"], directions: Float32[np.ndarray, "height width 2"]
) -> Float32[np.ndarray, "height width"]:
    """Largest absolute gradient of the three channels along each pixel's direction."""
    sides = color_gradients(rgb)
    along = np.abs(sides[..., 0] * directions[..., :1] + sides[..., 1] * directions[..., 1:])
    # Numpy reduces short axes slowly.
    return np.maximum(np.maximum(along[..., 0], along[..., 1]), along[..., 2])


SAMPLED_IMAGES = 12
"""Number of images that are sampled."""
MAX_DECODED_FRAMES = 300
"""Frames at the beginning of the video from which images are sampled: all of them are decoded."""
ON_OUTLINE_PX = 1.6
"""Largest distance of a pixel on an outline, px."""
OFF_OUTLINE_MIN_PX = 2.5
"""Least distance of a pixel beside an outline, px."""
OFF_OUTLINE_MAX_PX = 8.0
"""Largest distance of a pixel beside an outline, px."""
GRADIENT_NOISE = 1.0
"""Gradient, levels per px, that is added beside an outline: images without edges score 0."""
MIN_OUTLINE_PX = 40
"""Pixels that an outline must have within the video's image."""
WINDOW_SCALES = np.exp(np.linspace(-0.5, 0.5, 21))
"""Sizes of the video relative to the masks' image that are tried."""
WINDOW_EVALUATIONS = 60
"""Evaluations that refine a window."""
WINDOW_FIRST_STEP = 0.015
"""First step of a window's sides, as a fraction of the image."""
MAX_CACHED_OUTLINES = 256
"""Outlines in the cache."""

RgbThumbnail = UInt8[np.ndarray, "height width 3"]
AlphaMask = Float32[np.ndarray, "height width"]


@dataclass(frozen=True, eq=False, kw_only=True)
class MaskOutline:
    """A mask's outline.

    Attributes:
        signed_distance_px: Distance of each pixel's center from the border, px; negative inside.
        outward_normal: Unit vector (x, y) of each pixel that points away from the mask.
    """

    signed_distance_px: Float32[np.ndarray, "height width"]
    outward_normal: Float32[np.ndarray, "height width 2"]

    @classmethod
    def of(cls, mask: Bool[np.ndarray, "height width"]) -> "MaskOutline":
        """The outline of a mask."""
        away = signed_distance_px(mask)
        return cls(signed_distance_px=away, outward_normal=outward_normals(away))


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeObjective:
    """Scores a geometry by how the edges of a few reduced images follow the masks' outlines.

    Attributes:
        images: Frame number and image, in the frames' order.
        mask_of: From a frame number to its reduced mask, of the images' size; raises InputError if
            there is none.
        mask_count: Number of masks.
    """

    images: tuple[tuple[int, RgbThumbnail], ...]
    mask_of: Callable[[int], AlphaMask]
    mask_count: int
    _outlines: dict[int, MaskOutline | None] = field(default_factory=dict)

    def subset(self, count: int) -> "EdgeObjective":
        """At most `count` of the images, evenly spaced."""
        rows = spaced_indices(len(self.images), count)
        return replace(self, images=tuple(self.images[row] for row in rows))

    def frame_scores(self, geometry: CaptureGeometry) -> Float[np.ndarray, "images"]:
        """How well each image's edges follow its mask's outline, in [0, 1].

        The score is a / (a + b), where a is the image's mean gradient across the outline and b that
        beside it: about 0.5 for an outline anywhere, 0.65 to 0.95 for a person's. NaN where an
        image has no mask, or one of another shape.
        """
        return np.array(
            [self._frame_score(geometry.video_transform, *image) for image in self.images]
        )

    def _frame_score(self, transform: VideoTransform, index: int, rgb: RgbThumbnail) -> float:
        outline = self.outline(transform.mask_frame(index))
        if outline is None:
            return float("nan")
        image, shown = transform.warp_to_mask(rgb)
        if image.shape[:2] != outline.signed_distance_px.shape:
            return float("nan")
        across = gradient_along(image, outline.outward_normal)
        away = np.abs(outline.signed_distance_px)
        known = cv2.erode(shown, np.ones((5, 5), np.uint8), borderValue=1) > 0
        along, beside = (
            known & (away < ON_OUTLINE_PX),
            known & (away > OFF_OUTLINE_MIN_PX) & (away < OFF_OUTLINE_MAX_PX),
        )
        if (
            along.sum() < max(MIN_OUTLINE_PX, 0.3 * (away < ON_OUTLINE_PX).sum())
            or not beside.any()
        ):
            return float("nan")
        on, off = float(across[along].mean()), float(across[beside].mean())
        return on / (on + off + GRADIENT_NOISE)

    def outline(self, number: int) -> MaskOutline | None:
        """The outline of a frame number's mask; None if there is none, or it is empty or full."""
        if number not in self._outlines:
            if len(self._outlines) >= MAX_CACHED_OUTLINES:
                self._outlines.clear()
            self._outlines[number] = self._outline(number)
        return self._outlines[number]

    def _outline(self, number: int) -> MaskOutline | None:
        try:
            shape = self.mask_of(number) > 0.5
        except InputError:
            return None
        return MaskOutline.of(shape) if shape.any() and not shape.all() else None

    def fit_window(self, geometry: CaptureGeometry) -> tuple[float, float, float, float]:
        """Fit the window of the video's image within the mask's.

        Edges are correlated with the outlines at all positions at once (a product in Fourier space)
        for each size of `WINDOW_SCALES`; the best window is refined by Nelder-Mead on the scores.
        """
        from scipy.optimize import minimize  # 0.1 s that a first look does not need

        def loss(sides: Float[np.ndarray, "4"]) -> float:
            left, top, right, bottom = (float(side) for side in sides)
            video = replace(geometry.video_transform, window=(left, top, right, bottom))
            scores = self.frame_scores(replace(geometry, video_transform=video))
            return -float(np.nan_to_num(scores).mean())

        start = np.array(self._coarse_window(replace(geometry.video_transform, window=FULL_WINDOW)))
        if np.abs(start - FULL_WINDOW).max() < WINDOW_FIRST_STEP:
            return FULL_WINDOW
        steps = np.vstack([np.zeros(4), np.diag([WINDOW_FIRST_STEP] * 4)])
        options = {"maxfev": WINDOW_EVALUATIONS, "initial_simplex": start + steps}
        found = minimize(loss, start, method="Nelder-Mead", options=options).x
        return float(found[0]), float(found[1]), float(found[2]), float(found[3])

    def _coarse_window(self, transform: VideoTransform) -> tuple[float, float, float, float]:
        """The window to a whole pixel of the reduced images and a step of 5 % in size."""
        pairs = [
            (transform.reorient(rgb), self.outline(transform.mask_frame(i)))
            for i, rgb in self.images
        ]
        pairs = [(rgb, o) for rgb, o in pairs if o and o.signed_distance_px.shape == rgb.shape[:2]]
        if not pairs:
            return FULL_WINDOW
        height, width = pairs[0][0].shape[:2]
        grid = tuple(
            cv2.getOptimalDFTSize(int(n * (1.0 + WINDOW_SCALES[-1]))) for n in (height, width)
        )
        outlines = [_fourier(_outline_tensor(outline), grid) for _, outline in pairs]
        best, found = -np.inf, FULL_WINDOW
        for scale in WINDOW_SCALES:
            size = max(8, round(width * scale)), max(8, round(height * scale))
            way = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
            total = np.zeros((grid[0], grid[1] // 2 + 1), dtype=np.complex64)
            for (rgb, _), spectra in zip(pairs, outlines, strict=True):
                edges = _fourier(_edge_tensor(cv2.resize(rgb, size, interpolation=way)), grid)
                total += (spectra * edges.conj()).sum(axis=0)
            match = np.asarray(fft.irfft2(total, s=grid))
            down, right = np.unravel_index(int(match.argmax()), match.shape)
            if match[down, right] > best:
                best = float(match[down, right])
                # The correlation is periodic: positions far right and below are left and above.
                x = (right - grid[1] if right > width else right) / width
                y = (down - grid[0] if down > height else down) / height
                found = float(x), float(y), float(x + scale), float(y + scale)
        return found


def sample_images(
    source: FrameSource,
    mask_of: Callable[[int], AlphaMask],
    mask_count: int,
    size_px: tuple[int, int],
    *,
    count: int = SAMPLED_IMAGES,
    within: int = MAX_DECODED_FRAMES,
) -> EdgeObjective:
    """Decode a few images from the beginning of a video.

    Args:
        source: The video; not a live source.
        mask_of: From a frame number to its mask of `size_px`.
        mask_count: Number of masks.
        size_px: Width and height of the reduced images.
        count: Number of images to sample.
        within: Number of frames at the beginning from which they are sampled.
    """
    total = min(source.frame_count or 1, within)
    places = spaced_indices(total, count)
    stride = max(1, total // max(1, len(places)))
    chosen = source.selection
    start = chosen.start + chosen.step * places[0]
    some = slice(start, chosen.start + chosen.step * total, chosen.step * stride)
    images = _decode_images(source.path, some, source.size_px, size_px)
    return EdgeObjective(images=tuple(images), mask_of=mask_of, mask_count=mask_count)


def _decode_images(
    path: Path, frames: slice, full_px: tuple[int, int], size_px: tuple[int, int]
) -> Sequence[tuple[int, RgbThumbnail]]:
    found: list[tuple[int, RgbThumbnail]] = []
    for frame in open_source(path, frames=frames).frames():
        turned = frame.size_px == full_px[::-1] and frame.size_px != full_px
        if "corrupt" not in frame.flags and (turned or frame.size_px == full_px):
            small = size_px[::-1] if turned else size_px
            rgb = cv2.resize(frame.rgb, small, interpolation=cv2.INTER_AREA)
            found.append((frame.index, np.asarray(rgb)))
    return found


def _edge_tensor(rgb: RgbThumbnail) -> Float32[np.ndarray, "3 height width"]:
    """Products xx, xy, yy of the strongest channel's gradient, strong edges compressed."""
    colors = color_gradients(rgb)
    strength = np.linalg.norm(colors, axis=-1)
    strongest = strength.argmax(axis=-1)[..., None]
    chosen = np.take_along_axis(colors, strongest[..., None], axis=2)[:, :, 0]
    chosen /= np.take_along_axis(strength, strongest, axis=2) + np.float32(20.0)
    x, y = chosen[..., 0], chosen[..., 1]
    tensor = np.stack([x * x, x * y, y * y])
    return np.asarray(tensor - tensor.mean(axis=(1, 2), keepdims=True), dtype=np.float32)


def _outline_tensor(outline: MaskOutline) -> Float32[np.ndarray, "3 height width"]:
    """Products xx, 2xy, yy of the normals on an outline; 0 elsewhere."""
    x, y = outline.outward_normal[..., 0], outline.outward_normal[..., 1]
    on = (np.abs(outline.signed_distance_px) < ON_OUTLINE_PX).astype(np.float32)
    on /= on.sum()
    return np.asarray(np.stack([x * x, 2.0 * x * y, y * y]) * on, dtype=np.float32)


def _fourier(
    maps: Float32[np.ndarray, "3 height width"], grid: tuple[int, ...]
) -> Complex64[np.ndarray, "3 rows columns"]:
    return np.asarray(fft.rfft2(maps, s=grid))
