"""Separates the mask of one person from another person beside it.

The network that segments a person takes in hands and legs of others that reach into its square.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

from preprocess.tracking.keypoints import CroppedMask, PersonKeypoints

TRUNK = (11, 12, 24, 23)
"""Key points around the trunk: shoulders and hips."""
LIMBS = (
    (11, 13), (13, 15), (15, 19), (12, 14), (14, 16), (16, 20), (7, 8), (0, 11), (0, 12),
    (23, 25), (25, 27), (27, 31), (27, 29), (24, 26), (26, 28), (28, 32), (28, 30),
)  # fmt: skip
"""Pairs of key points: arms with hands, head, and legs with feet."""
LIMB_RADIUS = 0.1
"""Distance from a person's limbs within which its skin and clothes lie, trunk lengths (5 cm)."""
MIN_VISIBILITY = 0.5
"""Visibility of both ends below which a limb of the other person is not drawn: it may be a guess
that lies across the person."""


def separate_mask(person: PersonKeypoints, other: PersonKeypoints) -> tuple[CroppedMask, float]:
    """Remove from a person's mask what another one's limbs reach into it.

    Pixels that are nearer to the other's limbs go, unless they are within `LIMB_RADIUS` of the
    person's: a hand may lie before the other's chest. Returns the mask, and the share of its area
    that is nearer to the other, in [0, 1].
    """
    mask = person.mask
    own, others = (
        _distance_to_limbs(mask, each.image_px, each.visibility >= least)
        for each, least in ((person, 0.0), (other, MIN_VISIBILITY))
    )
    middles = person.image_px[list(TRUNK)].reshape(2, 2, 2).mean(axis=1)
    px_per_pixel = float(np.hypot(*mask.image_from_crop[:, 0]))
    radius = LIMB_RADIUS * float(np.hypot(*(middles[1] - middles[0]))) / px_per_pixel
    is_others, is_person = own > others, mask.values > 127
    kept = np.where(is_others & (own > radius), 0, mask.values).astype(np.uint8)
    share = float((is_others & is_person).sum() / max(1, is_person.sum()))
    return CroppedMask(values=kept, image_from_crop=mask.image_from_crop), share


def _distance_to_limbs(
    mask: CroppedMask, image_px: Float[np.ndarray, "33 2"], drawn: Bool[np.ndarray, "33"]
) -> Float[np.ndarray, "rows columns"]:
    """Distance of a mask's pixels to a person's trunk and limbs, in pixels of the mask."""
    crop_from_image = np.linalg.inv(np.vstack([mask.image_from_crop, [0.0, 0.0, 1.0]]))
    points = image_px @ crop_from_image[:2, :2].T + crop_from_image[:2, 2]
    points = np.clip(points, -4096, 4096).astype(np.int32)
    free = np.full(mask.values.shape, 255, np.uint8)
    if drawn[list(TRUNK)].all():
        cv2.fillConvexPoly(free, cv2.convexHull(points[list(TRUNK)]), (0,))
    for start, end in LIMBS:
        if drawn[start] and drawn[end]:
            cv2.line(free, points[start].tolist(), points[end].tolist(), (0,))
    if free.all():
        return np.full(free.shape, np.inf, np.float32)
    return cv2.distanceTransform(free, cv2.DIST_L2, 5)
