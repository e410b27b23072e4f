"""A person's stated height: body, distances and whatever hangs on them become that large."""

from dataclasses import replace

import numpy as np

from preprocess.body import ShapedBody
from preprocess.doctor.claim import Claim
from preprocess.pose import Motion

LEAST_CM, MOST_CM = 40.0, 260.0


def height_of(shaped: ShapedBody) -> float:
    """From the soles to the crown at rest, metres: barefoot, without hair."""
    return float(np.ptp(shaped.vertices[:, 1]))


def as_tall(shaped: ShapedBody, height_m: float) -> ShapedBody:
    """The same person in another size; proportions stay."""
    factor, body = height_m / height_of(shaped), shaped.body
    directions = body.pose_directions
    if directions is not None:
        body = replace(body, pose_directions=factor * directions)
    return ShapedBody(body=body, vertices=factor * shaped.vertices, joints=factor * shaped.joints)


def farther(claim: Claim, shaped: ShapedBody, taller: ShapedBody) -> Motion:
    """The motion of a body that became larger, as the same pictures show it.

    What the camera sees stays if distances from it grow with the body.

    Args:
        claim: Poses and cameras.
        shaped: The person that the poses were made for.
        taller: The same in the other size.
    """
    factor = height_of(taller) / height_of(shaped)
    eyes = claim.eyes()[claim.camera_rows()]
    pelves = shaped.joints[0] + claim.motion.root_translations
    moved = eyes + factor * (pelves - eyes)
    return replace(claim.motion, root_translations=moved - taller.joints[0])
