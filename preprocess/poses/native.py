"""The keys of InstantAvatar, which its successors write too, in any container; and HumanData.

Layout: global_orient, body_pose, transl; or thetas, transl; or poses, trans; with optional keys of
ours (frame, time, valid, K, camera, model): see `preprocess.pose_file`. mmhuman3d's HumanData holds
the same under `smpl`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from preprocess.pose_file import LAYOUTS, motion_of
from preprocess.poses.track import People


def tracks(content: Any, path: Path, default_model: str) -> People | None:
    """The person of the file; None if it has other keys.

    Raises:
        BadInput: If it has the keys, and what they hold is no motion.
    """
    if not isinstance(content, dict):
        return None
    held = content.get("smpl", content)
    if not isinstance(held, dict) or not any(set(keys) <= held.keys() for keys in LAYOUTS):
        return None
    arrays = {key: np.asarray(value) for key, value in held.items() if value is not None}
    if held is not content:
        arrays.setdefault("model", np.array("smpl"))
    return {"0": motion_of(arrays, path, default_model=default_model)}
