"""ROMP and BEV (simple-romp): all people of each frame, with or without tracks.

Layout: `video_results.npz` with `results` {picture: {smpl_thetas (P, 72), smpl_betas (P, 10 or 11),
cam (P, 3), cam_trans (P, 3), pj2d, pj2d_org, …}} and, tracked with -t, `sequence_results` {track:
{frame_id: […], smpl_thetas: […], …}}; or a folder of one .npz a frame, each with its `results`.
(github.com/Arthur151/ROMP, simple_romp: romp/main.py, bev/main.py, romp/utils.py.)
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from preprocess.body.body_pose import RelativeFocalLength
from preprocess.frame_association import frame_numbers_from_names
from preprocess.poses.motion_builder import MotionByPerson, build_motion, stack_rows

PERSPECTIVE_FOCAL = RelativeFocalLength(ratio=443.4 / 512.0)
"""The camera of their perspective fit: 60 degrees over the padded square."""

WEAK_PERSPECTIVE_FOCAL = RelativeFocalLength(ratio=1.0)
"""The camera in which z = 2 / s puts a point where weak perspective with the scale s does."""

VIDEO_RESULTS = "video_results.npz"
"""Name of ROMP's file for a whole video."""

MAX_STEP_M = 1.0
"""Largest step of one person between frames, metres; it separates people without track numbers."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The people of the file; None if it is none of ROMP's."""
    if not isinstance(content, dict):
        return None
    content = content.get(VIDEO_RESULTS, content)  # a folder with everything in it
    sequence = content.get("sequence_results")
    if isinstance(sequence, dict) and sequence:
        return {
            str(person): _person(rows, rows["frame_id"])
            for person, rows in sequence.items()
            if len(rows["frame_id"])
        }
    results = content.get("results")
    if isinstance(results, dict) and "smpl_thetas" in results:
        return _link_people([results], [0])
    if isinstance(results, dict) and results:
        return _link_people(list(results.values()), range(len(results)))
    if content and all(_is_frame(part) for part in content.values()):
        frames = [part["results"] for part in content.values()]
        return _link_people(frames, frame_numbers_from_names(content))
    return None


def _is_frame(part: Any) -> bool:
    held = part.get("results") if isinstance(part, dict) else None
    return isinstance(held, dict) and "smpl_thetas" in held


def _person(rows: dict[str, Any], frames: Any) -> Any:
    thetas, places = stack_rows(list(rows["smpl_thetas"])), stack_rows(list(rows["cam_trans"]))
    betas = stack_rows(list(rows["smpl_betas"]))
    is_bev = betas.shape[-1] == 11
    lens = PERSPECTIVE_FOCAL
    if not is_bev and "cam" in rows:
        scales = stack_rows(list(rows["cam"]))[:, 0]
        if np.allclose(places[:, 2] * scales, 2.0, rtol=1e-3):
            lens = WEAK_PERSPECTIVE_FOCAL
    return build_motion(
        [thetas], places, betas=betas[:, :10], frames=frames, lens=lens,
        lost=places[:, 2] <= 0.0,  # (-1, -1, -1) where their perspective fit has failed
        anchor="hips" if is_bev else "pelvis",
    )  # fmt: skip


def _link_people(frames: list[dict[str, Any]], numbers: Any) -> MotionByPerson:
    """People of each frame joined with those of the frames before: by number, else by place."""
    people: dict[str, dict[str, Any]] = {}
    last: dict[str, Float[np.ndarray, 3]] = {}
    for number, frame in zip(numbers, frames, strict=True):
        places = np.asarray(frame["cam_trans"], dtype=np.float64).reshape(-1, 3)
        names = frame.get("track_ids")
        taken: set[str] = set()
        for row, place in enumerate(places):
            if names is not None:
                name = str(int(np.asarray(names).reshape(-1)[row]))
            else:
                name = _nearest_person(place, last, taken) or str(len(people))
            taken.add(name)
            person = people.setdefault(name, {"frame_id": []})
            person["frame_id"].append(number)
            last[name] = place
            for key in ("smpl_thetas", "smpl_betas", "cam_trans", "cam"):
                if key in frame:
                    person.setdefault(key, []).append(np.asarray(frame[key])[row])
    return {name: _person(rows, rows["frame_id"]) for name, rows in people.items()}


def _nearest_person(
    place: Float[np.ndarray, "3"], last: dict[str, Float[np.ndarray, "3"]], taken: set[str]
) -> str | None:
    """Who was nearest before; depth counts a third, for it is the least certain."""
    gaps = {
        name: float(np.linalg.norm((place - before) * np.array([1.0, 1.0, 1.0 / 3.0])))
        for name, before in last.items()
        if name not in taken
    }
    name = min(gaps, key=lambda known: gaps[known], default=None)
    return name if name is not None and gaps[name] < MAX_STEP_M else None
