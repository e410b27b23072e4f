"""EasyMocap and ZJU-MoCap: a json a frame, and a rotation about the origin, not the pelvis.

Layout: a folder of `000000.json` …, each a list of {id, Rh (1, 3), Th (1, 3), poses (1, 72) whose
first three are 0 (or 63, 69, 87 numbers), shapes (1, 10)}, or {annots: that list}. ZJU-MoCap's
`new_params/0.npy` hold one of these each. World: the calibrated cameras' (extri.yml).
V = R(Rh) LBS(poses) + Th. (github.com/zju3dv/EasyMocap, easymocap/mytools/file_utils.py.)
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from preprocess.frame_association import frame_numbers_from_names
from preprocess.poses.motion_builder import MotionByPerson, build_motion, stack_rows

REQUIRED_KEYS = {"Rh", "Th", "poses"}
"""Keys by which a file of EasyMocap is recognised."""


def parse_people(content: Any, prefer_world: bool = False) -> MotionByPerson | None:
    """The people of the folder; None if it is none of EasyMocap's."""
    files = content if isinstance(content, dict) else {"0": content}
    if files.keys() >= REQUIRED_KEYS:
        files = {"0": content}
    frames = {name: _people_of(held) for name, held in files.items()}
    if not frames or any(people is None for people in frames.values()):
        return None
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for number, people in zip(frame_numbers_from_names(frames), frames.values(), strict=True):
        for person in people or ():
            name = str(person.get("id", person.get("personID", 0)))
            found.setdefault(name, []).append((number, person))
    return {name: _person(rows) for name, rows in found.items()} or None


def _people_of(held: Any) -> list[dict[str, Any]] | None:
    if isinstance(held, dict) and "annots" in held:
        held = held["annots"]
    listed = [held] if isinstance(held, dict) else held
    if not isinstance(listed, list) or not all(
        isinstance(person, dict) and person.keys() >= REQUIRED_KEYS for person in listed
    ):
        return None
    return listed


def _person(rows: list[tuple[int, dict[str, Any]]]) -> Any:
    people = [person for _, person in rows]
    return build_motion(
        [
            stack_rows([np.reshape(p["Rh"], 3) for p in people]),
            stack_rows([_body(p) for p in people]),
        ],
        stack_rows([np.reshape(p["Th"], 3) for p in people]),
        betas=stack_rows([np.reshape(p["shapes"], -1)[:10] for p in people])
        if all("shapes" in person for person in people)
        else None,
        frames=[number for number, _ in rows],
        space="world",
        anchor="origin",
    )


def _body(person: dict[str, Any]) -> Float[np.ndarray, "numbers"]:
    """The rotations of the joints but the root; 72 and 66 numbers begin with the root at rest."""
    numbers = np.asarray(person["poses"], dtype=np.float64).reshape(-1)
    if len(numbers) in (66, 72, 78, 87, 156, 165):
        if np.abs(numbers[:3]).max() > 1e-6:
            raise ValueError("`poses` turn the root although `Rh` does; expected its first 3 at 0")
        return numbers[3:72] if len(numbers) == 72 else numbers[3:66]
    return numbers if len(numbers) == 69 else numbers[:63]
