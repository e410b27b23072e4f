"""Tests of `preprocess/tracking/person_separation.py`: pixels belong to the nearer limbs."""

import numpy as np
import pytest

from preprocess.tracking.blazepose import TRUNK, separate_mask
from preprocess.tracking.keypoints import CroppedMask, PersonKeypoints

SIZE = 64


def person(at, *, visible=True):
    """A person whose trunk is a square of 8 px around a point, with the left arm to its right."""
    points = np.tile(np.array(at, float), (33, 1))
    points[list(TRUNK)] += [(4, -4), (-4, -4), (-4, 4), (4, 4)]
    points[[13, 15, 19]] = points[11] + [(6, 0), (12, 0), (16, 0)]
    points[[14, 16, 20]] = points[12]
    points[[25, 27, 29, 31]], points[[26, 28, 30, 32]] = points[23], points[24]
    return PersonKeypoints(
        image_px=points, world_m=np.zeros((33, 3)), visibility=np.full(33, float(visible)),
        presence=1.0, mask=CroppedMask(
            values=np.full((SIZE, SIZE), 255, np.uint8), image_from_crop=np.eye(2, 3)
        ),
    )  # fmt: skip


def test_pixels_are_the_nearer_ones():
    mask, removed = separate_mask(person((16, 32)), person((48, 32)))
    assert removed == pytest.approx(0.41, abs=0.02)  # half of the square less the arm's part
    assert (mask.values[32, :30] == 255).all()
    assert (mask.values[:, 46:] == 0).all()
    assert mask.values[28, 36] == 255  # the hand that reaches over


def test_limbs_of_the_other_that_are_not_seen_take_nothing():
    mask, removed = separate_mask(person((16, 32)), person((48, 32), visible=False))
    assert removed == 0.0
    assert (mask.values == 255).all()


def test_the_mask_may_be_of_other_pixels_than_the_frame():
    """A crop twice as fine, that begins elsewhere."""
    one, other = person((16, 32)), person((48, 32))
    coarse, removed = separate_mask(one, other)
    fine = CroppedMask(
        values=np.full((2 * SIZE, 2 * SIZE), 255, np.uint8),
        image_from_crop=np.array([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]]),
    )
    of_fine, removed_of_fine = separate_mask(PersonKeypoints(**(vars(one) | {"mask": fine})), other)
    assert removed_of_fine == pytest.approx(removed, abs=0.02)
    assert (of_fine.values[1::2, 1::2] == coarse.values).mean() > 0.97


def test_a_hand_before_the_others_chest_stays():
    one, other = person((16, 32)), person((36, 28))
    mask, _ = separate_mask(one, other)
    assert (mask.values[28, 20:36] == 255).all()  # the arm, which ends in the other's trunk
    assert mask.values[24, 36] == 0
