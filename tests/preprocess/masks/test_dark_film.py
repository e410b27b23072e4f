"""Tests for the brightening of dark films."""

import numpy as np

from preprocess.masks.color_models import BRIGHT_LEVEL, DarkFilmBrightener


def picture(level: int) -> np.ndarray:
    """A horizontal ramp up to a level."""
    ramp = np.linspace(0, level, 64).astype(np.uint8)
    return np.broadcast_to(ramp[None, :, None], (48, 64, 3)).copy()


def test_films_in_light_are_left_as_they_are():
    brighten = DarkFilmBrightener()
    for level in (200, 20):  # a dark frame of a film whose first was bright
        rgb = picture(level)
        assert brighten(rgb) is rgb


def test_dark_films_are_brightened_all_frames_alike():
    brighten = DarkFilmBrightener()
    first, second = brighten(picture(20)), brighten(picture(10))
    assert first.max() > 0.9 * BRIGHT_LEVEL
    np.testing.assert_allclose(second.max(), first.max() / 2, atol=6)


def test_a_film_that_fades_in_is_not_overexposed():
    brighten = DarkFilmBrightener()
    brighten(picture(0))
    rgb = picture(200)
    assert brighten(rgb) is rgb
