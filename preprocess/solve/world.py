"""The world of a solved capture: metres, y up, the floor at 0, the person over the origin.

z points from the person to the first camera, so that who faces it has SMPL's own axes.
"""

import numpy as np
from jaxtyping import Float

from preprocess.solve.floor import FloorPlane


def upright_axes(
    up: Float[np.ndarray, "3"], towards_camera: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Rotation from the solved world into one with y along `up`."""
    level = towards_camera - up * (towards_camera @ up)
    if np.linalg.norm(level) < 1e-9:  # the camera is right above
        level = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 0.0, 1.0])
    z = level / np.linalg.norm(level)
    return np.stack([np.cross(up, z), up, z])


def to_metric_world(
    camera_from_solved: Float[np.ndarray, "cameras 4 4"],
    scale: float,
    floor: FloorPlane,
    person: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "cameras 4 4"]:
    """The same cameras in the metric world.

    Args:
        camera_from_solved: Rigid transforms of the solved world, in its own unit.
        scale: Metres per unit.
        floor: Of the solved world.
        person: Where the person is in the solved world, in its unit.
    """
    turned, moved = camera_from_solved[:, :3, :3], camera_from_solved[:, :3, 3]
    centers = -np.einsum("cba,cb->ca", turned, moved)
    axes = upright_axes(floor.normal, centers[0] - person)
    origin = person - floor.normal * float(floor.heights_above(person[None])[0])
    there = scale * (centers - origin) @ axes.T
    found = np.tile(np.eye(4), (len(centers), 1, 1))
    found[:, :3, :3] = turned @ axes.T
    found[:, :3, 3] = -np.einsum("cab,cb->ca", found[:, :3, :3], there)
    return found
