"""The person's own color at the border of a mask."""

import numpy as np
import pytest

from preprocess.masks.matting import person_colors


@pytest.fixture
def alpha() -> np.ndarray:
    """A disk's mask with a border of two pixels."""
    rows, columns = np.mgrid[:41, :37]
    away = np.hypot(rows - 20.0, columns - 17.0)
    return np.clip((13.0 - away) / 2.0, 0.0, 1.0).astype(np.float32)


def mix(person: np.ndarray, background: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    mixed = alpha[..., None] * person + (1.0 - alpha[..., None]) * background
    return np.rint(mixed).astype(np.uint8)


def test_a_border_pixel_has_the_persons_color_without_the_background(alpha):
    person, background = np.array([180.0, 30.0, 40.0]), np.array([240.0, 250.0, 235.0])
    rgb = mix(person, background, alpha)
    border = (alpha > 0.1) & (alpha < 1.0)
    stain = np.abs(rgb[border] - person).max(axis=1).mean()
    left = np.abs(person_colors(rgb, alpha)[border] - person).max(axis=1).mean()
    assert stain > 60.0
    assert left < 0.4 * stain


def test_stripes_and_a_background_of_two_colors_are_kept_apart(alpha):
    columns = np.arange(alpha.shape[1])
    stripes = np.where((columns // 5 % 2)[None, :, None] > 0, [30.0, 60.0, 200.0], 220.0)
    person = np.broadcast_to(stripes, (*alpha.shape, 3))
    background = np.where(np.arange(len(alpha))[:, None, None] < 20, [0.0, 160.0, 0.0], 90.0)
    rgb = mix(person, np.broadcast_to(background, person.shape), alpha)
    weight = alpha[..., None]
    stain = np.square(weight * (rgb - person)).mean()
    assert np.square(weight * (person_colors(rgb, alpha) - person)).mean() < 0.4 * stain


def test_a_hard_mask_leaves_the_image_as_it_is(alpha, rng):
    rgb = rng.integers(0, 256, (*alpha.shape, 3), dtype=np.uint8)
    np.testing.assert_array_equal(person_colors(rgb, (alpha > 0.5).astype(np.float32)), rgb)


def test_an_empty_mask_and_one_of_the_whole_image_are_no_error(rng):
    rgb = rng.integers(0, 256, (6, 9, 3), dtype=np.uint8)
    for value in (0.0, 0.5, 1.0):
        found = person_colors(rgb, np.full((6, 9), value, np.float32))
        assert np.isfinite(found).all()
