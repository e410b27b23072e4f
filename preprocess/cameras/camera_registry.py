"""Read the cameras of any known program, which is recognised by the content of its files.

COLMAP models, 3.x and 4.x, binary and text, are read by pycolmap. A studio's file holds several
cameras that stand still; the video's name says which is its own: EasyMocap's `intri.yml` (K_01,
dist_01, …) and `extri.yml` (Rot_01 or, as a rotation vector, R_01; T_01) in OpenCV's YAML,
camera-from-world, metres; ZJU-MoCap's `annots.npy` {cams: {K, D, R, T in millimetres}, ims: [{ims:
[Camera_B1/000000.jpg, …]}]}. (github.com/zju3dv/EasyMocap, easymocap/mytools/camera_utils.py;
github.com/zju3dv/neuralbody.)
"""

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.image_folder import natural_sort_key
from capture.input_error import InputError
from preprocess.cameras.named_camera import (
    MAX_METADATA_BYTES,
    NamedCamera,
    find_polycam,
    image_name,
    parse_pinhole_camera,
    parse_rigid_transform,
    read_polycam,
    read_r3d,
    read_record3d,
    read_transforms,
)
from preprocess.file_content import read_untrusted_file

READABLE_FORMATS = (
    "an .npz (intrinsic, extrinsic, height, width), a COLMAP model (the folder of cameras.bin and "
    "images.bin, or .txt), a transforms.json of nerfstudio or instant-ngp, Record3D's .r3d or its "
    "metadata, Polycam's folder, EasyMocap's intri.yml and extri.yml, or ZJU-MoCap's annots.npy"
)
"""List of the formats, for messages."""


def read_named_cameras(path: Path, size_px: tuple[int, int] | None = None) -> list[NamedCamera]:
    """The cameras of a file or a folder.

    Args:
        path: The file or folder.
        size_px: Width and height of the pictures, for files that do not state them.

    Raises:
        InputError: If nothing there holds cameras.
    """
    if not path.exists():
        raise InputError(f"{path} does not exist; expected {READABLE_FORMATS}.")
    if path.is_dir():
        return _in_folder(path, size_px)
    if (
        path.suffix.lower() in (".bin", ".txt")
        and (model := find_colmap_model(path.parent)) is not None
    ):
        return read_colmap_model(model)
    if path.suffix.lower() == ".r3d":
        return read_r3d(path)
    if path.suffix.lower() == ".json" or path.name == "metadata":
        return _in_json(path, size_px)
    raise InputError(f"{path} holds no cameras that are known; expected {READABLE_FORMATS}.")


def _in_folder(folder: Path, size_px: tuple[int, int] | None) -> list[NamedCamera]:
    model = find_colmap_model(folder)
    if model is not None:
        return read_colmap_model(model)
    for name in ("transforms.json", "transforms_train.json", "metadata", "metadata.json"):
        if (folder / name).is_file():
            return _in_json(folder / name, size_px)
    cameras = find_polycam(folder)
    if cameras is not None:
        return read_polycam(cameras)
    raise InputError(f"{folder} holds no cameras that are known; expected {READABLE_FORMATS}.")


def _in_json(path: Path, size_px: tuple[int, int] | None) -> list[NamedCamera]:
    try:
        if path.stat().st_size > MAX_METADATA_BYTES:
            raise InputError(
                f"{path} is larger than {MAX_METADATA_BYTES >> 20} MiB; it holds no cameras."
            )
        content = json.loads(path.read_text(encoding="utf-8"))
    except InputError:
        raise
    except (OSError, ValueError, RecursionError) as cause:
        raise InputError(f"{path} is no JSON that can be read ({cause}).") from cause
    if isinstance(content, dict) and "frames" in content:
        return read_transforms(content, path, size_px)
    if isinstance(content, dict) and "poses" in content:
        return read_record3d(content, path)
    raise InputError(f"{path} holds neither `frames` (nerfstudio) nor `poses` (Record3D).")


