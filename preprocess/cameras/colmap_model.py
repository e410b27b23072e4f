"""COLMAP's models, 3.x and 4.x, binary and text: cameras and registered images, without points.

They are read here, not by pycolmap: it believes the counts that a damaged file claims, reads beyond
the end for minutes and fills the memory; and a model's cameras need no extra installation.
(github.com/colmap/colmap, doc/format.rst.)
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, final

import numpy as np
from scipy.spatial.transform import Rotation

from capture.image_folder import natural_sort_key
from preprocess.cameras.named_camera import NamedCamera, checked_camera, image_name
from preprocess.file_content import explain_damage

MODEL_SUBFOLDERS = (".", "sparse/0", "0", "sparse", "colmap/sparse/0", "dense/sparse")
"""Places of models in a folder, as COLMAP, nerfstudio and others leave them."""
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12,
}  # fmt: skip
"""Number of parameters of COLMAP's camera models, in the order of their numbers."""
DISTORTION_START = {"SIMPLE_RADIAL": 3, "RADIAL": 3, "OPENCV": 4, "FULL_OPENCV": 4}
"""First of OpenCV's distortion coefficients among the parameters, of the models that have some."""
Lens = tuple[str, tuple[int, int], list[float]]
"""A camera model's name, width and height, and its parameters."""
ImageRow = tuple[str, str, list[float]]
"""An image's name, its camera's number, and its camera-from-world: qw qx qy qz tx ty tz."""


def find_colmap_model(folder: Path) -> Path | None:
    """The folder in which a COLMAP model lies, if there is one."""
    for place in MODEL_SUBFOLDERS:
        for ending in (".bin", ".txt"):
            found = folder / place
            if all((found / f"{part}{ending}").is_file() for part in ("cameras", "images")):
                return found
    return None


def read_colmap_model(folder: Path) -> list[NamedCamera]:
    """The registered images of a model, by name; its world and its unit stay COLMAP's.

    An InputError if it cannot be read, is empty, or has a camera that OpenCV does not have.
    """
    with explain_damage(folder, "a COLMAP model"):
        if (folder / "cameras.bin").is_file():
            lenses, images = _read_binary(folder)
        else:
            lenses, images = _read_text(folder)
        if not images:
            raise ValueError("it has no registered image")
        images.sort(key=lambda image: natural_sort_key(Path(image[0])))
        return [_named_camera(name, lenses[lens], pose) for name, lens, pose in images]


def _named_camera(name: str, lens: Lens, pose: list[float]) -> NamedCamera:
    kind, size_px, numbers = lens
    if kind not in CAMERA_MODELS or "FISHEYE" in kind:
        raise ValueError(
            f"camera model {kind}; undistort the images first (colmap image_undistorter)"
        )
    one_focal = kind.startswith("SIMPLE") or kind == "RADIAL"
    focal, center = numbers[: 1 if one_focal else 2], numbers[1:3] if one_focal else numbers[2:4]
    distortion = numbers[DISTORTION_START.get(kind, len(numbers)) :]
    distortion += [0.0] * (4 - len(distortion))
    rotation = Rotation.from_quat([*pose[1:4], pose[0]]).as_matrix()
    view = np.column_stack([rotation, pose[4:7]])
    camera = checked_camera((focal[0], focal[-1]), center, size_px, view, distortion)
    return NamedCamera(name=image_name(name), camera=camera)


def _read_text(folder: Path) -> tuple[dict[str, Lens], list[ImageRow]]:
    lenses: dict[str, Lens] = {}
    for line in filter(None, _content_lines(folder / "cameras.txt")):
        number, kind, width, height, *numbers = line.split()
        lenses[number] = (kind, (int(width), int(height)), [float(each) for each in numbers])
    images: list[ImageRow] = []
    lines = _content_lines(folder / "images.txt")
    for line in filter(None, lines):
        _, *pose, lens, name = line.split(maxsplit=9)
        images.append((name, lens, [float(each) for each in pose]))
        next(lines, None)  # the points that it sees
    return lenses, images


def _content_lines(path: Path) -> Iterator[str]:
    """Lines of a file but for its comments; a line of points may be empty."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            yield line.strip()


def _read_binary(folder: Path) -> tuple[dict[str, Lens], list[ImageRow]]:
    file, kinds = _BinaryReader(folder / "cameras.bin"), list(CAMERA_MODELS)
    lenses: dict[str, Lens] = {}
    for _ in range(file.take("Q")[0]):
        number, kind, width, height = file.take("IiQQ")
        if not 0 <= kind < len(kinds):
            raise ValueError(f"camera model {kind}; undistort the images first")
        numbers = file.take(f"{CAMERA_MODELS[kinds[kind]]}d")
        lenses[str(number)] = (kinds[kind], (width, height), list(numbers))
    file, images = _BinaryReader(folder / "images.bin"), list[ImageRow]()
    for _ in range(file.take("Q")[0]):
        _, *pose, lens = file.take("I7dI")
        images.append((file.take_text(), str(lens), pose))
        file.skip(24 * file.take("Q")[0])  # observed points
    return lenses, images


@final
class _BinaryReader:
    """Reads numbers and texts of a file, one after the other; never beyond its end."""

    def __init__(self, path: Path) -> None:
        self._data, self._place, self._name = path.read_bytes(), 0, path.name

    def take(self, layout: str) -> tuple[Any, ...]:
        """The numbers of a `struct` layout, little-endian and without gaps."""
        start = self._place
        self.skip(struct.calcsize(f"<{layout}"))
        return struct.unpack_from(f"<{layout}", self._data, start)

    def take_text(self) -> str:
        """The text up to the next zero byte."""
        start, self._place = self._place, self._data.index(b"\0", self._place) + 1
        return self._data[start : self._place - 1].decode()

    def skip(self, count: int) -> None:
        """Pass over some bytes."""
        self._place += count
        if self._place > len(self._data):
            raise ValueError(f"{self._name} is cut off")
