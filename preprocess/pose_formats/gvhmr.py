"""GVHMR: an SMPL-X body of one person in the camera and in a world with y up, frame by frame.

Layout: torch `hmr4d_results.pt` {smpl_params_incam, smpl_params_global: {body_pose (L, 63),
global_orient (L, 3), transl (L, 3), betas (L, 10)}, K_fullimg (L, 3, 3), net_outputs}. Rows are all
frames of `0_input_video.mp4`, its own copy of the video, so they belong to frames by order.
(github.com/zju3dv/GVHMR, tools/demo/demo.py.)
"""

from typing import Any

from preprocess.poses.motion_builder import MotionByPerson, build_motion

COORDINATE_KEYS = ("smpl_params_incam", "smpl_params_global")
"""Keys of the poses in the camera and in the world."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The person of the file, in the world if it shall drive an avatar; None if not GVHMR's."""
    if not isinstance(content, dict) or not set(COORDINATE_KEYS) & content.keys():
        return None
    view = next(
        key
        for key in (COORDINATE_KEYS[::-1] if prefer_world else COORDINATE_KEYS)
        if key in content
    )
    rows, in_camera = content[view], view == COORDINATE_KEYS[0]
    person = build_motion(
        [rows["global_orient"], rows["body_pose"]],
        rows["transl"],
        betas=rows.get("betas"),
        body_model="smplx",
        space="camera" if in_camera else "world",
        lens=content.get("K_fullimg") if in_camera else None,
    )
    return {"0": person}
