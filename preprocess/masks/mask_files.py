"""Which side of a mask is the person.

Masks from files: how far each pixel is person, in [0, 1], never thresholded.
"""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, Shaped
from PIL import Image, ImageOps

from capture.camera import same_aspect_ratio
from capture.image_folder import IMAGE_SUFFIXES, has_cutout_alpha, natural_sort_key
from capture.input_error import InputError
from capture.source import FrameSource
from capture.video import VIDEO_SUFFIXES
from preprocess.file_content import read_npz, read_untrusted_file
from preprocess.masks.encoded_masks import is_phalp_tracks, open_mask_video, open_rle_masks

MAX_PERSON_FRACTION = 0.5
"""Nobody covers more of the pictures, and of their rims."""
MAX_OBJECTS = 32
MIN_OBJECT_AREA = 0.01
"""Specks of compression cover less than objects do."""
SOFT_MIN, SOFT_MAX = 0.1, 0.9
"""Between them are only the rims of soft masks."""


def shows_background(samples: list[Float32[np.ndarray, "_ _"]], path: Path) -> bool:
    """Whether masks are 1 where the person is not: on most of the picture and of its rim.

    Raises:
        InputError: If they are empty, or neither side can be the person.
    """
    shares = np.array([_coverage(mask) for mask in samples])
    told = shares[(shares[:, 0] > 0.0) & (shares[:, 0] < 1.0)]
    if not len(told):
        raise InputError(
            f"The masks in {path} show nothing: all {len(samples)} that were looked at are empty "
            "or full. Expected the person at 255 and the rest at 0."
        )
    area, rim = np.median(told, axis=0)
    if (area > MAX_PERSON_FRACTION) != (rim > MAX_PERSON_FRACTION):
        raise InputError(
            f"It cannot be seen which side of the masks in {path} is the person: they cover "
            f"{area:.0%} of the pictures and {rim:.0%} of the rims. Say so with --mask-invert (the "
            "person is 0) or --no-mask-invert (the person is 255)."
        )
    return bool(area > MAX_PERSON_FRACTION)


def check_are_masks(samples: list[Float32[np.ndarray, "_ _"]], path: Path) -> None:
    """Raises InputError for pictures, depths and the like: masks are nearly everywhere 0 or 1."""
    between = [float(((mask > SOFT_MIN) & (mask < SOFT_MAX)).mean()) for mask in samples]
    if np.median(between) > MAX_PERSON_FRACTION:
        raise InputError(
            f"{path} holds pictures, not masks: {np.median(between):.0%} of their pixels are "
            "neither dark nor bright. Expected 255 where the person is, and 0 elsewhere."
        )


def are_object_ids(samples: list[Float32[np.ndarray, "_ _"]]) -> bool:
    """Whether masks hold objects' numbers, 1, 2, …, of 255, rather than brightness."""
    if max(float(mask.max()) for mask in samples) > MAX_OBJECTS / 255.0:
        return False
    found = np.unique(np.concatenate([np.unique(mask) for mask in samples]))
    area = float(np.median([float((mask > 0.0).mean()) for mask in samples]))
    return len(found) <= MAX_OBJECTS and area > MIN_OBJECT_AREA


def is_inverted(alpha: Float32[np.ndarray, "height width"]) -> bool:
    """Whether one mask among others that are in order shows the background."""
    area, rim = _coverage(alpha)
    return bool(area > MAX_PERSON_FRACTION and rim > MAX_PERSON_FRACTION)


def _coverage(alpha: Float32[np.ndarray, "height width"]) -> Float[np.ndarray, "2"]:
    """How much of the picture, and of its rim, is covered."""
    rim = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    return np.array([alpha.mean(), rim.mean()], dtype=np.float64)


MALFORMED_TRACK_ERRORS = (
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    OverflowError,
)
"""What a file raises that is nearly one of tracks."""

RLE_SUFFIXES = frozenset({".json", ".npy", ".pkl", ".pickle", ".pth", ".pt"})
"""Endings of files that may hold run-length codes."""

POLARITY_SAMPLES = 9
"""How many masks are looked at to find out which side is the person."""

MaskReader = Callable[[int], Float32[np.ndarray, "height width"]]
"""From a row to the mask as it is stored."""


