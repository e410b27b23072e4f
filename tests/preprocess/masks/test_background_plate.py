"""The background plate: known after two frames, at any exposure, until the camera moves."""

import numpy as np
import pytest

from preprocess.masks.background_plate import BackgroundPlate

SIZE = 40, 60
FREE = np.ones(SIZE, dtype=bool)
ROWS, COLUMNS = (each.ravel() for each in np.mgrid[: SIZE[0], : SIZE[1]])


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
    assert not _plate(1).at(ROWS, COLUMNS).known.any()
    assert _plate(2).at(ROWS, COLUMNS).known.all()


def test_what_was_never_free_stays_unknown() -> None:
    """Behind the person nothing is learnt."""
    plate, free = _plate(0), FREE.copy()
    free[10:20] = False
    for _ in range(3):
        plate.align(_wall(), free)
        plate.update(_wall(), free)
    assert np.array_equal(plate.at(ROWS, COLUMNS).known, free.ravel())


def test_colors_follow_the_exposure() -> None:
    """A frame in other light is compared with the background in that light."""
    plate, gain = _plate(3), np.array([0.85, 0.95, 1.1], np.float32)[:, None, None]
    plate.align(gain * _wall(), FREE)
    found = plate.at(ROWS, COLUMNS)
    assert found.mean == pytest.approx((gain * _wall()).reshape(3, -1), abs=0.5)


def test_moved_camera_forgets_the_background() -> None:
    """If a good part of the background differs, nothing is known until it was seen again."""
    plate, moved = _plate(5), np.roll(_wall(), 2, axis=2)
    plate.align(moved, FREE)
    assert not plate.at(ROWS, COLUMNS).known.any()
    for _ in range(2):
        plate.update(moved, FREE)
    assert plate.at(ROWS, COLUMNS).mean == pytest.approx(moved.reshape(3, -1), abs=0.5)


def test_another_size_keeps_the_background() -> None:
    """A person who comes nearer is looked at in a smaller image."""
    plate = _plate(3)
    plate.align(np.full((3, 20, 30), 130.0, np.float32), np.zeros((20, 30), dtype=bool))
    rows, columns = (each.ravel() for each in np.mgrid[:20, :30])
    assert plate.at(rows, columns).known.all()