MODEL_SUBFOLDERS = (".", "sparse/0", "0", "sparse", "colmap/sparse/0", "dense/sparse")
"""Where models lie in a folder, as COLMAP, nerfstudio and others leave them."""

MIN_CAMERA_BYTES = 24 + 3 * 8
"""Bytes of the shortest camera in cameras.bin."""

IMAGE_HEADER_BYTES = 4 + 7 * 8 + 4
"""Bytes before an image's name in images.bin."""

POINT_BYTES = 24
"""Bytes of a point behind an image's name in images.bin."""

OPENCV_DISTORTION = {
    "SIMPLE_PINHOLE": lambda p: (),
    "PINHOLE": lambda p: (),
    "SIMPLE_RADIAL": lambda p: (p[3], 0.0, 0.0, 0.0),
    "RADIAL": lambda p: (p[3], p[4], 0.0, 0.0),
    "OPENCV": lambda p: tuple(p[4:8]),
    "FULL_OPENCV": lambda p: tuple(p[4:12]),
}
"""OpenCV's coefficients in COLMAP's parameters, by the camera's model."""


def find_colmap_model(folder: Path) -> Path | None:
    """The folder in which a COLMAP model lies, if one does."""
    for place in MODEL_SUBFOLDERS:
        for ending in (".bin", ".txt"):
            found = folder / place
            if all((found / f"{part}{ending}").is_file() for part in ("cameras", "images")):
                return found
    return None


def read_colmap_model(folder: Path) -> list[NamedCamera]:
    """The registered pictures of a model, by name; its world and its unit stay COLMAP's.

    Raises:
        InputError: If it cannot be read, is empty, or has a camera that OpenCV does not have.
    """
    import pycolmap  # heavy, and only needed for its own files

    pycolmap.logging.minloglevel = 3  # the message below explains the error instead
    try:
        with TemporaryDirectory() as bare:
            _copy_without_points(folder, Path(bare))
            model = pycolmap.Reconstruction(bare)
        images = sorted(
            (model.image(number) for number in model.reg_image_ids()),
            key=lambda image: natural_sort_key(Path(image.name)),
        )
    except Exception as cause:  # what C++ throws; a damaged count is a bad_alloc
        raise InputError(f"{folder} holds no COLMAP model that can be read ({cause}).") from cause
    if not images:
        raise InputError(f"The COLMAP model in {folder} has no registered picture.")
    return [
        NamedCamera(name=image_name(image.name), camera=_colmap_camera(image, model, folder))
        for image in images
    ]


def _copy_without_points(folder: Path, bare: Path) -> None:
    """Copies a model's cameras and pictures, which is all that is wanted, once they are sound.

    Counts that a damaged file claims are believed by COLMAP's reader, which then reads beyond the
    end for minutes and fills the memory.

    Raises:
        ValueError: If counts and sizes do not fit.
    """
    ending = ".bin" if (folder / "cameras.bin").is_file() else ".txt"
    for part in ("cameras", "images"):
        shutil.copyfile(folder / f"{part}{ending}", bare / f"{part}{ending}")
    (bare / f"points3D{ending}").write_bytes(bytes(8) if ending == ".bin" else b"")
    if ending == ".txt":
        return
    cameras, images = ((bare / f"{part}.bin").read_bytes() for part in ("cameras", "images"))
    if len(cameras) < 8 + MIN_CAMERA_BYTES * _count(cameras, 0):
        raise ValueError("cameras.bin is cut off")
    place = 8
    for _ in range(_count(images, 0)):
        name_ends = images.find(b"\0", place + IMAGE_HEADER_BYTES)
        if name_ends < 0:
            raise ValueError("images.bin is cut off")
        place = name_ends + 9 + POINT_BYTES * _count(images, name_ends + 1)
        if place > len(images):
            raise ValueError("images.bin is cut off")


def _count(data: bytes, place: int) -> int:
    """COLMAP's 64-bit number of what follows."""
    return int.from_bytes(data[place : place + 8], "little") if place + 8 <= len(data) else 1 << 62


