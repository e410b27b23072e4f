"""COLMAP models, 3.x and 4.x, binary and text, read by pycolmap."""

from pathlib import Path
from typing import Any

import numpy as np

from capture.camera import Camera
from capture.errors import BadInput
from capture.images import natural_key
from preprocess.cameras.named import NamedCamera

PLACES = (".", "sparse/0", "0", "sparse", "colmap/sparse/0", "dense/sparse")
"""Where models lie in a folder, as COLMAP, nerfstudio and others leave them."""

PADDED = {
    "SIMPLE_PINHOLE": lambda p: (),
    "PINHOLE": lambda p: (),
    "SIMPLE_RADIAL": lambda p: (p[3], 0.0, 0.0, 0.0),
    "RADIAL": lambda p: (p[3], p[4], 0.0, 0.0),
    "OPENCV": lambda p: tuple(p[4:8]),
    "FULL_OPENCV": lambda p: tuple(p[4:12]),
}
"""OpenCV's coefficients in COLMAP's parameters, by the camera's model."""


def find_model(folder: Path) -> Path | None:
    """The folder in which a COLMAP model lies, if one does."""
    for place in PLACES:
        for ending in (".bin", ".txt"):
            found = folder / place
            if all((found / f"{part}{ending}").is_file() for part in ("cameras", "images")):
                return found
    return None


def read_colmap(folder: Path) -> list[NamedCamera]:
    """The registered pictures of a model, by name; its world and its unit stay COLMAP's.

    Raises:
        BadInput: If it cannot be read, is empty, or has a camera that OpenCV does not have.
    """
    import pycolmap  # heavy, and only needed for its own files

    pycolmap.logging.minloglevel = 3  # it would print to stderr what is said here
    try:
        model = pycolmap.Reconstruction(str(folder))
        images = sorted(
            (model.image(number) for number in model.reg_image_ids()),
            key=lambda image: natural_key(Path(image.name)),
        )
    except (RuntimeError, ValueError, IndexError, OSError) as cause:
        raise BadInput(f"{folder} holds no COLMAP model that can be read ({cause}).") from cause
    if not images:
        raise BadInput(f"The COLMAP model in {folder} has no registered picture.")
    return [
        NamedCamera(name=Path(image.name).stem, camera=_camera(image, model, folder))
        for image in images
    ]


def _camera(image: Any, model: Any, folder: Path) -> Camera:
    lens = model.camera(image.camera_id)
    kind = lens.model_name
    if kind not in PADDED:
        raise BadInput(
            f"The COLMAP model in {folder} has a camera of the model {kind}; expected one of "
            f"{', '.join(PADDED)}. Undistort the pictures first (colmap image_undistorter)."
        )
    camera_from_world = np.eye(4)
    camera_from_world[:3] = image.cam_from_world().matrix()
    distortion = tuple(float(k) for k in PADDED[kind](lens.params))
    return Camera.from_intrinsic(
        lens.calibration_matrix(),
        (int(lens.width), int(lens.height)),
        camera_from_world,
        distortion if any(distortion) else (),
    )
