"""4D-Humans and PHALP: rotation matrices of everybody in each frame, in a camera of 5,000 px.

Layout: a joblib file {picture: {time, tid, tracked_ids, tracked_time, size, camera, smpl, …}}; the
lists run in parallel, `smpl[k]` = {global_orient (1, 3, 3), body_pose (23, 3, 3), betas (10,)},
`camera[k]` = (3,), metres for a focal length of 5,000 px on a padded square of 256 px. A track that
was not detected in a frame is in its lists as a guess: `tracked_time[k]` > 0.
(github.com/brjathu/PHALP, phalp/trackers/PHALP.py.)
"""

from typing import Any

import numpy as np

from preprocess.body.body_pose import RelativeFocalLength
from preprocess.poses.motion_builder import MotionByPerson, build_motion, stack_rows

PHALP_FOCAL = RelativeFocalLength(ratio=5000.0 / 256.0)
"""PHALP's focal length: 5,000 px on a square of 256 px."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The people of the file; None if it is none of PHALP's."""
    if not isinstance(content, dict) or not content:
        return None
    frames = [frame for frame in content.values() if isinstance(frame, dict)]
    if len(frames) < len(content) or not all({"smpl", "tid"} <= frame.keys() for frame in frames):
        return None
    people: dict[str, list[tuple[int, Any, Any]]] = {}
    for place, frame in enumerate(frames):
        unseen = frame.get("tracked_time", [0] * len(frame["tid"]))
        number = int(frame.get("time", place))
        for row, person in enumerate(frame["tid"]):
            if not unseen[row]:
                seen = (number, frame["smpl"][row], frame["camera"][row])
                people.setdefault(str(int(person)), []).append(seen)
    return {person: _person(rows) for person, rows in people.items()}


def _person(rows: list[tuple[int, Any, Any]]) -> Any:
    poses = [smpl for _, smpl, _ in rows]
    return build_motion(
        [
            stack_rows([np.reshape(pose["global_orient"], (1, 3, 3)) for pose in poses]),
            stack_rows([np.reshape(pose["body_pose"], (-1, 3, 3)) for pose in poses]),
        ],
        stack_rows([np.reshape(camera, 3) for _, _, camera in rows]),
        betas=stack_rows([np.reshape(pose["betas"], -1) for pose in poses]),
        frames=[number for number, _, _ in rows],
        lens=PHALP_FOCAL,
    )
