"""Read any pose file: recognise its tracker, choose the person, fill gaps."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from capture.image_folder import refuse_pipe
from capture.input_error import InputError, counted
from preprocess.body.body_pose import Motion
from preprocess.capture_inputs import find_own_poses
from preprocess.file_content import explain_damage, read_untrusted_file
from preprocess.poses import body_joints, skeleton_files, tracker_files
from preprocess.poses.motion_builder import MAX_GAP_FRAMES, MotionByPerson, fill_gaps
from preprocess.poses.pose_file import parse_instant_avatar, parse_per_frame

TRACKERS: dict[str, Callable[[Any, bool], MotionByPerson | None]] = {
    "BVH": skeleton_files.parse_bvh,
    "glTF": skeleton_files.parse_gltf,
    "PHALP (4D-Humans)": tracker_files.parse_phalp,
    "WHAM": tracker_files.parse_wham,
    "VIBE": tracker_files.parse_vibe,
    "GVHMR": tracker_files.parse_gvhmr,
    "PromptHMR": tracker_files.parse_prompthmr,
    "TRAM": tracker_files.parse_tram,
    "ROMP or BEV": tracker_files.parse_romp,
    "EasyMocap": tracker_files.parse_easymocap,
    "SLAHMR or 3DPW": tracker_files.parse_slahmr,
    "AMASS or AIST++": tracker_files.parse_amass,
    "SAM 3D Body, GEM-X or joints": body_joints.parse_joints,
}
"""Trackers by name, in the order in which they try to read a file."""


def read_poses(path: Path, *, person: str | None = None, prefer_world: bool = False) -> Motion:
    """Poses from a file, or a folder of files, of any tracker that is known (docs/formats.md).

    Of several people the one with most poses is chosen, and the note names the others. Short gaps
    of the tracker are interpolated. The poses keep the file's anchor and space;
    `preprocess.poses.motion_builder` converts them for a body and its cameras.

    A person is named by the file's own number or name; `prefer_world` reads poses in the world
    rather than in a camera, to drive an avatar.
    """
    path = find_own_poses(path) or path
    refuse_pipe(path)
    content = read_untrusted_file(path)
    tool, people = _recognize(content, path, prefer_world)
    motion = _select_person(people, person, path)
    if tool is None:
        return motion
    whole, note = fill_gaps(motion), motion.note
    program = motion.program or (tool if tool in TRACKERS else None)
    filled = int(whole.valid.sum() - motion.valid.sum())
    if filled:
        said = (
            f"Filled in between their neighbours: {counted(filled, 'pose')} that {tool} had lost "
            f"(gaps of up to {MAX_GAP_FRAMES} frames)."
        )
        note = said if note is None else f"{note} {said}"
    return replace(whole, program=program, note=note)


def _recognize(content: Any, path: Path, driving: bool) -> tuple[str | None, MotionByPerson]:
    """The tracker of the file (None: in our own keys), and the people in it."""
    for tool, tracks in TRACKERS.items():
        with explain_damage(path, f"a file of {tool}"):
            people = tracks(content, driving)
        if people:
            return tool, people
    people = parse_instant_avatar(content, path)
    if people is not None:
        return None, people
    with explain_damage(path, "a pose a frame"):
        people = parse_per_frame(content, path)
    if people is None:
        raise InputError(
            f"{path} holds no poses that are known: {_describe_content(content)}. Expected "
            "global_orient, body_pose and transl (or poses and trans), or a file of "
            f"{', '.join(TRACKERS)}; see docs/formats.md."
        )
    return "its tracker", people


def _describe_content(content: Any) -> str:
    if isinstance(content, np.ndarray):
        return f"it is an array of the shape {content.shape}"
    if isinstance(content, dict):
        return f"its keys are {', '.join(str(key)[:40] for key in list(content)[:12]) or 'none'}"
    return f"it is a {type(content).__name__}"


def _select_person(people: MotionByPerson, person: str | None, path: Path) -> Motion:
    """The requested person, or the one with most poses."""
    if person is not None and person not in people:
        raise InputError(
            f"{path} holds no person called {person!r} (--person); it holds {_list_people(people)}."
        )
    name = person or max(people, key=lambda known: int(people[known].valid.sum()))
    motion = people[name]
    if len(people) == 1 or person is not None:
        return motion
    others = {known: held for known, held in people.items() if known != name}
    note = (
        f"{path.name} holds {len(people)} people; {name} was taken, who has most poses "
        f"({int(motion.valid.sum())}). The others: {_list_people(others)}. --person ID takes "
        "another."
    )
    return replace(motion, note=note)


def _list_people(people: MotionByPerson) -> str:
    listed = [f"{name} ({counted(int(held.valid.sum()), 'pose')})" for name, held in people.items()]
    return ", ".join(listed[:12]) + (f" and {len(listed) - 12} more" if len(listed) > 12 else "")
