"""The one door to all pose files: which tracker's it is, whose poses are wanted."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from capture.errors import BadInput
from preprocess.capture_folder import poses_in
from preprocess.content import read_content
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
from preprocess.poses.bridge import LONGEST_GAP, bridged
from preprocess.poses.track import People
from preprocess.poses.unknown import described

ADAPTERS: dict[str, Callable[[Any, bool], People | None]] = {
    "PHALP (4D-Humans)": phalp.tracks,
    "WHAM": wham.tracks,
    "VIBE": vibe.tracks,
    "GVHMR": gvhmr.tracks,
    "PromptHMR": prompthmr.tracks,
    "TRAM": tram.tracks,
    "ROMP or BEV": romp.tracks,
    "EasyMocap": easymocap.tracks,
    "SLAHMR or 3DPW": slahmr.tracks,
    "AMASS or AIST++": amass.tracks,
}
"""Trackers by name, in the order in which they are asked whether a file is theirs."""

REFUSED = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, MemoryError,
)  # fmt: skip
"""What adapters raise for a file that is nearly theirs: they read it as if it were whole."""


def read_poses(
    path: Path, *, default_model: str = "body24", person: str | None = None, driving: bool = False
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
        BadInput: If there is no such file, it holds no poses that are known, or nobody of that
            name.
    """
    path = poses_in(path)
    if path.suffix.lower() == ".jsonl":
        return read_motion(path, default_model=default_model)
    content = read_content(path)
    tool, people = _recognised(content, path, default_model, driving)
    motion = _chosen(people, person, path)
    if tool is None:
        return motion
    motion = bridged(motion)
    note = motion.note
    if motion.bridged is not None:
        said = (
            f"{int(motion.bridged.sum())} poses that {tool} had lost were filled in between their "
            f"neighbours (gaps of up to {LONGEST_GAP} frames)."
        )
        note = said if note is None else f"{note} {said}"
    return replace(motion, note=note)


def _recognised(
    content: Any, path: Path, default_model: str, driving: bool
) -> tuple[str | None, People]:
    """Whose file it is (None: in the house's own keys), and the people in it."""
    for tool, tracks in ADAPTERS.items():
        try:
            people = tracks(content, driving)
        except BadInput:
            raise
        except REFUSED as cause:
            raise BadInput(
                f"{path} looks like a file of {tool}, but what it holds cannot be used: "
                f"{type(cause).__name__} {cause}. Is it complete?"
            ) from cause
        if people:
            return tool, people
    people = native.tracks(content, path, default_model)
    if people is not None:
        return None, people
    try:
        people = frames.tracks(content, path, default_model)
    except BadInput:
        raise
    except REFUSED as cause:
        raise BadInput(
            f"{path} holds a pose a frame that do not fit together ({cause})."
        ) from cause
    if people is None:
        raise BadInput(
            f"{path} holds no poses that are known: {described(content)} Expected global_orient, "
            f"body_pose and transl (or poses and trans), or a file of {', '.join(ADAPTERS)}; see "
            "docs/formats.md."
        )
    return "its tracker", people


def _chosen(people: People, person: str | None, path: Path) -> Motion:
    """The person that is wanted, or the one with most poses."""
    if person is not None and person not in people:
        raise BadInput(
            f"{path} holds nobody called {person!r} (--person); it holds {_named(people)}."
        )
    name = person or max(people, key=lambda known: int(people[known].valid.sum()))
    motion = people[name]
    if len(people) == 1 or person is not None:
        return motion
    others = {known: held for known, held in people.items() if known != name}
    note = (
        f"{path.name} holds {len(people)} people; {name} was taken, who has most poses "
        f"({int(motion.valid.sum())}). The others: {_named(others)}. --person ID takes another."
    )
    return replace(motion, note=note)


def _named(people: People) -> str:
    listed = [f"{name} ({int(held.valid.sum())} poses)" for name, held in people.items()]
    return ", ".join(listed[:12]) + (f" and {len(listed) - 12} more" if len(listed) > 12 else "")
