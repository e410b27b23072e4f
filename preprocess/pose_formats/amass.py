"""Motion capture to drive an avatar: AMASS (SMPL+H, SMPL-X) and AIST++.

Layout, AMASS: .npz with poses (N, 156) = root, 21 body joints, hands; trans (N, 3), betas (16,),
gender, mocap_framerate; newer `*_stageii.npz`: root_orient (N, 3), pose_body (N, 63), trans, betas,
mocap_frame_rate, surface_model_type. World with z up. AIST++: pickle with smpl_poses (N, 72) or
(N, 24, 3), smpl_scaling (1,), smpl_trans (N, 3) in units of the scaling, 60 rows a second.
(amass.is.tue.mpg.de; github.com/google/aistplusplus_api, aist_plusplus/loader.py.)
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from preprocess.poses.motion_builder import MotionByPerson, build_motion

AIST_FPS = 60.0
"""Poses per second of all AIST++ motions, by their documentation."""
SMPLX_ROW_SIZE = 165
"""Numbers a row that only SMPL-X has: 55 joints."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The motion of the file; None if it is neither."""
    if not isinstance(content, dict):
        return None
    if {"smpl_poses", "smpl_trans"} <= content.keys():
        return {"0": _aist(content)}
    if {"root_orient", "pose_body", "trans"} <= content.keys():
        parts = [content["root_orient"], content["pose_body"]]
    elif {"poses", "trans"} <= content.keys() and _rate(content) is not None:
        parts = [content["poses"]]
    else:
        return None
    model = str(content.get("surface_model_type", "smpl"))
    numbers = sum(np.asarray(part).size for part in parts) / max(1, len(content["trans"]))
    is_smplx = "smplx" in model.replace("-", "").lower() or numbers == SMPLX_ROW_SIZE
    motion = build_motion(
        parts,
        content["trans"],
        betas=np.asarray(content["betas"], dtype=np.float64).reshape(-1)[:10]
        if "betas" in content
        else None,
        times_s=_times(len(np.asarray(content["trans"])), _rate(content)),
        body_model="smplx" if is_smplx else "smpl",
        space="world",
    )
    return {"0": motion}


def _aist(content: dict[str, Any]) -> Any:
    places = np.asarray(content["smpl_trans"], dtype=np.float64)
    scaling = float(np.asarray(content.get("smpl_scaling", 1.0)).reshape(-1)[0])
    if not np.isfinite(scaling) or scaling <= 0.0:
        raise ValueError(f"`smpl_scaling` of {scaling}")
    poses = np.asarray(content["smpl_poses"], dtype=np.float64).reshape(len(places), -1)
    times_s = _times(len(places), AIST_FPS)
    return build_motion([poses], places / scaling, times_s=times_s, space="world")


def _rate(content: dict[str, Any]) -> float | None:
    keys = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")
    found = next((content[key] for key in keys if key in content), None)
    rate = None if found is None else float(np.asarray(found).reshape(-1)[0])
    return rate if rate is not None and np.isfinite(rate) and rate > 0.0 else None


def _times(count: int, rate: float | None) -> Float[np.ndarray, "poses"] | None:
    return None if rate is None else np.arange(count) / rate
