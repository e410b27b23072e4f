"""Masks from files: how far each pixel is person, in [0, 1], never thresholded.

Which side of the masks is the person, and whether they hold brightness or object numbers, is
detected from a few samples. Files that hold no readable masks raise `InputError`.
"""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, Shaped
from PIL import Image, ImageOps

from capture.camera import same_aspect_ratio
from capture.image_folder import IMAGE_SUFFIXES, has_cutout_alpha, natural_sort_key, refuse_pipe
from capture.input_error import InputError
from capture.source import AlphaMask, FrameSelection
from capture.video import VIDEO_SUFFIXES, DecodedFrame, VideoFile
from preprocess.file_content import read_npz

StoredMask = Float32[np.ndarray, "_ _"]
"""A mask as stored, in [0, 1]."""

MAX_PERSON_FRACTION = 0.5
"""Largest fraction of the image's rim that a person covers."""
MAX_OBJECTS = 32
"""Largest object number of masks that hold object numbers."""


def shows_background(samples: list[StoredMask], path: Path) -> bool:
    """Check whether masks are 1 on the background: on most of the image's rim."""
    shares = np.array([_coverage(mask) for mask in samples])
    usable = shares[(shares[:, 0] > 0.0) & (shares[:, 0] < 1.0)]
    if not len(usable):
        raise InputError(
            f"The masks in {path} show nothing: all {len(samples)} that were sampled are empty or "
            "full. Expected the person at 255 and the rest at 0."
        )
    return bool(np.median(usable[:, 1]) > MAX_PERSON_FRACTION)


def check_are_masks(samples: list[StoredMask], path: Path) -> None:
    """Raise InputError for photographs, depth maps and the like: masks are mostly 0 or 1."""
    between = [float(((mask > 0.1) & (mask < 0.9)).mean()) for mask in samples]
    if np.median(between) > MAX_PERSON_FRACTION:
        raise InputError(
            f"{path} holds photographs, not masks: {np.median(between):.0%} of their pixels are "
            "neither dark nor bright. Expected 255 where the person is, and 0 elsewhere."
        )


def are_object_ids(samples: list[StoredMask]) -> bool:
    """Check whether masks hold object numbers 1, 2, … of 255 rather than brightness."""
    if max(float(mask.max()) for mask in samples) > MAX_OBJECTS / 255.0:
        return False
    found = np.unique(np.concatenate([np.unique(mask) for mask in samples]))
    area = float(np.median([float((mask > 0.0).mean()) for mask in samples]))
    return len(found) <= MAX_OBJECTS and area > 0.01  # compression artifacts cover less


def _coverage(alpha: AlphaMask) -> Float[np.ndarray, "2"]:
    """Mean alpha of the image and of its rim."""
    rim = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    return np.array([alpha.mean(), rim.mean()], dtype=np.float64)


MaskReader = Callable[[int], AlphaMask]
"""From a row to the mask as stored."""


class Masks:
    """One mask per frame, in order.

    Attributes:
        size_px: Width and height of the first mask.
        inverted: Whether the files hold the background and are inverted on reading.
        names: Stems of a folder's files; None where there is only an order.
    """

    def __init__(
        self,
        path: Path,
        count: int,
        read: MaskReader,
        *,
        invert: bool | None,
        names: tuple[str, ...] | None = None,
    ) -> None:
        """Detect kind and polarity from a few of the masks that `read` returns."""
        self.path = path
        self.count = count
        self.names = names
        self._read = read
        self._stated = invert
        rows = np.unique(np.linspace(0, count - 1, 9).round().astype(int))
        samples = _readable(read, [int(row) for row in rows])
        self._numbers = are_object_ids(samples)
        samples = [self._binarize_ids(sample) for sample in samples]
        check_are_masks(samples, path)
        height, width = samples[0].shape
        self.size_px = (int(width), int(height))
        self.inverted = shows_background(samples, path) if invert is None else invert

    def __reduce__(self) -> tuple[Callable[[Path], "Masks"], tuple[Path]]:
        """Open the files again in another process."""
        return partial(open_masks, invert=self._stated), (self.path,)

    def _binarize_ids(self, stored: StoredMask) -> StoredMask:
        """Alpha of a stored mask: any object, if the files hold object numbers."""
        return (stored > 0.0).astype(np.float32) if self._numbers else stored

    def alpha(self, row: int, size_px: tuple[int, int]) -> AlphaMask:
        """The mask of one row, scaled to an image's size; an InputError if it does not fit."""
        stored = self._binarize_ids(self._read(row))
        height, width = stored.shape
        if not same_aspect_ratio((width, height), size_px):
            raise InputError(
                f"Mask {row} in {self.path} has {width}x{height} px, its image "
                f"{size_px[0]}x{size_px[1]}; expected the same shape. Was one of them cropped, "
                "rotated or stretched?"
            )
        if (width, height) != size_px:
            shrinks = width >= size_px[0]
            stored = cv2.resize(
                stored, size_px, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            )
        alpha = 1.0 - stored if self.inverted else stored
        if self._stated is None and (_coverage(alpha) > MAX_PERSON_FRACTION).all():
            raise InputError(
                f"mask {row} in {self.path} covers most of the image and of its rim, unlike the "
                "others; is it inverted?"
            )
        return alpha


def open_masks(path: Path, *, invert: bool | None = None) -> Masks:
    """Open a folder of images or .npy files, a video, or arrays (N, H, W).

    With `invert` the person is dark; None detects it from a few masks.
    """
    if not path.exists():
        raise InputError(f"There are no masks {path}; expected a folder of images, or an .npz.")
    refuse_pipe(path)
    if path.is_dir():
        return _open_folder(path, invert)
    count, read = _open_file(path)
    return Masks(path, count, read, invert=invert)