def _colmap_camera(image: Any, model: Any, folder: Path) -> Camera:
    lens = model.camera(image.camera_id)
    kind = lens.model_name
    if kind not in OPENCV_DISTORTION:
        raise InputError(
            f"The COLMAP model in {folder} has a camera of the model {kind}; expected one of "
            f"{', '.join(OPENCV_DISTORTION)}. Undistort the pictures first (colmap "
            "image_undistorter)."
        )
    camera_from_world = np.eye(4)
    camera_from_world[:3] = image.cam_from_world().matrix()
    distortion = tuple(float(k) for k in OPENCV_DISTORTION[kind](lens.params))
    return Camera.from_intrinsic(
        lens.calibration_matrix(),
        (int(lens.width), int(lens.height)),
        camera_from_world,
        distortion if any(distortion) else (),
    )


INTRINSICS = "intri.yml"
"""EasyMocap's file of camera matrices and distortions."""

EXTRINSICS = "extri.yml"
"""EasyMocap's file of rotations and translations."""

ZJU = "annots.npy"
"""ZJU-MoCap's file of all cameras."""

OPENCV_MATRIX_PATTERN = re.compile(
    r"^(\w+):\s*!!opencv-matrix\s+rows:\s*(\d+)\s+cols:\s*(\d+)\s+dt:\s*\w+\s+data:\s*\[([^\]]*)\]",
    re.MULTILINE,
)
"""A matrix in OpenCV's YAML. OpenCV's own reader writes beyond its memory on damaged files."""

IMAGE_SIZE_PATTERN = re.compile(r"^([HW]_\w+):\s*([0-9.]+)\s*$", re.MULTILINE)
"""Width or height of a camera's images in OpenCV's YAML."""

MAX_YAML_BYTES = 1 << 24
"""Largest YAML file that is read."""

MM_PER_M = 1000.0
"""Millimetres in a metre: the unit of ZJU-MoCap's translations."""

MAX_PARENT_FOLDERS = 3
"""Number of folders above an image whose names may be its camera's."""

Numbers = Mapping[str, Float[np.ndarray, "rows columns"]]


def find_multi_view_cameras(path: Path) -> Path | None:
    """The folder or file of a studio's cameras, if there is one."""
    if path.name in (INTRINSICS, EXTRINSICS):
        path = path.parent
    if path.is_dir() and (path / INTRINSICS).is_file() and (path / EXTRINSICS).is_file():
        return path
    found = path / ZJU if path.is_dir() else path
    return found if found.name == ZJU and found.is_file() else None


def read_multi_view_camera(
    rig: Path, video: Path | None, size_px: tuple[int, int] | None
) -> Camera:
    """The camera of a video, or of a folder of pictures, that is named like it.

    Args:
        rig: What `find_multi_view_cameras` found.
        video: The video or folder; None if there are only poses, and one camera is expected.
        size_px: Width and height of its frames, for files that state none; None for twice the
            principal point.

    Raises:
        InputError: If there is no such camera, or it is none.
    """
    cameras = _zju(rig) if rig.name == ZJU else _easymocap(rig)
    if not cameras:
        raise InputError(f"{rig} holds no cameras; expected K_01, Rot_01 and T_01, or `cams`.")
    name = next(iter(cameras)) if len(cameras) == 1 else _camera_named_like(video, cameras)
    if name is None:
        listed = ", ".join(list(cameras)[:12]) + (" …" if len(cameras) > 12 else "")
        raise InputError(
            f"{rig} holds {len(cameras)} cameras ({listed}), and {video} is named like none of "
            "them. Name the video, or the folder of its pictures, like its camera."
        )
    return _studio_camera(cameras[name], size_px, f"{rig}, camera {name}")


def _camera_named_like(video: Path | None, cameras: Mapping[str, Any]) -> str | None:
    if video is None:
        return None
    whole = video.resolve()
    names = [
        whole.stem,
        whole.name,
        *(folder.name for folder in whole.parents[:MAX_PARENT_FOLDERS]),
    ]
    return next((name for name in names if name in cameras), None)