class Masks:
    """One mask a frame, in order.

    Attributes:
        path: Where they lie.
        count: How many there are.
        size_px: Width and height of the first.
        inverted: Whether the files hold the background, and are turned here.
        names: Of a folder's files, without their endings; None where there is only an order.
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
        """Looks at a few of the masks that `read` gives as they are stored.

        Raises:
            InputError: If none of them can be read, they are no masks or, with `invert` None, cannot
                be told from the background.
        """
        self.path = path
        self.count = count
        self.names = names
        self._read = read
        self._doubts = invert is None
        rows = np.unique(np.linspace(0, count - 1, POLARITY_SAMPLES).round().astype(int))
        samples = _readable(read, [int(row) for row in rows])
        self._numbers = are_object_ids(samples)
        samples = [self._binarize_ids(sample) for sample in samples]
        check_are_masks(samples, path)
        height, width = samples[0].shape
        self.size_px = (int(width), int(height))
        self.inverted = shows_background(samples, path) if invert is None else invert

    def _binarize_ids(self, stored: Float32[np.ndarray, "_ _"]) -> Float32[np.ndarray, "_ _"]:
        """The same as alpha, where the files hold objects' numbers."""
        return (stored > 0.0).astype(np.float32) if self._numbers else stored

    def alpha(self, row: int, size_px: tuple[int, int]) -> Float32[np.ndarray, "height width"]:
        """The mask in one row, scaled to a picture's size.

        Raises:
            InputError: If it cannot be read, is not of the picture's shape, or is the other way round
                than most (nobody having said which way they are).
        """
        stored = self._binarize_ids(self._read(row))
        height, width = stored.shape
        if not same_aspect_ratio((width, height), size_px):
            raise InputError(
                f"Mask {row} in {self.path} has {width}x{height} px, its picture "
                f"{size_px[0]}x{size_px[1]}; expected the same shape. Was one of them cropped "
                "or rotated?"
            )
        if (width, height) != size_px:
            shrinks = width >= size_px[0]
            stored = cv2.resize(
                stored, size_px, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
            )
        alpha = np.float32(1.0) - stored if self.inverted else stored
        if self._doubts and is_inverted(alpha):
            raise InputError(
                f"mask {row} in {self.path} covers most of the picture and of its rim, unlike the "
                "others; is it the wrong way round?"
            )
        return alpha


def open_masks(path: Path, *, invert: bool | None = None, person: str | None = None) -> Masks:
    """Opens a folder of pictures or .npy files, a video, arrays (N, H, W), or run-length codes.

    Args:
        path: The folder or the file.
        invert: Whether the person is dark; None finds out from a few masks.
        person: Whose masks, in a file of several people's tracks; None for who was seen most.

    Raises:
        InputError: If there are none, if they are all empty, or if it cannot be seen which side is
            the person.
    """
    if not path.exists():
        raise InputError(f"There are no masks {path}; expected a folder of pictures, or an .npz.")
    if path.is_dir():
        return _open_folder(path, invert)
    count, read = _open_file(path, person)
    return Masks(path, count, read, invert=invert)


def _open_folder(path: Path, invert: bool | None) -> Masks:
    suffixes = IMAGE_SUFFIXES | {".npy"}
    files = [file for file in path.iterdir() if file.suffix.lower() in suffixes]
    files = sorted((file for file in files if not file.name.startswith(".")), key=natural_sort_key)
    if not files:
        raise InputError(f"{path} holds no masks; expected pictures or .npy files, one a frame.")
    names = tuple(file.stem for file in files)
    return Masks(path, len(files), lambda row: read_mask(files[row]), invert=invert, names=names)


def open_tracker_masks(
    path: Path, source: FrameSource, *, person: str | None = None
) -> Masks | None:
    """The masks that a tracker keeps beside its poses (PHALP), if they fit the video; else None.

    Args:
        path: The pose file.
        source: The video.
        person: Whose; None for who was seen most.
    """
    if path.suffix.lower() not in (".pkl", ".pickle"):
        return None
    if not is_phalp_tracks(content := read_untrusted_file(path)):
        return None
    try:
        coded = open_rle_masks(content, path, person)
        if coded is None or coded[0] != source.frames_in_file:
            return None
        count, decode = coded
        if not any(decode(row).any() for row in range(count)):
            return None
        masks = Masks(path, count, lambda row: _to_alpha(decode(row), path), invert=False)
    except (InputError, *MALFORMED_TRACK_ERRORS):
        return None
    return masks if same_aspect_ratio(masks.size_px, source.size_px) else None


def _open_rle(path: Path, person: str | None) -> tuple[int, MaskReader] | None:
    """What `open_rle_masks` finds in a file.

    Raises:
        InputError: If it nearly is such a file.
    """
    try:
        return open_rle_masks(read_untrusted_file(path), path, person)
    except MALFORMED_TRACK_ERRORS as cause:
        raise InputError(f"{path} holds tracks whose masks cannot be read ({cause}).") from cause


