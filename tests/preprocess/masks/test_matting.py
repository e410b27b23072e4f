"""Tests for alpha matting: soft borders of hard masks, and borders before a known background."""

import cv2
import numpy as np
import pytest

from preprocess.masks.matting import EDGE_SIGMA_PX, border_distance_px, refine_border, soften_border


def drawn(rng, *, fine: int = 8, size: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """A disc of two colors before a wall, drawn finely and reduced; and its true alpha."""
    y, x = np.mgrid[0 : size * fine, 0 : size * fine] / fine
    disc = np.hypot(x - 31.3, y - 33.7) < 20.2
    alpha = cv2.resize(disc.astype(np.float32), (size, size), interpolation=cv2.INTER_AREA)
    person = np.where((x < 32)[..., None], [30.0, 60, 150], [160, 40, 30])
    whole = np.where(disc[..., None], person, [205.0, 210, 190]).astype(np.float32)
    rgb = cv2.resize(whole, (size, size), interpolation=cv2.INTER_AREA)
    return np.clip(rgb + rng.normal(0, 2, rgb.shape), 0, 255).astype(np.uint8), alpha


def test_soft_borders_beat_hard_and_blurred_ones(rng):
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


def test_where_colors_are_alike_the_mask_is_blurred(rng):
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


WALL, SUIT = np.float32([205, 60, 190]), np.float32([30, 160, 40])


def disc(radius: float, size: int = 64, fine: int = 8) -> np.ndarray:
    """How much of each pixel a disc covers."""
    y, x = np.mgrid[0 : size * fine, 0 : size * fine] / fine
    inside = (np.hypot(x - 31.3, y - 33.7) < radius).astype(np.float32)
    return cv2.resize(inside, (size, size), interpolation=cv2.INTER_AREA)


def constant(color: np.ndarray, spread: float, size: int = 64) -> tuple[np.ndarray, np.ndarray]:
    return (
        np.broadcast_to(color, (size, size, 3)).astype(np.float32),
        np.full((size, size), spread, np.float32),
    )


def pictured(alpha: np.ndarray, wall: np.ndarray) -> np.ndarray:
    mixed = alpha[..., None] * SUIT + (1.0 - alpha[..., None]) * wall
    return (mixed + 0.5).astype(np.uint8)


def test_a_border_half_a_pixel_off_comes_back(rng):
    """In either direction, before a wall of any known colors."""
    true = disc(20.2)
    wall = rng.integers(120, 250, (64, 64, 3)).astype(np.float32)
    picture = pictured(true, wall)
    for radius in (19.7, 20.7):
        given = disc(radius)
        found = refine_border(picture, given, (wall, constant(WALL, 5.0)[1]), constant(SUIT, 8.0))
        assert np.abs(found - true).sum() < 0.33 * np.abs(given - true).sum()
        far = np.abs(border_distance_px(given)) > 4.0
        np.testing.assert_array_equal(found[far], given[far])


def test_nothing_changes_where_either_color_is_unknown():
    picture, given = pictured(disc(20.2), WALL), disc(19.7)
    known, unknown = constant(WALL, 5.0), constant(SUIT, np.inf)
    np.testing.assert_array_equal(refine_border(picture, given, known, unknown), given)
    np.testing.assert_array_equal(refine_border(picture, given, unknown, known), given)


def test_the_mask_stays_where_person_and_wall_look_alike():
    """No displacement is likelier than another, so the area stays."""
    given = disc(20.2)
    found = refine_border(pictured(given, SUIT), given, constant(SUIT, 5.0), constant(SUIT, 5.0))
    assert abs(found.sum() - given.sum()) < 0.02 * given.sum()
    assert np.abs(found - given).max() < 0.5


def test_an_unexpected_foreground_color_is_still_person():
    """The expected color lies beyond the person's, so by both colors alone half is wall."""
    true, given = disc(20.2), disc(19.7)
    expected = WALL + 2.0 * (SUIT - WALL)
    found = refine_border(pictured(true, WALL), given, constant(WALL, 5.0), constant(expected, 8.0))
    assert found[true == 1.0].mean() > 0.96


def test_border_distance_has_sub_pixel_accuracy():
    y, x = np.mgrid[0:64, 0:64] + 0.5
    true = np.hypot(x - 31.3, y - 33.7) - 20.2
    near = np.abs(true) < 4.0
    off = np.abs(border_distance_px(disc(20.2)) - true)[near]
    assert off.mean() < 0.25
    assert off.max() < 0.8
