"""Poses that an avatar is driven with, whoever wrote them."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from apps.terminal.console import Console
from capture.errors import InputError
from preprocess.plausibility import plausibility_warnings, require_plausible
from preprocess.pose import Motion
from preprocess.poses import read_poses
from preprocess.poses.place import anchor_at_pelvis


def load_driving_motion(
    path: Path,
    rest_joints: Float[np.ndarray, "24 3"],
    console: Console,
    *,
    person: str | None = None,
) -> Motion:
    """The poses of a file, about the avatar's own pelvis.

    Args:
        path: Whatever `preprocess.poses` reads.
        rest_joints: The avatar's, metres.
        console: Hears what the user should know about the poses.
        person: Whose poses; None: of whom there are most.

    Raises:
        InputError: If there are none, or the numbers cannot be poses in radians and metres.
    """
    read = require_plausible(read_poses(path, person=person, prefer_world=True), path)
    motion = anchor_at_pelvis(read, rest_joints)
    if motion.note is not None:
        console.info(f"note: {motion.note}")
    for sentence in plausibility_warnings(read):
        console.warning(sentence)
    lost = int((~motion.valid).sum())
    if lost == len(motion):
        raise InputError(f"None of the {len(motion)} poses in {path} is valid.")
    if lost:
        console.warning(f"{lost} of {len(motion)} poses are not valid; left out.")
    return motion
