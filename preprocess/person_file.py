"""The person at rest as a file: the body that an avatar has, for poses that come later."""

from pathlib import Path

import numpy as np

from capture.errors import InputError
from preprocess.body import BodyModel, ShapedBody
from preprocess.npz import read_npz

SHAPED_BODY_KEYS = ("family", "vertices", "joints")


def write_shaped_body(path: Path, person: ShapedBody) -> None:
    """Writes the resting vertices and joints, and whose betas would shape the body.

    Raises:
        OSError: If the disk is full.
    """
    np.savez(
        path,
        family=np.array(person.body.family),
        vertices=person.vertices.astype(np.float32),
        joints=person.joints,
    )


def read_shaped_body(path: Path, body: BodyModel) -> ShapedBody:
    """The person that `write_shaped_body` wrote, on the same body.

    Args:
        path: The file.
        body: What the user names now (--body), or the embedded body.

    Raises:
        InputError: If it is another body than then, or the file cannot be read.
    """
    arrays = read_npz(path)
    if not set(SHAPED_BODY_KEYS) <= arrays.keys() or arrays["joints"].shape != (24, 3):
        raise InputError(f"{path} holds no person; expected {', '.join(SHAPED_BODY_KEYS)}. Is it ours?")
    family, vertices = str(arrays["family"]), arrays["vertices"].astype(np.float64)
    if family != body.family or vertices.shape != body.template.shape:
        raise InputError(
            f"{path}: the avatar was learnt on a {family!r} body of {len(vertices)} vertices, "
            f"now it is {body.family!r} with {len(body.template)}. Give the same --body as then "
            "(none is the embedded body), or learn the avatar anew (--overwrite)."
        )
    return ShapedBody(body=body, vertices=vertices, joints=arrays["joints"].astype(np.float64))
