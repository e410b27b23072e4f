"""Files that are no poses, or poses that are not read: what they are, and what to do."""

from typing import Any

import numpy as np

ADVICE_BY_KEYS = (
    (
        {"mhr_model_params", "shape_params", "body_pose_params"},
        "it is SAM 3D Body's, whose poses move another body (MHR); bring them to SMPL first "
        "(facebookresearch/MHR converts).",
    ),
    (
        {"pred_thetas", "pred_xyz_29", "pred_cam_root"},
        "it is HybrIK's, whose places are in a crop of each picture; 4D-Humans, WHAM or GVHMR say "
        "where people are in the whole picture.",
    ),
    (
        {"pose_keypoints_2d", "keypoints", "landmarks", "people", "pose_landmarks"},
        "it has joints in the picture, not a body's rotations; fit SMPL to them, or use a tracker "
        "such as 4D-Humans, WHAM or GVHMR.",
    ),
    (
        {"verts", "vertices", "pred_vertices"},
        "it has vertices of meshes, not the rotations that made them.",
    ),
)
"""Keys of which one is enough, and what is to be said then."""

ADVICE_BY_ROW_SIZE = {
    322: "(N, 322) is Motion-X's: write root_orient = [:, :3], pose_body = [:, 3:66] and trans = "
    "[:, 309:312] to an .npz.",
    263: "(N, 263) is HumanML3D's, which has no rotations of SMPL.",
    72: "(N, 72) alone does not say where the person is; write it as `poses`, with `trans` (N, 3) "
    "in metres, to an .npz.",
}
"""Arrays by how many numbers a row has."""


def describe_unknown_content(content: Any) -> str:
    """What a file holds, and what could be done about it; a sentence."""
    if isinstance(content, np.ndarray):
        known = ADVICE_BY_ROW_SIZE.get(content.shape[-1]) if content.ndim == 2 else None
        return known or f"it is an array of the shape {content.shape}."
    keys = _keys(content)
    for some, words in ADVICE_BY_KEYS:
        if some & set(keys):
            return words
    if isinstance(content, dict):
        listed = [key[:40] for key in keys]
        return f"its keys are {', '.join(listed[:12]) or 'none'}{' …' if len(keys) > 12 else ''}."
    return f"it is a {type(content).__name__}."


def _keys(content: Any) -> list[str]:
    """Of the file, or of the first of its items."""
    if isinstance(content, (list, tuple)):
        return _keys(content[0]) if content else []
    if not isinstance(content, dict):
        return []
    keys = [str(key) for key in content]
    first = next(iter(content.values()), None)
    known = {key for some, _ in ADVICE_BY_KEYS for key in some}
    return _keys(first) if isinstance(first, dict) and not known & set(keys) and (
        known & set(_keys(first))
    ) else keys  # fmt: skip
