"""Border pixels, where it is known what lies behind them."""

import cv2
import numpy as np

from preprocess.masks.mixture import border_distance_px, refine_border

WALL, SUIT = np.float32([205, 60, 190]), np.float32([30, 160, 40])


def disc(radius: float, size: int = 64, fine: int = 8) -> np.ndarray:
    """How much of each pixel a disc covers."""
    y, x = np.mgrid[0 : size * fine, 0 : size * fine] / fine
    inside = (np.hypot(x - 31.3, y - 33.7) < radius).astype(np.float32)
    return cv2.resize(inside, (size, size), interpolation=cv2.INTER_AREA)


def told(colour: np.ndarray, spread: float, size: int = 64) -> tuple[np.ndarray, np.ndarray]:
    return (
        np.broadcast_to(colour, (size, size, 3)).astype(np.float32),
        np.full((size, size), spread, np.float32),
    )


def pictured(alpha: np.ndarray, wall: np.ndarray) -> np.ndarray:
    mixed = alpha[..., None] * SUIT + (1.0 - alpha[..., None]) * wall
    return (mixed + 0.5).astype(np.uint8)


def test_a_border_half_a_pixel_off_comes_back(rng):
    """Whichever way it is off; the wall may be of any colours, if they are known."""
    true = disc(20.2)
    wall = rng.integers(120, 250, (64, 64, 3)).astype(np.float32)
    picture = pictured(true, wall)
    for radius in (19.7, 20.7):
        given = disc(radius)
        found = refine_border(picture, given, (wall, told(WALL, 5.0)[1]), told(SUIT, 8.0))
        assert np.abs(found - true).sum() < 0.33 * np.abs(given - true).sum()
        far = np.abs(border_distance_px(given)) > 4.0
        np.testing.assert_array_equal(found[far], given[far])


def test_nothing_changes_where_one_of_both_colours_is_unknown():
    picture, given = pictured(disc(20.2), WALL), disc(19.7)
    known, unknown = told(WALL, 5.0), told(SUIT, np.inf)
    np.testing.assert_array_equal(refine_border(picture, given, known, unknown), given)
    np.testing.assert_array_equal(refine_border(picture, given, unknown, known), given)


def test_the_mask_is_believed_where_person_and_wall_look_alike():
    """No displacement is likelier than another, so what is found is as much as was given."""
    given = disc(20.2)
    found = refine_border(pictured(given, SUIT), given, told(SUIT, 5.0), told(SUIT, 5.0))
    assert abs(found.sum() - given.sum()) < 0.02 * given.sum()
    assert np.abs(found - given).max() < 0.5


def test_a_person_of_another_colour_than_expected_is_still_no_wall():
    """The expected colour lies beyond the person's, so by both colours alone half is wall."""
    true, given = disc(20.2), disc(19.7)
    expected = WALL + 2.0 * (SUIT - WALL)
    found = refine_border(pictured(true, WALL), given, told(WALL, 5.0), told(expected, 8.0))
    assert found[true == 1.0].mean() > 0.97


def test_outside_is_a_distance_to_a_part_of_a_pixel():
    y, x = np.mgrid[0:64, 0:64] + 0.5
    true = np.hypot(x - 31.3, y - 33.7) - 20.2
    near = np.abs(true) < 4.0
    off = np.abs(border_distance_px(disc(20.2)) - true)[near]
    assert off.mean() < 0.25
    assert off.max() < 0.8