def _studio_camera(numbers: Numbers, size_px: tuple[int, int] | None, where: str) -> Camera:
    """Out of K, R (3x3), T and perhaps D, W and H."""
    try:
        intrinsic = numbers["K"].reshape(3, 3)
        matrix = np.column_stack([numbers["R"].reshape(3, 3), numbers["T"].reshape(3)])
        bends = tuple(float(k) for k in numbers["D"].reshape(-1)[:5]) if "D" in numbers else ()
        width, height = float(numbers["W"].item()), float(numbers["H"].item())
    except (KeyError, ValueError) as cause:
        raise InputError(f"{where}: expected K (3x3), a rotation and T (3) ({cause}).") from cause
    if not np.isfinite(bends).all() or len(bends) not in (0, 4, 5):
        raise InputError(f"{where}: its distortion is not OpenCV's (4 or 5 numbers).")
    found = dict(zip(("fx", "fy", "cx", "cy"), intrinsic[[0, 1, 0, 1], [0, 1, 2, 2]], strict=True))
    width_px, height_px = size_px or (2.0 * found["cx"], 2.0 * found["cy"])
    found |= {"w": width or width_px, "h": height or height_px}
    return parse_pinhole_camera(
        found,
        ("fx", "fy", "cx", "cy", "w", "h"),
        parse_rigid_transform(matrix, where),
        bends,
        where,
    )


def _easymocap(folder: Path) -> dict[str, Numbers]:
    found: dict[str, Any] = {}
    for file in (INTRINSICS, EXTRINSICS):
        text = _text(folder / file)
        found |= {
            name: _matrix(int(rows), int(columns), data, folder / file)
            for name, rows, columns, data in OPENCV_MATRIX_PATTERN.findall(text)
        }
        found |= {
            name: np.array([[float(number)]]) for name, number in IMAGE_SIZE_PATTERN.findall(text)
        }
    cameras = {}
    for name in (key.removeprefix("K_") for key in found if key.startswith("K_")):
        turn = found.get(f"Rot_{name}", found.get(f"R_{name}"))
        if turn is None or f"T_{name}" not in found:
            continue
        if turn.size == 3:
            turn = Rotation.from_rotvec(np.nan_to_num(turn.reshape(3))).as_matrix()
        parts = {"K": found[f"K_{name}"], "R": turn, "T": found[f"T_{name}"]}
        parts |= {side: found.get(f"{side}_{name}", np.zeros((1, 1))) for side in "WH"}
        bends = found.get(f"dist_{name}", found.get(f"D_{name}"))
        cameras[name] = parts if bends is None else {**parts, "D": bends}
    return cameras


def _text(path: Path) -> str:
    try:
        if path.stat().st_size > MAX_YAML_BYTES:
            raise InputError(
                f"{path} is larger than {MAX_YAML_BYTES >> 20} MiB; it holds no cameras."
            )
        return path.read_text(encoding="utf-8", errors="replace").replace("\r\n", "\n")
    except OSError as cause:
        raise InputError(f"{path} cannot be read ({cause}).") from cause


def _matrix(rows: int, columns: int, data: str, path: Path) -> Float[np.ndarray, "rows columns"]:
    try:
        return np.array([float(number) for number in data.split(",")]).reshape(rows, columns)
    except ValueError as cause:
        raise InputError(
            f"{path}: a matrix holds something else than it says ({cause})."
        ) from cause


def _zju(path: Path) -> dict[str, Numbers]:
    """All cameras of an annots.npy, named like the folders of their pictures."""
    content = read_untrusted_file(path)
    try:
        cams = content["cams"]
        names = [PurePosixPath(str(name)).parent.name for name in content["ims"][0]["ims"]]
        size = {side: np.zeros((1, 1)) for side in "WH"}
        return {
            name: {
                **size,
                **{key: np.array(cams[key][row], dtype=np.float64, ndmin=2) for key in "KDR"},
                "T": np.array(cams["T"][row], dtype=np.float64, ndmin=2) / MM_PER_M,
            }
            for row, name in enumerate(names)
        }
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as cause:
        raise InputError(f"{path} holds no `cams` and `ims` of ZJU-MoCap ({cause}).") from cause
