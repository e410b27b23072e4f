"""A person's stated height: body, distances and whatever hangs on them become that large."""

from dataclasses import replace

import numpy as np

from preprocess.body import ShapedBody
from preprocess.doctor.claim import CaptureGeometry
from preprocess.pose import Motion

MIN_HEIGHT_CM, MAX_HEIGHT_CM = 40.0, 260.0


def body_height_m(shaped: ShapedBody) -> float:
    """From the soles to the crown at rest, metres: barefoot, without hair."""
    return float(np.ptp(shaped.vertices[:, 1]))


def scale_to_height(shaped: ShapedBody, height_m: float) -> ShapedBody:
    """The same person in another size; proportions stay."""
    factor, body = height_m / body_height_m(shaped), shaped.body
    directions = body.pose_directions
    if directions is not None:
        body = replace(body, pose_directions=factor * directions)
    return ShapedBody(body=body, vertices=factor * shaped.vertices, joints=factor * shaped.joints)


def rescale_motion(geometry: CaptureGeometry, shaped: ShapedBody, resized: ShapedBody) -> Motion:
    """The motion of a body that became larger, as the same pictures show it.

    What the camera sees stays if distances from it grow with the body.

    Args:
        claim: Poses and cameras.
        shaped: The person that the poses were made for.
        taller: The same in the other size.
    """
    factor = body_height_m(resized) / body_height_m(shaped)
    eyes = geometry.camera_centers()[geometry.camera_rows()]
    pelves = shaped.joints[0] + geometry.motion.root_translations
    moved = eyes + factor * (pelves - eyes)
    return replace(geometry.motion, root_translations=moved - resized.joints[0])
