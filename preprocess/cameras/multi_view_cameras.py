"""A studio's cameras, several that stand still: EasyMocap's and ZJU-MoCap's.

The video's name says which is its own. EasyMocap: `intri.yml` (K_01, dist_01, …) and `extri.yml`
(Rot_01 or, as a rotation vector, R_01; T_01) in OpenCV's YAML, camera-from-world, metres.
ZJU-MoCap: `annots.npy` {cams: {K, D, R, T in mm}, ims: [{ims: [Camera_B1/000000.jpg, …]}]}.
(github.com/zju3dv/EasyMocap, easymocap/mytools/camera_utils.py; github.com/zju3dv/neuralbody.)
"""

import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.input_error import InputError
from preprocess.cameras.named_camera import checked_camera
from preprocess.file_content import explain_damage, read_untrusted_file

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
EASYMOCAP_KEYS = (
    ("K", "K"), ("R", "R"), ("R", "Rot"), ("T", "T"), ("D", "D"), ("D", "dist"), ("W", "W"),
    ("H", "H"),
)  # fmt: skip
"""A camera's parts and their prefixes in EasyMocap's files; the last that is there counts."""
IMAGE_SIZE_PATTERN = re.compile(r"^([HW]_\w+):\s*([0-9.]+)\s*$", re.MULTILINE)
"""Width or height of a camera's images in OpenCV's YAML."""
MAX_PARENT_FOLDERS = 3
"""Number of folders above an image whose names may be its camera's."""
StudioCamera = Mapping[str, Float[np.ndarray, "rows columns"]]
"""K, R, T, and perhaps D (distortion), W and H, by these names."""


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
    """The camera of a video, or of a folder of images, that is named like it.

    Args:
        rig: Result of `find_multi_view_cameras`.
        video: The video or folder; None if there are only poses, and one camera is expected.
        size_px: Width and height of its frames, for files that state none; None for twice the
            principal point.
    """
    with explain_damage(rig, "cameras of EasyMocap or ZJU-MoCap"):
        cameras = _read_zju(rig) if rig.name == ZJU else _read_easymocap(rig)
        if not cameras:
            raise ValueError("it holds no K_01, Rot_01 and T_01")
        name = next(iter(cameras)) if len(cameras) == 1 else _camera_named_like(video, cameras)
        if name is None:
            listed = ", ".join(list(cameras)[:12]) + (" …" if len(cameras) > 12 else "")
            raise InputError(
                f"{rig} holds {len(cameras)} cameras ({listed}), and {video} is named like none of "
                "them. Name the video, or the folder of its images, like its camera."
            )
        return _camera_of(cameras[name], size_px)


def _camera_named_like(video: Path | None, cameras: Mapping[str, StudioCamera]) -> str | None:
    if video is None:
        return None
    whole = video.resolve()
    folders = [folder.name for folder in whole.parents[:MAX_PARENT_FOLDERS]]
    return next((name for name in (whole.stem, whole.name, *folders) if name in cameras), None)


def _camera_of(numbers: StudioCamera, size_px: tuple[int, int] | None) -> Camera:
    k = numbers["K"].reshape(3, 3)
    distortion = numbers["D"].reshape(-1)[:5] if "D" in numbers else np.zeros(0)
    if len(distortion) not in (0, 4, 5):
        raise ValueError("its distortion is not OpenCV's (4 or 5 numbers)")
    width, height = size_px or (2.0 * k[0, 2], 2.0 * k[1, 2])
    if "W" in numbers and "H" in numbers:
        width, height = numbers["W"].item(), numbers["H"].item()
    view = np.column_stack([numbers["R"].reshape(3, 3), numbers["T"].reshape(3)])
    return checked_camera((k[0, 0], k[1, 1]), k[:2, 2], (width, height), view, distortion)


def _read_easymocap(folder: Path) -> dict[str, StudioCamera]:
    matrices: dict[str, np.ndarray] = {}
    for path in (folder / INTRINSICS, folder / EXTRINSICS):
        text = path.read_text(encoding="utf-8", errors="replace")
        for name, rows, columns, data in OPENCV_MATRIX_PATTERN.findall(text):
            numbers = [float(number) for number in data.split(",")]
            matrices[name] = np.array(numbers).reshape(int(rows), int(columns))
        for name, number in IMAGE_SIZE_PATTERN.findall(text):
            matrices[name] = np.array([[float(number)]])
    cameras: dict[str, StudioCamera] = {}
    for name in (key.removeprefix("K_") for key in matrices if key.startswith("K_")):
        camera = {
            part: matrices[f"{prefix}_{name}"]
            for part, prefix in EASYMOCAP_KEYS
            if f"{prefix}_{name}" in matrices
        }
        if {"R", "T"} <= camera.keys():
            if camera["R"].size == 3:
                camera["R"] = Rotation.from_rotvec(camera["R"].reshape(3)).as_matrix()
            cameras[name] = camera
    return cameras


def _read_zju(path: Path) -> dict[str, StudioCamera]:
    """All cameras of an annots.npy, named like the folders of their images."""
    content = read_untrusted_file(path)
    cams = content["cams"]
    cameras: dict[str, StudioCamera] = {}
    for row, image in enumerate(content["ims"][0]["ims"]):
        camera = {key: np.array(cams[key][row], dtype=np.float64, ndmin=2) for key in "KDRT"}
        camera["T"] /= 1000.0  # from millimetres
        cameras[PurePosixPath(str(image)).parent.name] = camera
    return cameras
