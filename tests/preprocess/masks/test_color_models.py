"""The background plate at any exposure, until the camera moves; dark films."""

import numpy as np
import pytest

from preprocess.masks.color_models import BRIGHT_LEVEL, BackgroundPlate, DarkFilmBrightener

SIZE = 40, 60
FREE = np.ones(SIZE, dtype=bool)
ALL = np.s_[: SIZE[0], : SIZE[1]]


def _wall() -> np.ndarray:
    return np.random.default_rng(0).uniform(60.0, 200.0, (3, *SIZE)).astype(np.float32)


def _plate(frames: int) -> BackgroundPlate:
    plate = BackgroundPlate()
    for _ in range(frames):
        plate.align(_wall(), FREE)
        plate.update(_wall(), FREE)
    return plate


def test_background_is_known_once_seen_twice() -> None:
    """One frame may be mistaken."""
    assert not _plate(1).within(ALL).known.any()
    assert _plate(2).within(ALL).known.all()


def test_what_was_never_free_stays_unknown() -> None:
    plate, free = _plate(0), FREE.copy()
    free[10:20] = False
    for _ in range(3):
        plate.align(_wall(), free)
        plate.update(_wall(), free)
    assert np.array_equal(plate.within(ALL).known, free)


def test_colors_follow_the_exposure() -> None:
    plate, gain = _plate(3), np.array([0.85, 0.95, 1.1], np.float32)[:, None, None]
    plate.align(gain * _wall(), FREE)
    found = plate.within(ALL)
    assert found.mean == pytest.approx(gain * _wall(), abs=0.5)


def test_moved_camera_forgets_the_background() -> None:
    """If a good part of the background differs, nothing is known until it was seen again."""
    plate, moved = _plate(5), np.roll(_wall(), 2, axis=2)
    plate.align(moved, FREE)
    assert not plate.within(ALL).known.any()
    for _ in range(2):
        plate.update(moved, FREE)
    assert plate.within(ALL).mean == pytest.approx(moved, abs=0.5)


def test_another_size_keeps_the_background() -> None:
    """A person who comes nearer is looked at in a smaller image."""
    plate = _plate(3)
    plate.align(np.full((3, 20, 30), 130.0, np.float32), np.zeros((20, 30), dtype=bool))
    assert plate.within(np.s_[:20, :30]).known.all()


def test_a_black_background_is_learnt_and_a_black_frame_is_not() -> None:
    dark, black = BackgroundPlate(), np.zeros((3, *SIZE), np.float32)
    for _ in range(3):
        dark.align(black, FREE)
        dark.update(black, FREE)
    assert dark.within(ALL).known.all()
    assert not dark.within(ALL).mean.any()
    plate = _plate(3)
    plate.align(black, FREE)
    plate.update(black, FREE)
    for _ in range(3):
        plate.align(_wall(), FREE)
        plate.update(_wall(), FREE)
    assert plate.within(ALL).mean == pytest.approx(_wall(), abs=1.0)


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
