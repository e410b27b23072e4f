"""Tests of `capture/work_ahead.py`."""

import threading
from contextlib import closing

import pytest

from capture.work_ahead import RESULTS_PER_WORKER, map_ahead, read_ahead


@pytest.mark.parametrize("workers", [1, 3])
def test_results_come_in_the_order_of_the_items(workers):
    squares = [n * n for n in range(20)]
    assert list(map_ahead(lambda n: n * n, range(20), workers=workers)) == squares


def test_two_threads_work_side_by_side():
    both = threading.Barrier(2, timeout=60.0)
    list(map_ahead(lambda _: both.wait(), range(4), workers=2))  # one alone would wait in vain


def test_items_are_taken_only_a_few_ahead():
    taken = []
    results = map_ahead(lambda n: n, (taken.append(n) or n for n in range(99)), workers=2)
    assert next(results) == 0
    assert len(taken) == 2 * RESULTS_PER_WORKER
    results.close()
    assert len(taken) == 2 * RESULTS_PER_WORKER


def test_an_error_is_raised_at_its_place():
    results = map_ahead(lambda n: 1 // (2 - n), range(5), workers=1)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ZeroDivisionError):
        next(results)


class Film:
    """Frames, and the thread that decodes them."""

    def __init__(self):
        self.threads, self.is_closed = set(), False

    def frames(self):
        try:
            for number in range(9):
                self.threads.add(threading.current_thread())
                yield number
        finally:
            self.is_closed = True


def test_frames_are_read_on_another_thread():
    film = Film()
    assert list(read_ahead(film.frames())) == list(range(9))
    assert threading.current_thread() not in film.threads
    assert film.is_closed


def test_a_film_that_is_left_early_is_closed():
    film = Film()
    with closing(read_ahead(film.frames())) as frames:
        assert next(frames) == 0
    assert film.is_closed


def test_an_error_amid_a_film_is_raised_after_the_frames_before_it():
    def frames():
        yield 0
        raise ValueError("damaged")

    film = read_ahead(frames())
    assert next(film) == 0
    with pytest.raises(ValueError, match="damaged"):
        next(film)
