"""A file, or an object of JSON, for each frame, each with one pose: many programs' way.

Layout: a folder of .npz, .json or .pkl, or one file with a list or with objects by frames' names,
each with the keys of `instant_avatar` for one row: ExAvatar's `smplx_params/0.json` {root_pose,
body_pose, trans}, LHM's with focal and princpt beside, SMPLer-X's `00001_0.npz`, ARAH's
`models/000001.npz` {root_orient, pose_body, trans}, HumanNeRF's `metadata.json` {frame_000001:
{poses, cam_intrinsics, cam_extrinsics}}, whose camera alone says where the person is.
"""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from preprocess.frame_association import frame_numbers_from_names
from preprocess.pose_formats.instant_avatar import collect_arrays, normalize_keys
from preprocess.poses.motion_builder import MotionByPerson
from preprocess.poses.pose_file import motion_from_arrays

ROTATION_MATRIX_SIZES = frozenset(9 * joints for joints in (1, 21, 22, 23, 24, 52, 55))
"""How many numbers a row of rotation matrices has; 63 of body_pose are axis-angles."""
ROTATION_KEYS = ("global_orient", "body_pose", "thetas", "poses")
"""Keys of rotations."""

ROW_SHAPES = {"transl": (3,), "K": (3, 3), "camera": (4, 4), "betas": (-1,)}
"""Shape of one row of each other array."""

ROW_KEYS = (*ROTATION_KEYS, *ROW_SHAPES, "frame", "time", "valid")
"""All keys that are read of one row."""


def parse_people(content: Any, path: Path, default_model: str) -> MotionByPerson | None:
    """The people of the folder or file; None if it does not hold a pose an item.

    Raises:
        InputError: If it does, and they are no motion.
        ValueError: If they do not fit together.
    """
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
        name: motion_from_arrays(_stack(rows, path), path, default_model=default_model)
        for name, rows in people.items()
    }


def _parse_row(item: Any) -> dict[str, Any] | None:
    """One row by the house's keys; None if it is none."""
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


def _stack(
    rows: list[tuple[int, dict[str, Any]]], path: Path
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """One array for each key that all rows have."""
    items = [item for _, item in rows]
    shared = set.intersection(*(set(item) for item in items))
    found = {
        key: np.stack([_reshape_row(key, item[key]) for item in items])
        for key in ROW_KEYS
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
        return numbers.reshape((-1, 3, 3) if numbers.size in ROTATION_MATRIX_SIZES else -1)
    if key == "camera" and numbers.size == 12:
        return np.vstack([numbers.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    return numbers.reshape(ROW_SHAPES.get(key, ()))
