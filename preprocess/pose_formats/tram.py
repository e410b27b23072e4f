"""TRAM: rotation matrices by person, each in a file of its own, beside the camera's file.

Layout: `hps/hps_track_K.npy`, a pickled {pred_rotmat (N, 24, 3, 3), pred_shape (N, 10), pred_trans
(N, 1, 3), pred_cam, frame (N,)} of torch tensors, metres in the camera; `camera.npy` {img_focal,
img_center, world_cam_R, world_cam_T, …}. Give one track, the folder `hps`, or the folder above.
(github.com/yufu-wang/tram, scripts/estimate_humans.py and visualize_tram.)
"""

import re
from typing import Any

import numpy as np
from jaxtyping import Float

from preprocess.poses.motion_builder import MotionByPerson, build_motion

REQUIRED_KEYS = {"pred_rotmat", "pred_trans", "frame"}
"""Keys by which a file of TRAM is recognised."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The people of the file or folder; None if it is none of TRAM's."""
    if not isinstance(content, dict):
        return None
    if content.keys() >= REQUIRED_KEYS:
        return {"0": _person(content, None)}
    people = {
        (re.findall(r"\d+", name) or [name])[-1]: rows
        for name, rows in content.items()
        if isinstance(rows, dict) and rows.keys() >= REQUIRED_KEYS
    }
    if not people:
        return None
    camera = content.get("camera.npy")
    return {person: _person(rows, camera) for person, rows in people.items()}


def _person(rows: dict[str, Any], camera: Any) -> Any:
    focal, center = rows.get("img_focal"), rows.get("img_center")
    if isinstance(camera, dict):
        focal, center = camera.get("img_focal"), camera.get("img_center")
    return build_motion(
        [rows["pred_rotmat"]],
        np.reshape(rows["pred_trans"], (-1, 3)),
        betas=rows.get("pred_shape"),
        frames=rows["frame"],
        lens=intrinsic_from_focal(focal, center),
    )


def intrinsic_from_focal(focal: Any, center: Any) -> Float[np.ndarray, "3 3"] | None:
    """Camera matrix K of a focal length and a principal point; None where one is missing."""
    if focal is None or center is None:
        return None
    f, (x, y) = float(np.asarray(focal).reshape(-1)[0]), np.asarray(center).reshape(-1)[:2]
    return np.array([[f, 0.0, float(x)], [0.0, f, float(y)], [0.0, 0.0, 1.0]])