def _open_file(path: Path, person: str | None) -> tuple[int, MaskReader]:
    if path.suffix.lower() in VIDEO_SUFFIXES:
        count, read = open_mask_video(path)
        return count, lambda row: _to_alpha(read(row), path)
    if path.suffix.lower() in RLE_SUFFIXES and not (
        path.suffix.lower() == ".npy" and _is_numeric_npy(path)
    ):
        coded = _open_rle(path, person)
        if coded is None:
            raise InputError(f"{path} holds no masks: no run-length codes, one or more a frame.")
        count, decode = coded
        return count, lambda row: _to_alpha(decode(row), path)
    if path.suffix.lower() == ".npy":
        stack = _load_npy(path)
    elif path.suffix.lower() == ".npz":
        arrays = {key: a for key, a in read_npz(path).items() if a.ndim == 3}
        stack = arrays.get("masks", next(iter(arrays.values()), None))
    else:
        raise InputError(
            f"{path} holds no masks that can be read; expected a folder of pictures, a video, an "
            ".npz or .npy (N, height, width), or COCO's run-length codes (.json, .npy, .pkl)."
        )
    if stack is None or stack.ndim != 3 or not stack.size:
        raise InputError(f"{path} holds no array of masks (N, height, width).")
    return len(stack), lambda row: _to_alpha(stack[row], path)


def _is_numeric_npy(path: Path) -> bool:
    """Whether an .npy holds anything but objects; a damaged one is left to who reads it."""
    try:
        _load_npy(path)
    except InputError as cause:
        return "bject" not in str(cause)
    return True


def _load_npy(path: Path) -> Shaped[np.ndarray, "..."]:
    try:
        return np.load(path, allow_pickle=False, mmap_mode="r")
    except Exception as cause:  # numpy reads headers as Python: damaged ones fail in any way
        raise InputError(f"{path} is no readable .npy of numbers ({cause}).") from cause


def read_mask(path: Path) -> Float32[np.ndarray, "height width"]:
    """One mask as it is stored, in [0, 1].

    Raises:
        InputError: If it cannot be decoded, or is not complete.
    """
    if path.suffix.lower() == ".npy":
        return _to_alpha(np.asarray(_load_npy(path)), path)
    try:
        with Image.open(path) as picture:
            picture.load()
            ImageOps.exif_transpose(picture, in_place=True)
            channel = _mask_channel(picture)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as cause:
        raise InputError(f"{path} is no mask that can be decoded ({cause}).") from cause
    return _to_alpha(channel, path)


def _mask_channel(picture: Image.Image) -> Shaped[np.ndarray, "height width"]:
    """The one channel that holds the mask: objects' numbers, the alpha channel, or brightness."""
    if picture.mode == "P":
        colours = np.array(picture.getpalette()).reshape(-1, 3)
        if (colours != colours[:, :1]).any():  # coloured: the index is an object's number
            return np.asarray(picture) > 0
        picture = picture.convert("L")
    if picture.mode in ("LA", "RGBA"):
        alpha = np.asarray(picture)[..., -1]
        if has_cutout_alpha(alpha):
            return alpha
    if picture.mode in ("LA", "RGBA", "RGB", "CMYK", "YCbCr"):
        picture = picture.convert("L")
    return np.asarray(picture)


def _to_alpha(stored: Shaped[np.ndarray, "..."], path: Path) -> Float32[np.ndarray, "height width"]:
    """Stored numbers as alpha; a mask of nothing but 0 and 1 needs no scaling."""
    stored = np.squeeze(np.asarray(stored))
    if stored.ndim != 2 or stored.dtype.kind not in "biuf":
        raise InputError(f"A mask in {path} has the shape {stored.shape}; expected height x width.")
    if not np.isfinite(stored).all():
        raise InputError(f"A mask in {path} holds NaN; expected numbers from 0 to 1, or to 255.")
    return np.clip(stored.astype(np.float32) / _full_scale(stored), 0.0, 1.0)


def _full_scale(stored: Shaped[np.ndarray, "height width"]) -> np.float32:
    """The number that means "all person"."""
    if stored.dtype.kind == "f":
        return np.float32(1.0 if stored.max() < 1.5 else 255.0)
    if stored.max() <= 1:
        return np.float32(1.0)
    return np.float32(65535.0 if stored.dtype == np.uint16 else 255.0)


def _readable(read: MaskReader, rows: list[int]) -> list[Float32[np.ndarray, "height width"]]:
    """Those of the masks that can be read, if any can."""
    masks, refused = [], []
    for row in rows:
        try:
            masks.append(read(row))
        except InputError as cause:
            refused.append(cause)
    if not masks:
        raise refused[0]
    return masks
