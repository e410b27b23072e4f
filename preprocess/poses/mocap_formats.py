"""Pose files of studios and data sets, whose poses are in a world.

AMASS and AIST++ (motion capture to drive an avatar), EasyMocap and ZJU-MoCap (a json a frame),
SLAHMR and 3DPW (several people in one array, with the cameras). One `parse_…` a layout: the people
of a file's content by their names, or None if it is another's.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from preprocess.body.body_pose import Motion
from preprocess.body.kinematics import rigid_transform
from preprocess.frame_association import frame_numbers_from_names
from preprocess.poses.motion_builder import MotionByPerson, build_motion, stack_rows

AIST_FPS = 60.0
"""Poses per second of all AIST++ motions, by their documentation."""
SMPLX_ROW_SIZE = 165
"""Numbers a row that only SMPL-X has: 55 joints."""
EASYMOCAP_KEYS = {"Rh", "Th", "poses"}
"""Keys by which a file of EasyMocap is recognised."""
SLAHMR_KEYS = frozenset({"root_orient", "pose_body", "trans"})
"""Keys by which a file of SLAHMR is recognised."""
DPW_KEYS = frozenset({"poses", "trans", "cam_poses", "cam_intrinsics"})
"""Keys by which a file of 3DPW is recognised."""


def parse_amass(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """Motion capture: AMASS (SMPL+H, SMPL-X) and AIST++.

    Layout, AMASS: .npz with poses (N, 156) = root, 21 body joints, hands; trans (N, 3), betas
    (16,), gender, mocap_framerate; newer `*_stageii.npz`: root_orient (N, 3), pose_body (N, 63),
    trans, betas, mocap_frame_rate, surface_model_type. World with z up. AIST++: pickle with
    smpl_poses (N, 72) or (N, 24, 3), smpl_scaling (1,), smpl_trans (N, 3) in units of the scaling,
    60 rows a second. (amass.is.tue.mpg.de; github.com/google/aistplusplus_api, loader.py.)
    """
    if not isinstance(content, dict):
        return None
    if {"smpl_poses", "smpl_trans"} <= content.keys():
        return {"0": _aist_motion(content)}
    if {"root_orient", "pose_body", "trans"} <= content.keys():
        parts = [content["root_orient"], content["pose_body"]]
    elif {"poses", "trans"} <= content.keys() and _rate(content) is not None:
        parts = [content["poses"]]
    else:
        return None
    rate = _rate(content)
    model = str(content.get("surface_model_type", "smpl"))
    numbers = sum(np.asarray(part).size for part in parts) / max(1, len(content["trans"]))
    is_smplx = "smplx" in model.replace("-", "").lower() or numbers == SMPLX_ROW_SIZE
    motion = build_motion(
        parts,
        content["trans"],
        betas=np.asarray(content["betas"], dtype=np.float64).reshape(-1)[:10]
        if "betas" in content
        else None,
        times_s=None if rate is None else np.arange(len(np.asarray(content["trans"]))) / rate,
        body_model="smplx" if is_smplx else "smpl",
        space="world",
    )
    return {"0": motion}


def _aist_motion(content: dict[str, Any]) -> Motion:
    places = np.asarray(content["smpl_trans"], dtype=np.float64)
    scaling = float(np.asarray(content.get("smpl_scaling", 1.0)).reshape(-1)[0])
    if not np.isfinite(scaling) or scaling <= 0.0:
        raise ValueError(f"`smpl_scaling` of {scaling}")
    poses = np.asarray(content["smpl_poses"], dtype=np.float64).reshape(len(places), -1)
    times_s = np.arange(len(places)) / AIST_FPS
    return build_motion([poses], places / scaling, times_s=times_s, space="world")


def _rate(content: dict[str, Any]) -> float | None:
    keys = ("mocap_framerate", "mocap_frame_rate", "frame_rate", "fps")
    found = next((content[key] for key in keys if key in content), None)
    rate = None if found is None else float(np.asarray(found).reshape(-1)[0])
    return rate if rate is not None and np.isfinite(rate) and rate > 0.0 else None


def parse_easymocap(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """EasyMocap and ZJU-MoCap: a json a frame, and a rotation about the origin, not the pelvis.

    Layout: a folder of `000000.json` …, each a list of {id, Rh (1, 3), Th (1, 3), poses (1, 72)
    whose first three are 0 (or 63, 69, 87 numbers), shapes (1, 10)}, or {annots: that list}.
    ZJU-MoCap's `new_params/0.npy` hold one of these each. World: the calibrated cameras'
    (extri.yml). V = R(Rh) LBS(poses) + Th.
    (github.com/zju3dv/EasyMocap, easymocap/mytools/file_utils.py.)
    """
    files = content if isinstance(content, dict) else {"0": content}
    if files.keys() >= EASYMOCAP_KEYS:
        files = {"0": content}
    frames = {name: _easymocap_people(held) for name, held in files.items()}
    if not frames or any(people is None for people in frames.values()):
        return None
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for number, people in zip(frame_numbers_from_names(frames), frames.values(), strict=True):
        for person in people or ():
            name = str(person.get("id", person.get("personID", 0)))
            found.setdefault(name, []).append((number, person))
    return {name: _easymocap_motion(rows) for name, rows in found.items()} or None


def _easymocap_people(held: Any) -> list[dict[str, Any]] | None:
    if isinstance(held, dict) and "annots" in held:
        held = held["annots"]
    listed = [held] if isinstance(held, dict) else held
    if not isinstance(listed, list) or not all(
        isinstance(person, dict) and person.keys() >= EASYMOCAP_KEYS for person in listed
    ):
        return None
    return listed


def _easymocap_motion(rows: list[tuple[int, dict[str, Any]]]) -> Motion:
    people = [person for _, person in rows]
    return build_motion(
        [
            stack_rows([np.reshape(p["Rh"], 3) for p in people]),
            stack_rows([_easymocap_joints(p) for p in people]),
        ],
        stack_rows([np.reshape(p["Th"], 3) for p in people]),
        betas=stack_rows([np.reshape(p["shapes"], -1)[:10] for p in people])
        if all("shapes" in person for person in people)
        else None,
        frames=[number for number, _ in rows],
        space="world",
        anchor="origin",
    )


def _easymocap_joints(person: dict[str, Any]) -> Float[np.ndarray, "numbers"]:
    """The rotations of the joints but the root; 72 and 66 numbers begin with the root at rest."""
    numbers = np.asarray(person["poses"], dtype=np.float64).reshape(-1)
    if len(numbers) in (66, 72, 78, 87, 156, 165):
        if np.abs(numbers[:3]).max() > 1e-6:
            raise ValueError("`poses` turn the root although `Rh` does; expected its first 3 at 0")
        return numbers[3:72] if len(numbers) == 72 else numbers[3:66]
    return numbers if len(numbers) == 69 else numbers[:63]


def parse_slahmr(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """Several people in one array, with the file's own cameras: SLAHMR, its successors, and 3DPW.

    Layout: SLAHMR's `*_world_results.npz` {trans (P, N, 3), root_orient (P, N, 3), pose_body
    (P, N, 63), betas (P, 16), cam_R (P, N, 3, 3) and cam_t (P, N, 3) camera-from-world, intrins
    (4,) = fx fy cx cy, perhaps track_mask (P, N)}, metres; 3DPW's pickle {poses [(N, 72)], trans
    [(N, 3)], betas, cam_poses (N, 4, 4), cam_intrinsics}. (github.com/vye16/slahmr,
    optim/output.py; 3DPW's readme.)
    """
    if not isinstance(content, dict):
        return None
    if content.keys() >= DPW_KEYS:
        rows = zip(content["poses"], content["trans"], strict=True)
        shapes = content.get("betas") or [None] * len(content["trans"])
        cameras = np.asarray(content["cam_poses"], dtype=np.float64)
        intrinsic = np.asarray(content["cam_intrinsics"], dtype=np.float64)
        return {
            str(number): _with_cameras(
                build_motion([poses], places, betas=shape, space="world", lens=intrinsic), cameras
            )
            for number, ((poses, places), shape) in enumerate(zip(rows, shapes, strict=True))
        }
    if not content.keys() >= SLAHMR_KEYS or np.ndim(content["trans"]) != 3:
        return None
    return {str(number): _slahmr_motion(content, number) for number in range(len(content["trans"]))}


def _slahmr_motion(content: dict[str, Any], number: int) -> Motion:
    intrinsic = None
    if "intrins" in content:
        fx, fy, cx, cy = np.asarray(content["intrins"], dtype=np.float64).reshape(-1, 4)[0]
        intrinsic = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
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
        lens=intrinsic,
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