def _open_folder(path: Path, invert: bool | None) -> Masks:
    suffixes = IMAGE_SUFFIXES | {".npy"}
    files = [file for file in path.iterdir() if file.suffix.lower() in suffixes]
    files = sorted((file for file in files if not file.name.startswith(".")), key=natural_sort_key)
    if not files:
        raise InputError(f"{path} holds no masks; expected images or .npy files, one per frame.")
    for file in files:
        refuse_pipe(file)
    names = tuple(file.stem for file in files)
    return Masks(path, len(files), lambda row: read_mask(files[row]), invert=invert, names=names)


def _open_file(path: Path) -> tuple[int, MaskReader]:
    kind = path.suffix.lower()
    if kind in VIDEO_SUFFIXES:
        video = VideoFile(path, FrameSelection())
        return video.frames_in_file, _MaskVideo(video).read
    if kind not in (".npz", ".npy"):
        raise InputError(
            f"{path} holds no masks that can be read; expected a folder of images, a video, or an "
            ".npz or .npy (N, height, width). Run-length codes must be written as images first "
            "(pycocotools.mask.decode)."
        )
    if kind == ".npy":
        stack = _load_npy(path)
    else:
        arrays = {key: a for key, a in read_npz(path).items() if a.ndim == 3}
        stack = arrays.get("masks", next(iter(arrays.values()), None))
    if stack is None or stack.ndim != 3 or not stack.size:
        raise InputError(f"{path} holds no array of masks (N, height, width).")
    return len(stack), lambda row: _to_alpha(stack[row], path)


class _MaskVideo:
    """Random access to a video's frames; fast in ascending order."""

    def __init__(self, video: VideoFile) -> None:
        self._video = video
        self._frames: Iterator[tuple[int, DecodedFrame]] = iter(())
        self._at = -1
        self._last: AlphaMask | None = None

    def read(self, row: int) -> AlphaMask:
        """Read the mask of one frame."""
        if row == self._at and self._last is not None:
            return self._last
        if row <= self._at or self._at < 0:
            self._frames = self._video.numbered()
        self._at, frame = next((item for item in self._frames if item[0] >= row), (-1, None))
        image = frame.rgb() if frame is not None and self._at == row else None
        if image is None:
            self._at = -1  # the next call decodes from the start
            raise InputError(f"Frame {row} of the masks {self._video.path} cannot be decoded.")
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
        # black up to 16 (compression rings around edges), white from 239 on
        self._last = np.clip((gray - 16.0) / 223.0, 0.0, 1.0)
        return self._last


def _load_npy(path: Path) -> Shaped[np.ndarray, "..."] | None:
    """Open an .npy of numbers; None if it is damaged, or holds objects."""
    try:
        return np.load(path, allow_pickle=False, mmap_mode="r")
    except Exception:  # numpy parses headers as Python: damaged ones fail in any way
        return None


def read_mask(path: Path) -> AlphaMask:
    """Read one mask as stored, in [0, 1]."""
    if path.suffix.lower() == ".npy":
        stored = _load_npy(path)
        if stored is None:
            raise InputError(f"{path} is not a readable .npy of numbers.")
        return _to_alpha(np.asarray(stored), path)
    try:
        with Image.open(path) as image:
            image.load()
            ImageOps.exif_transpose(image, in_place=True)
            channel = _mask_channel(image)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as cause:
        raise InputError(f"{path} is not a mask that can be decoded ({cause}).") from cause
    return _to_alpha(channel, path)


def _mask_channel(image: Image.Image) -> Shaped[np.ndarray, "height width"]:
    """The channel that holds the mask: object numbers, the alpha channel, or brightness."""
    if image.mode == "P":
        colors = np.array(image.getpalette()).reshape(-1, 3)
        if (colors != colors[:, :1]).any():  # a colored palette: the index is an object number
            return np.asarray(image) > 0
        image = image.convert("L")
    if image.mode in ("LA", "RGBA"):
        alpha = np.asarray(image)[..., -1]
        if has_cutout_alpha(alpha):
            return alpha
    if image.mode in ("LA", "RGBA", "RGB", "CMYK", "YCbCr"):
        image = image.convert("L")
    return np.asarray(image)


def _to_alpha(stored: Shaped[np.ndarray, "..."], path: Path) -> AlphaMask:
    """Stored numbers as alpha; a mask of only 0 and 1 needs no scaling."""
    stored = np.squeeze(np.asarray(stored))
    if stored.ndim != 2 or stored.dtype.kind not in "biuf":
        raise InputError(f"A mask in {path} has the shape {stored.shape}; expected height x width.")
    if not np.isfinite(stored).all():
        raise InputError(f"A mask in {path} holds NaN; expected numbers from 0 to 1, or to 255.")
    return np.clip(stored.astype(np.float32) / _full_scale(stored), 0.0, 1.0)


def _full_scale(stored: Shaped[np.ndarray, "height width"]) -> float:
    """The stored number that means alpha 1."""
    if stored.dtype.kind == "f":
        return 1.0 if stored.max() < 1.5 else 255.0
    if stored.max() <= 1:
        return 1.0
    return 65535.0 if stored.dtype == np.uint16 else 255.0


def _readable(read: MaskReader, rows: list[int]) -> list[AlphaMask]:
    """The readable masks; raises the first error if there are none."""
    masks, refused = [], []
    for row in rows:
        try:
            masks.append(read(row))
        except InputError as cause:
            refused.append(cause)
    if not masks:
        raise refused[0]
    return masks
