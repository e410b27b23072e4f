"""Several people in one array: SLAHMR and its successors, and the data set 3DPW.

Layout: SLAHMR's `*_world_results.npz` {trans (P, N, 3), root_orient (P, N, 3), pose_body
(P, N, 63), betas (P, 16), cam_R (P, N, 3, 3) and cam_t (P, N, 3) camera-from-world, intrins (4,) =
fx fy cx cy, perhaps track_mask (P, N)}, metres; 3DPW's pickle {poses [(N, 72)], trans [(N, 3)],
betas, cam_poses (N, 4, 4), cam_intrinsics}. (github.com/vye16/slahmr, optim/output.py; 3DPW's
readme.)
"""

from dataclasses import replace
from typing import Any

import numpy as np

from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import rigid_transform
from preprocess.poses.motion_builder import MotionByPerson, build_motion

SLAHMR_KEYS = frozenset({"root_orient", "pose_body", "trans"})
"""Keys by which a file of SLAHMR is recognised."""

DPW_KEYS = frozenset({"poses", "trans", "cam_poses", "cam_intrinsics"})
"""Keys by which a file of 3DPW is recognised."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The people of the file, in the world, with its own cameras; None if it is another's."""
    if not isinstance(content, dict):
        return None
    if content.keys() >= DPW_KEYS:
        rows = zip(content["poses"], content["trans"], strict=True)
        shapes = content.get("betas") or [None] * len(content["trans"])
        cameras = np.asarray(content["cam_poses"], dtype=np.float64)
        intrinsic = np.asarray(content["cam_intrinsics"], dtype=np.float64)
        return {
            str(number): _with_cameras(
                build_motion([poses], places, betas=shape, space="world", lens=intrinsic),
                cameras,
            )
            for number, ((poses, places), shape) in enumerate(zip(rows, shapes, strict=True))
        }
    if not content.keys() >= SLAHMR_KEYS or np.ndim(content["trans"]) != 3:
        return None
    return {str(number): _slahmr(content, number) for number in range(len(content["trans"]))}


def _slahmr(content: dict[str, Any], number: int) -> Motion:
    found = build_motion(
        [content["root_orient"][number], content["pose_body"][number]],
        content["trans"][number],
        betas=np.asarray(content["betas"], dtype=np.float64)[number][..., :10]
        if "betas" in content
        else None,
        lost=~np.asarray(content["track_mask"], dtype=bool)[number]
        if "track_mask" in content
        else None,
        space="world",
        lens=_intrinsic_from_four(content["intrins"]) if "intrins" in content else None,
    )
    if not {"cam_R", "cam_t"} <= content.keys():
        return found
    turns, shifts = (np.asarray(content[key], dtype=np.float64) for key in ("cam_R", "cam_t"))
    cameras = rigid_transform(
        turns[number] if turns.ndim == 4 else turns, shifts[number] if shifts.ndim == 3 else shifts
    )
    return _with_cameras(found, cameras)


def _with_cameras(motion: Motion, cameras: np.ndarray) -> Motion:
    if cameras.shape != (len(motion), 4, 4) or not np.isfinite(cameras).all():
        raise ValueError(f"cameras of the shape {cameras.shape} for {len(motion)} poses")
    return replace(motion, camera_from_world=cameras)


def _intrinsic_from_four(numbers: Any) -> np.ndarray:
    fx, fy, cx, cy = np.asarray(numbers, dtype=np.float64).reshape(-1, 4)[0]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
