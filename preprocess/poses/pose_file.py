"""Pose files: InstantAvatar's .npz, which its successors read too, with a few keys of ours."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from preprocess.body.body_pose import Motion, PoseSpace
from preprocess.body.kinematics import stack_axis_angles
from preprocess.file_content import explain_damage
from preprocess.tracking.keypoints import KeypointTrack

POSE_KEY_LAYOUTS = (
    ("global_orient", "body_pose", "transl"),
    ("thetas", "transl"),
    ("poses", "trans"),
)
"""The keys that may hold the poses, first match wins; one array of 72 starts with the root."""
CAMERA_KEYS = ("camera_from_world", "w2c", "camera")
"""Keys of camera-from-world, best first."""
MAX_MAGNITUDE = 1e9
"""Largest magnitude of an angle or a translation; numbers beyond it mean a damaged file."""
MAX_PROPORTION = 100.0
"""Largest magnitude of a coefficient of proportions, in prior standard deviations."""
Arrays = dict[str, Shaped[np.ndarray, "..."]]


def motion_from_arrays(arrays: Arrays, path: Path) -> Motion:
    """The poses in the arrays of a file: axis-angles and metres, one row a pose.

    Keys: global_orient (N, 3) and body_pose (N, 69), or thetas or poses (N, 72); transl or trans
    (N, 3); optional betas (B,), (1, B) or (N, B), frame (N), time (N), valid (N), K (3, 3) or
    (N, 3, 3), camera (4, 4) or (N, 4, 4) camera-from-world, model (else SMPL's), space
    ("world", or "camera": each row is in the camera of its frame), proportions and program (see
    `Motion`), and
    the arrays of `KeypointTrack`. Rows with NaN are marked as not valid. Rotations may be 3x3
    matrices; a body_pose of 63 numbers has no hands.

    An InputError names the file and the key that holds something else.
    """
    with explain_damage(path, "poses"):
        return _motion(arrays)


def _motion(arrays: Arrays) -> Motion:
    layout = next((keys for keys in POSE_KEY_LAYOUTS if set(keys) <= arrays.keys()), None)
    if layout is None:
        expected = "; or ".join(" and ".join(keys) for keys in POSE_KEY_LAYOUTS)
        raise ValueError(f"it holds {', '.join(sorted(arrays)) or 'nothing'}; expected {expected}.")
    rows = [_rows(arrays, key, arrays[layout[-1]]) for key in layout]
    translations = rows.pop().reshape(len(rows[0]), -1)
    count = len(translations)
    try:
        poses = stack_axis_angles(rows).reshape(count, 72)
    except ValueError as cause:
        raise ValueError(
            f"{' + '.join(layout[:-1])} have {', '.join(str(r.shape) for r in rows)} numbers "
            f"({cause}); expected axis-angles (N, 72), SMPL's root and 23 joints, or rotation "
            "matrices."
        ) from cause
    if translations.shape != (count, 3):
        raise ValueError(f"`{layout[-1]}` has {translations.shape}; expected (N, 3) metres.")
    times = _per_row(arrays, "time", count)
    return Motion(
        root_rotations=poses[:, :3],
        root_translations=translations,
        joint_rotations=poses[:, 3:].reshape(count, 23, 3),
        valid=_valid(arrays, np.column_stack([poses, translations]), times),
        betas=_betas(arrays),
        body_model=str(arrays["model"]) if "model" in arrays else "smpl",
        frames=_frame_numbers(arrays, count),
        times_s=times,
        intrinsic=_intrinsic(arrays),
        camera_from_world=_cameras(arrays, count),
        space=_space(arrays),
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


def _rows(
    arrays: Arrays, key: str, translations: Shaped[np.ndarray, "..."]
) -> Float[np.ndarray, "poses *numbers"]:
    rows = _read_numbers(arrays, key)
    if rows.ndim < 2 or not rows.size:
        raise ValueError(f"`{key}` has the shape {rows.shape}; expected one row a pose.")
    count = len(np.atleast_1d(translations))
    if len(rows) != count:
        raise ValueError(
            f"it holds {len(rows)} rows of `{key}` but {count} translations; expected one of each "
            "per pose."
        )
    return rows


def _per_row(arrays: Arrays, key: str, count: int) -> Float[np.ndarray, "poses"] | None:
    """An optional array of one number a pose."""
    if key not in arrays:
        return None
    numbers = _read_numbers(arrays, key).reshape(-1)
    if len(numbers) != count:
        raise ValueError(f"it holds {len(numbers)} numbers in `{key}` for {count} poses.")
    return numbers


def _valid(
    arrays: Arrays, numbers: Float[np.ndarray, "poses 75"], times: Float[np.ndarray, "poses"] | None
) -> Bool[np.ndarray, "poses"]:
    """Rows that are finite, of a size that angles and places have, and not marked as lost."""
    valid = np.asarray((np.abs(np.nan_to_num(numbers, nan=np.inf)) < MAX_MAGNITUDE).all(axis=1))
    marked = _per_row(arrays, "valid", len(valid))
    if marked is not None:
        valid &= marked > 0
    return valid if times is None else valid & np.isfinite(times)


def _betas(arrays: Arrays) -> Float[np.ndarray, "betas"]:
    """One shape for the whole motion: the mean, where each row has its own."""
    if "betas" not in arrays:
        return np.zeros(0)
    betas = _read_numbers(arrays, "betas")
    if betas.ndim > 2:
        raise ValueError(f"`betas` have the shape {betas.shape}; expected (10,) or (1, 10).")
    rows = np.atleast_2d(betas)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        raise ValueError("`betas` are NaN; a shape of finite numbers was expected.")
    return rows.mean(axis=0)


def _proportions(arrays: Arrays) -> Float[np.ndarray, "coefficients"] | None:
    if "proportions" not in arrays:
        return None
    proportions = _read_numbers(arrays, "proportions")
    if proportions.ndim != 1 or not (np.abs(proportions) < MAX_PROPORTION).all():
        raise ValueError("`proportions` are no coefficients; expected finite numbers.")
    return proportions


def _frame_numbers(arrays: Arrays, count: int) -> Int[np.ndarray, "poses"] | None:
    numbers = _per_row(arrays, "frame", count)
    if numbers is None:
        return None
    if not np.isfinite(numbers).all() or (numbers != np.round(numbers)).any():
        raise ValueError("`frame` holds numbers that are no frame numbers.")
    frames = numbers.astype(np.int64)
    if len(np.unique(frames)) < count:
        raise ValueError("`frame` names a frame twice; expected one person's poses.")
    return frames


def _intrinsic(arrays: Arrays) -> Float[np.ndarray, "3 3"] | None:
    """The tracker's K; the median, where each row has its own."""
    if "K" not in arrays:
        return None
    intrinsic = _read_numbers(arrays, "K")
    if intrinsic.ndim == 3:
        intrinsic = np.nanmedian(intrinsic, axis=0)
    if intrinsic.shape != (3, 3) or not np.isfinite(intrinsic).all() or intrinsic[0, 0] <= 0.0:
        raise ValueError("`K` is no camera matrix; expected finite (3, 3) pixels.")
    return intrinsic


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
    cameras = _read_numbers(arrays, key)
    if cameras.shape not in ((4, 4), (count, 4, 4)) or not np.isfinite(cameras).all():
        raise ValueError(
            f"`{key}` has the shape {cameras.shape}; expected finite camera-from-world "
            f"transforms (4, 4) or ({count}, 4, 4)."
        )
    rotations = cameras[..., :3, :3]
    if np.abs(rotations @ np.swapaxes(rotations, -1, -2) - np.eye(3)).max() > 1e-3:
        raise ValueError(f"`{key}` is not rigid; expected no scale, OpenCV's axes.")
    return np.broadcast_to(cameras, (count, 4, 4)).copy()
