"""VIBE: axis-angles and a weak-perspective camera of the whole picture, by person.

Layout: joblib `vibe_output.pkl` {person: {pose (N, 72), betas (N, 10), orig_cam (N, 4) = (sx, sy,
tx, ty), pred_cam, bboxes (N, 4), verts, frame_ids (N,)}}: a point (X, Y) of the body is drawn at
sx (X + tx), sy (Y + ty) in units of half the width and half the height.
(github.com/mkocabas/VIBE, demo.py and lib/utils/demo_utils.py.)
"""

from typing import Any

import numpy as np

from preprocess.body.body_pose import RelativeFocalLength
from preprocess.poses.motion_builder import MotionByPerson, build_motion

VIBE_FOCAL = RelativeFocalLength(ratio=0.85)
"""Any would do: weak perspective has none, and the depth follows from it. A phone's is taken."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The people of the file; None if it is none of VIBE's."""
    people = content if isinstance(content, dict) else {}
    if not people or not all(
        isinstance(rows, dict) and {"pose", "orig_cam", "frame_ids"} <= rows.keys()
        for rows in people.values()
    ):
        return None
    return {str(person): _person(rows) for person, rows in people.items()}


def _person(rows: dict[str, Any]) -> Any:
    across, down, x, y = np.asarray(rows["orig_cam"], dtype=np.float64).T
    # focal / depth = sx width / 2, and width : height = sy : sx
    longer_per_width = np.maximum(1.0, across / down)
    depth = 2.0 * VIBE_FOCAL.ratio * longer_per_width / across
    return build_motion(
        [rows["pose"]],
        np.column_stack([x, y, depth]),
        betas=rows.get("betas"),
        frames=rows["frame_ids"],
        lens=VIBE_FOCAL,
    )
