"""WHAM: axis-angles in the camera and in a world with y up, by person.

Layout: joblib `wham_output.pkl` {person: {pose (N, 72), trans (N, 3), pose_world, trans_world,
betas (N, 10), verts, frame_ids (N,)}}. Its focal length, if none was given, is the picture's
diagonal, and is not stored. (github.com/yohanshin/WHAM, demo.py.)
"""

from typing import Any

from preprocess.body.body_pose import RelativeFocalLength
from preprocess.poses.motion_builder import MotionByPerson, build_motion

WHAM_FOCAL = RelativeFocalLength(ratio=1.0, reference="diagonal")
"""WHAM's focal length where none was given."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The people of the file, in the world if they shall drive an avatar; None if not WHAM's."""
    people = content if isinstance(content, dict) else {}
    if not people or not all(
        isinstance(rows, dict) and {"pose", "trans", "frame_ids"} <= rows.keys()
        for rows in people.values()
    ):
        return None
    return {
        str(person): _person(rows, prefer_world and "pose_world" in rows)
        for person, rows in people.items()
    }


def _person(rows: dict[str, Any], in_world: bool) -> Any:
    end = "_world" if in_world else ""
    return build_motion(
        [rows["pose" + end]],
        rows["trans" + end],
        betas=rows.get("betas"),
        frames=rows["frame_ids"],
        space="world" if in_world else "camera",
        lens=None if in_world else WHAM_FOCAL,
    )
