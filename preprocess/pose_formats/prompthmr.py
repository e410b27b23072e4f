"""PromptHMR: SMPL-X bodies by person, in the camera and in the world.

Layout: `results.pkl` {people: {person: {frames (N,), smplx_cam, smplx_world: {rotmat (N, 55, 3, 3)
or pose (N, 165), shape (N, 10), trans (N, 3)}}}, camera: {img_focal, img_center, …}}. Pictures were
shrunk to a height of 896 px at most: K belongs to these. (github.com/yufu-wang/PromptHMR.)
"""

from typing import Any

from preprocess.pose_formats.tram import intrinsic_from_focal
from preprocess.poses.motion_builder import MotionByPerson, build_motion

COORDINATE_KEYS = ("smplx_cam", "smplx_world")
"""Keys of the poses in the camera and in the world."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The people of the file, in the world if they shall drive an avatar; None if not its own."""
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, dict) or not people:
        return None
    if not all(
        isinstance(rows, dict) and set(COORDINATE_KEYS) & rows.keys() for rows in people.values()
    ):
        return None
    camera = content.get("camera")
    held = camera if isinstance(camera, dict) else {}
    intrinsic = intrinsic_from_focal(held.get("img_focal"), held.get("img_center"))
    return {str(name): _person(rows, intrinsic, prefer_world) for name, rows in people.items()}


def _person(rows: dict[str, Any], intrinsic: Any, driving: bool) -> Any:
    view = next(
        key for key in (COORDINATE_KEYS[::-1] if driving else COORDINATE_KEYS) if key in rows
    )
    body, in_camera = rows[view], view == COORDINATE_KEYS[0]
    return build_motion(
        [body["rotmat"] if "rotmat" in body else body["pose"]],
        body["trans"],
        betas=body.get("shape"),
        frames=rows["frames"],
        body_model="smplx",
        space="camera" if in_camera else "world",
        lens=intrinsic if in_camera else None,
    )
