"""Pose files in InstantAvatar's keys, which its successors write too, with a few keys of ours.

global_orient, body_pose, transl; or thetas, transl; or poses, trans (`motion_from_arrays`); in any
container, or one file a frame. mmhuman3d's HumanData and EMDB hold these under `smpl`. Other names
of the keys are known, too (`KEY_ALIASES`).

A pose a frame: a folder of .npz, .json or .pkl, or one file with a list or with objects by frames'
names, each with these keys for one row: ExAvatar's `smplx_params/0.json` {root_pose, body_pose,
trans}, LHM's with focal and princpt beside, SMPLer-X's `00001_0.npz`, ARAH's `models/000001.npz`
{root_orient, pose_body, trans}, HumanNeRF's `metadata.json` {frame_000001: {poses, cam_intrinsics,
cam_extrinsics}}, whose camera alone says where the person is.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from capture.input_error import InputError
from preprocess.body.body_pose import DIAGONAL_FOCAL, Motion, PoseSpace
from preprocess.cameras.camera_formats import checked_rigid
from preprocess.file_content import explain_damage
from preprocess.frame_association import frame_numbers_from_names
from preprocess.poses.motion_builder import MotionByPerson, build_motion
from preprocess.tracking.keypoints import KEYPOINT_SHAPES, KeypointTrack

POSE_KEY_LAYOUTS = (
    ("global_orient", "body_pose", "transl"),
    ("thetas", "transl"),
    ("poses", "trans"),
)
"""The keys that may hold the poses, first match wins; one array of 72 starts with the root."""
CAMERA_KEYS = ("camera_from_world", "w2c", "camera")
"""Keys of camera-from-world, best first."""
Arrays = dict[str, Shaped[np.ndarray, "..."]]
KEY_ALIASES = {
    "global_orient": ("root_orient", "root_pose", "poses_root"),
    "body_pose": ("pose_body", "poses_body"),
    "thetas": ("pose", "smpl_poses"),
    "transl": ("trans", "global_t", "smpl_trans"),
    "betas": ("shape", "smpl_betas"),
    "valid": ("good_frames_mask",),
    "K": ("cam_intrinsics", "intrinsics"),
    "camera": ("cam_extrinsics", "extrinsics"),
}
"""Names of the same numbers in other programs: ExAvatar, ARAH, EMDB, CLIFF, HumanNeRF and more."""
SMPLX_KEYS = frozenset(
    {"left_hand_pose", "lhand_pose", "jaw_pose", "leye_pose", "expression", "expr"}
)
"""Keys of which one is enough to know the body."""
RECOGNIZED_KEYS = (
    *{key: None for keys in POSE_KEY_LAYOUTS for key in keys}, *CAMERA_KEYS, "betas", "frame",
    "time", "valid", "K", "model", "space", "scale", "proportions", "program", *KEYPOINT_SHAPES,
)  # fmt: skip
"""Keys that are read of a file; all others are left there."""
ROTATION_KEYS = ("global_orient", "body_pose", "thetas", "poses")
"""Keys of rotations."""
ROW_SHAPES = {"transl": (3,), "K": (3, 3), "camera": (4, 4), "betas": (-1,)}
"""Shape of one row of each other array."""


def motion_from_arrays(arrays: Arrays, path: Path) -> Motion:
    """The poses in the arrays of a file: axis-angles and metres, one row a pose.

    Keys: global_orient (N, 3) and body_pose (N, 69), or thetas or poses (N, 72); transl or trans
    (N, 3); optional betas (B,), (1, B) or (N, B), frame (N), time (N), valid (N), K (3, 3) or
    (N, 3, 3), camera (4, 4) or (N, 4, 4) camera-from-world, model (else SMPL's), space
    ("world", or "camera": each row is in the camera of its frame), proportions and program (see
    `Motion`), and the arrays of `KeypointTrack`. Rows with NaN are marked as not valid. Rotations
    may be 3x3 matrices; a body_pose of 63 numbers has no hands.

    An InputError names the file and the key that holds something else.
    """
    with explain_damage(path, "poses"):
        return _motion(arrays)


def _motion(arrays: Arrays) -> Motion:
    layout = next((keys for keys in POSE_KEY_LAYOUTS if set(keys) <= arrays.keys()), None)
    if layout is None:
        expected = "; or ".join(" and ".join(keys) for keys in POSE_KEY_LAYOUTS)
        raise ValueError(f"it holds {', '.join(sorted(arrays)) or 'nothing'}; expected {expected}.")
    *rotations, translations = (_rows(arrays, key) for key in layout)
    count = len(translations)
    frames, times_s, marked = (_per_row(arrays, key, count) for key in ("frame", "time", "valid"))
    if frames is not None and len(np.unique(frames)) < count:
        raise ValueError("`frame` names a frame twice; expected one person's poses.")
    lost = np.zeros(count, dtype=bool) if marked is None else ~(marked > 0)
    if times_s is not None:
        lost |= ~np.isfinite(times_s)
    motion = build_motion(
        rotations, translations, frames=frames, times_s=times_s, lost=lost,
        betas=_read_numbers(arrays, "betas") if "betas" in arrays else None,
        body_model=str(arrays.get("model", "smpl")), space=_space(arrays),
        lens=_read_numbers(arrays, "K") if "K" in arrays else None,
    )  # fmt: skip
    cameras = _cameras(arrays, count)
    if cameras is not None and frames is not None:
        cameras = cameras[frames.argsort()]
    return replace(
        motion,
        camera_from_world=cameras,
        proportions=_proportions(arrays),
        keypoints=KeypointTrack.from_arrays(arrays),
        program=str(arrays["program"]) if "program" in arrays else None,
    )


def write_motion(path: Path, motion: Motion) -> None:
    """Write a motion in the keys of `motion_from_arrays`; reading gives `as_stored`."""
    arrays: dict[str, Any] = _motion_arrays(motion)
    np.savez_compressed(path, **arrays)


def as_stored(motion: Motion, path: Path) -> Motion:
    """The motion as a file would give it back: key points rounded, notes left out."""
    return motion_from_arrays(_motion_arrays(motion), path)


def _motion_arrays(motion: Motion) -> Arrays:
    arrays = {
        "betas": motion.betas,
        "global_orient": motion.root_rotations,
        "body_pose": motion.joint_rotations.reshape(len(motion), 69),
        "transl": motion.root_translations,
        "valid": motion.valid,
        "model": np.array(motion.body_model),
        "frame": motion.frames,
        "time": motion.times_s,
        "K": motion.intrinsic,
        "camera": motion.camera_from_world,
        "space": None if motion.space == "world" else np.array(motion.space),
        "proportions": motion.proportions,
        "program": None if motion.program is None else np.array(motion.program),
        **({} if motion.keypoints is None else motion.keypoints.as_arrays()),
    }
    return {key: array for key, array in arrays.items() if array is not None}


def _read_numbers(arrays: Arrays, key: str) -> Float[np.ndarray, "..."]:
    if arrays[key].dtype.kind not in "biuf":
        raise ValueError(f"`{key}` holds no numbers.")
    return arrays[key].astype(np.float64)


def _rows(arrays: Arrays, key: str) -> Float[np.ndarray, "poses *numbers"]:
    rows = _read_numbers(arrays, key)
    if rows.ndim < 2 or not rows.size:
        raise ValueError(f"`{key}` has the shape {rows.shape}; expected one row a pose.")
    return rows


def _per_row(arrays: Arrays, key: str, count: int) -> Float[np.ndarray, "poses"] | None:
    """An optional array of one number a pose."""
    if key not in arrays:
        return None
    numbers = _read_numbers(arrays, key).reshape(-1)
    if len(numbers) != count:
        raise ValueError(f"it holds {len(numbers)} numbers in `{key}` for {count} poses.")
    return numbers


def _proportions(arrays: Arrays) -> Float[np.ndarray, "coefficients"] | None:
    if "proportions" not in arrays:
        return None
    proportions = _read_numbers(arrays, "proportions")
    if proportions.ndim != 1 or not (np.abs(proportions) < 100.0).all():
        raise ValueError("`proportions` are no coefficients; expected finite numbers.")
    return proportions


def _space(arrays: Arrays) -> PoseSpace:
    said = str(arrays["space"]) if "space" in arrays else "world"
    if said == "world" or said == "camera":
        return said
    raise ValueError(f"`space` is {said!r}; expected world or camera.")


def _cameras(arrays: Arrays, count: int) -> Float[np.ndarray, "poses 4 4"] | None:
    """The camera of each row; one alone is that of all rows."""
    key = next((key for key in CAMERA_KEYS if key in arrays), None)
    if key is None:
        return None
    cameras = checked_rigid(_read_numbers(arrays, key))
    if cameras.shape not in ((4, 4), (count, 4, 4)):
        raise ValueError(f"`{key}` has the shape {cameras.shape}; expected one, or one a pose.")
    return np.broadcast_to(cameras, (count, 4, 4)).copy()


def parse_instant_avatar(content: Any, path: Path) -> MotionByPerson | None:
    """The person of the file; None if it has other keys."""
    if not isinstance(content, dict):
        return None
    held = content.get("smpl", content)
    if not isinstance(held, dict):
        return None
    named = normalize_keys(held)
    if held is not content:
        beside = {key: value for key, value in content.items() if not isinstance(value, dict)}
        if isinstance(content.get("camera"), dict):
            beside |= content["camera"]
        around = normalize_keys(beside)
        named |= {
            key: around[key]
            for key in ("frame", "time", "valid", "K", "camera")
            if key in around and key not in named
        }
    if not any(set(keys) <= named.keys() for keys in POSE_KEY_LAYOUTS):
        return None
    motion = motion_from_arrays(collect_arrays(named, path), path)
    if "global_t" in held:
        motion = replace(motion, assumed_focal=DIAGONAL_FOCAL, space="camera")
    return {"0": motion}


def normalize_keys(held: Mapping[Any, Any]) -> dict[str, Any]:
    """Rename other programs' keys to ours, where ours are missing.

    The body model follows from other keys: hands and face are SMPL-X's.
    """
    found = {str(key): value for key, value in held.items() if value is not None}
    for key, others in KEY_ALIASES.items():
        known = next((other for other in others if other in found), None)
        if key not in found and known is not None and not isinstance(found[known], dict):
            found[key] = found[known]
    if "K" not in found and {"focal", "princpt"} <= found.keys():
        found["K"] = _intrinsic_matrix(found["focal"], found["princpt"])
    if "model" not in found:
        kind = str(found.get("surface_model_type", "")).replace("-", "").lower()
        if SMPLX_KEYS & found.keys() or "smplx" in kind:
            found["model"] = "smplx"
    return found


def _intrinsic_matrix(focal: Any, center: Any) -> Any:
    """K of LHM's `focal` and `princpt`; NaN where they are none, which is refused."""
    try:
        (fx, fy), (cx, cy) = np.asarray(focal, float).ravel(), np.asarray(center, float).ravel()
    except (TypeError, ValueError):
        return np.full((3, 3), np.nan)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def collect_arrays(named: Mapping[str, Any], path: Path) -> Arrays:
    """The arrays that `motion_of` takes."""
    try:
        arrays = {key: np.asarray(named[key]) for key in RECOGNIZED_KEYS if key in named}
    except ValueError as cause:
        raise InputError(f"{path}: one of its arrays has rows of several lengths ({cause}).") from (
            cause
        )
    whole = arrays.get("thetas", arrays.get("poses"))
    if "model" not in arrays and whole is not None and whole.ndim >= 2 and whole[0].size:
        joints = whole[0].size // (9 if whole.shape[-2:] == (3, 3) else 3)
        if joints in (52, 55):  # hands and face included
            arrays["model"] = np.array("smpl" if joints == 52 else "smplx")
    scale = arrays.get("scale")
    if scale is not None and scale.dtype.kind in "iuf" and (abs(scale - 1.0) > 0.01).any():
        raise InputError(
            f"{path} has a `scale` of {np.median(scale):.3g}: its world has a unit of its own "
            "(NeuMan, HUGS), and metres were expected. Divide `transl`, and the shifts of the "
            "cameras, by `scale`, and leave the key out."
        )
    return arrays


def parse_per_frame(content: Any, path: Path) -> MotionByPerson | None:
    """The people of the folder or file; None if it does not hold a pose an item."""
    if isinstance(content, list):
        content = {str(row): item for row, item in enumerate(content)}
    if not isinstance(content, dict) or not content:
        return None
    items = {str(name): _parse_row(item) for name, item in content.items()}
    poses = {name: item for name, item in items.items() if item is not None}
    if 2 * len(poses) <= len(items):
        return None
    people: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for (person, number), item in zip(_person_and_frame(poses), poses.values(), strict=True):
        people.setdefault(str(item.get("id", person)), []).append((number, item))
    return {
        name: motion_from_arrays(_stack_items(rows, path), path) for name, rows in people.items()
    }


def _parse_row(item: Any) -> dict[str, Any] | None:
    if not isinstance(item, dict):
        return None
    named = normalize_keys(item)
    turned = {"global_orient", "body_pose"} <= named.keys() or {"thetas", "poses"} & named.keys()
    return named if turned and {"transl", "camera"} & named.keys() else None


def _person_and_frame(names: Iterable[str]) -> list[tuple[str, int]]:
    """Person and frame of each item, by the last numbers in its name: 00012_1 is person 1's."""
    listed = list(names)
    found = [re.findall(r"\d+", Path(name).stem) for name in listed]
    if all(len(numbers) > 1 for numbers in found):
        pairs = [(str(int(numbers[-1])), int(numbers[-2])) for numbers in found]
        last = {person for person, _ in pairs}
        if len(last) < len(listed) and len(set(pairs)) == len(listed):
            return pairs
    return [("0", number) for number in frame_numbers_from_names(listed)]


def _stack_items(rows: list[tuple[int, dict[str, Any]]], path: Path) -> Arrays:
    """One array for each key that all rows have."""
    items = [item for _, item in rows]
    shared = set.intersection(*(set(item) for item in items))
    found = {
        key: np.stack([_reshape_row(key, item[key]) for item in items])
        for key in (*ROTATION_KEYS, *ROW_SHAPES, "frame", "time", "valid")
        if key in shared
    }
    if "poses" in found:
        found["thetas"] = found.pop("poses")
    found.setdefault("transl", np.zeros((len(rows), 3)))
    found.setdefault("frame", np.array([number for number, _ in rows]))
    words = {k: items[0][k] for k in ("model", "space") if k in items[0]}
    order = np.argsort(found["frame"].reshape(-1), kind="stable")
    return collect_arrays({**{key: array[order] for key, array in found.items()}, **words}, path)


def _reshape_row(key: str, value: Any) -> Shaped[np.ndarray, "..."]:
    """One row, whatever dimensions of 1 are around it."""
    numbers = np.asarray(value, dtype=np.float64)
    if key in ROTATION_KEYS:
        # these are matrices; the 63 numbers of a body_pose are axis-angles
        is_matrices = numbers.size in [9 * joints for joints in (1, 21, 22, 23, 24, 52, 55)]
        return numbers.reshape((-1, 3, 3) if is_matrices else -1)
    if key == "camera" and numbers.size == 12:
        return np.vstack([numbers.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    return numbers.reshape(ROW_SHAPES.get(key, ()))
