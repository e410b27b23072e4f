"""Tests for alpha matting: borders of masks before a known background."""

import cv2
import numpy as np

from preprocess.masks.matting import border_distance_px, refine_border

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
