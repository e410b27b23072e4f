"""PromptHMR: SMPL-X bodies by person, in the camera and in the world.

Layout: `results.pkl` {people: {person: {frames (N,), smplx_cam, smplx_world: {rotmat (N, 55, 3, 3)
or pose (N, 165), shape (N, 10), trans (N, 3)}}}, camera: {img_focal, img_center, …}}. Pictures were
shrunk to a height of 896 px at most: K belongs to these. (github.com/yufu-wang/PromptHMR.)
"""

from typing import Any

from preprocess.poses.track import People, track
from preprocess.poses.tram import _matrix

VIEWS = ("smplx_cam", "smplx_world")


def tracks(content: Any, driving: bool = False) -> People | None:
    """The people of the file, in the world if they shall drive an avatar; None if not its own."""
    people = content.get("people") if isinstance(content, dict) else None
    if not isinstance(people, dict) or not people:
        return None
    if not all(isinstance(rows, dict) and set(VIEWS) & rows.keys() for rows in people.values()):
        return None
    camera = content.get("camera")
    held = camera if isinstance(camera, dict) else {}
    intrinsic = _matrix(held.get("img_focal"), held.get("img_center"))
    return {str(name): _person(rows, intrinsic, driving) for name, rows in people.items()}


def _person(rows: dict[str, Any], intrinsic: Any, driving: bool) -> Any:
    view = next(key for key in (VIEWS[::-1] if driving else VIEWS) if key in rows)
    body, in_camera = rows[view], view == VIEWS[0]
    return track(
        [body["rotmat"] if "rotmat" in body else body["pose"]],
        body["trans"],
        betas=body.get("shape"),
        frames=rows["frames"],
        model="smplx",
        space="camera" if in_camera else "world",
        intrinsic=intrinsic if in_camera else None,
    )
