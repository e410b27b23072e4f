"""The one door to all pose files: which tracker's it is, whose poses are wanted."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from capture.errors import InputError
from preprocess.capture_folder import resolve_pose_path
from preprocess.content import read_untrusted_file
from preprocess.pose import Motion
from preprocess.pose_file import read_motion
from preprocess.poses import (
    amass,
    easymocap,
    frames,
    gvhmr,
    native,
    phalp,
    prompthmr,
    romp,
    slahmr,
    tram,
    vibe,
    wham,
)
from preprocess.poses.bridge import MAX_GAP_FRAMES, fill_gaps
from preprocess.poses.track import MotionByPerson
from preprocess.poses.unknown import describe_unknown_content

TRACKERS: dict[str, Callable[[Any, bool], MotionByPerson | None]] = {
    "PHALP (4D-Humans)": phalp.parse_people,
    "WHAM": wham.parse_people,
    "VIBE": vibe.parse_people,
    "GVHMR": gvhmr.parse_people,
    "PromptHMR": prompthmr.parse_people,
    "TRAM": tram.parse_people,
    "ROMP or BEV": romp.parse_people,
    "EasyMocap": easymocap.parse_people,
    "SLAHMR or 3DPW": slahmr.parse_people,
    "AMASS or AIST++": amass.parse_people,
}
"""Trackers by name, in the order in which they are asked whether a file is theirs."""

MALFORMED_FILE_ERRORS = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, MemoryError,
)  # fmt: skip
"""What adapters raise for a file that is nearly theirs: they read it as if it were whole."""


def read_poses(
    path: Path, *, default_model: str = "body24", person: str | None = None, prefer_world: bool = False
) -> Motion:
    """Poses from a file, or a folder of files, of any tracker that is known (docs/formats.md).

    Of several people the one with most poses is taken, and the others are named in the note. What
    the tracker lost for a few frames is bridged and marked. The poses are still about the file's
    own anchor, in its own space: `preprocess.poses.place` brings them to a body and its cameras.

    Args:
        path: The file or folder; of a capture folder the poses in it.
        default_model: Body family of files that do not say theirs.
        person: Whose poses, by the file's own number or name.
        driving: Whether they shall move an avatar: then in the world rather than in a camera.

    Raises:
        InputError: If there is no such file, it holds no poses that are known, or nobody of that
            name.
    """
    path = resolve_pose_path(path)
    if path.suffix.lower() == ".jsonl":
        return read_motion(path, default_model=default_model)
    content = read_untrusted_file(path)
    tool, people = _recognize(content, path, default_model, prefer_world)
    motion = _select_person(people, person, path)
    if tool is None:
        return motion
    motion = fill_gaps(motion)
    note = motion.note
    if motion.interpolated is not None:
        said = (
            f"{int(motion.interpolated.sum())} poses that {tool} had lost were filled in between their "
            f"neighbours (gaps of up to {MAX_GAP_FRAMES} frames)."
        )
        note = said if note is None else f"{note} {said}"
    return replace(motion, note=note)


def _recognize(
    content: Any, path: Path, default_model: str, driving: bool
) -> tuple[str | None, MotionByPerson]:
    """Whose file it is (None: in the house's own keys), and the people in it."""
    for tool, tracks in TRACKERS.items():
        try:
            people = tracks(content, driving)
        except InputError:
            raise
        except MALFORMED_FILE_ERRORS as cause:
            raise InputError(
                f"{path} looks like a file of {tool}, but what it holds cannot be used: "
                f"{type(cause).__name__} {cause}. Is it complete?"
            ) from cause
        if people:
            return tool, people
    people = native.parse_people(content, path, default_model)
    if people is not None:
        return None, people
    try:
        people = frames.parse_people(content, path, default_model)
    except InputError:
        raise
    except MALFORMED_FILE_ERRORS as cause:
        raise InputError(
            f"{path} holds a pose a frame that do not fit together ({cause})."
        ) from cause
    if people is None:
        raise InputError(
            f"{path} holds no poses that are known: {describe_unknown_content(content)} Expected global_orient, "
            f"body_pose and transl (or poses and trans), or a file of {', '.join(TRACKERS)}; see "
            "docs/formats.md."
        )
    return "its tracker", people


def _select_person(people: MotionByPerson, person: str | None, path: Path) -> Motion:
    """The person that is wanted, or the one with most poses."""
    if person is not None and person not in people:
        raise InputError(
            f"{path} holds nobody called {person!r} (--person); it holds {_list_people(people)}."
        )
    name = person or max(people, key=lambda known: int(people[known].valid.sum()))
    motion = people[name]
    if len(people) == 1 or person is not None:
        return motion
    others = {known: held for known, held in people.items() if known != name}
    note = (
        f"{path.name} holds {len(people)} people; {name} was taken, who has most poses "
        f"({int(motion.valid.sum())}). The others: {_list_people(others)}. --person ID takes another."
    )
    return replace(motion, note=note)


def _list_people(people: MotionByPerson) -> str:
    listed = [f"{name} ({int(held.valid.sum())} poses)" for name, held in people.items()]
    return ", ".join(listed[:12]) + (f" and {len(listed) - 12} more" if len(listed) > 12 else "")
