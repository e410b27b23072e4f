"""Soft edges from hard masks."""

import cv2
import numpy as np
import pytest

from preprocess.masks.matte import EDGE_SIGMA_PX, soften_border


def drawn(rng, *, fine: int = 8, size: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """A disc of two colours before a wall, drawn finely and reduced; and its true alpha."""
    y, x = np.mgrid[0 : size * fine, 0 : size * fine] / fine
    disc = np.hypot(x - 31.3, y - 33.7) < 20.2
    alpha = cv2.resize(disc.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    person = np.where((x < 32)[..., None], [30.0, 60, 150], [160, 40, 30])
    whole = np.where(disc[..., None], person, [205.0, 210, 190]).astype(np.float32)
    rgb = cv2.resize(whole, (size, size), interpolation=cv2.INTER_AREA)
    return np.clip(rgb + rng.normal(0, 2, rgb.shape), 0, 255).astype(np.uint8), alpha


def test_edges_come_nearer_to_the_true_ones_than_hard_and_than_smooth_ones(rng):
    rgb, alpha = drawn(rng)
    hard = alpha > 0.5
    smooth = cv2.GaussianBlur(hard.astype(np.float32), (0, 0), EDGE_SIGMA_PX)
    off = [((mask - alpha) ** 2).mean() for mask in (hard, smooth, soften_border(rgb, hard))]
    assert off[2] < 0.5 * off[1] < 0.5 * off[0]


def test_only_the_border_changes(rng):
    rgb, alpha = drawn(rng)
    hard = alpha > 0.5
    soft = soften_border(rgb, hard)
    square = np.ones((3, 3), np.uint8)
    inside = cv2.erode(hard.astype(np.uint8), square) > 0
    outside = cv2.dilate(hard.astype(np.uint8), square) == 0
    assert (soft[inside] == 1.0).all()
    assert (soft[outside] == 0.0).all()
    assert soft.min() == 0.0
    assert soft.max() == 1.0


def test_where_colours_are_alike_the_mask_is_smoothed(rng):
    _, alpha = drawn(rng)
    grey = np.full((64, 64, 3), 128, np.uint8)
    hard = alpha > 0.5
    soft = soften_border(grey, hard)
    border = (soft > 0.0) & (soft < 1.0)
    smooth = cv2.GaussianBlur(hard.astype(np.float32), (0, 0), EDGE_SIGMA_PX)
    np.testing.assert_allclose(soft[border], smooth[border], atol=1e-6)


@pytest.mark.parametrize("whole", [False, True])
def test_masks_of_all_or_nothing_stay(whole):
    person = np.full((20, 30), whole)
    rgb = np.zeros((20, 30, 3), np.uint8)
    np.testing.assert_array_equal(soften_border(rgb, person), person)
