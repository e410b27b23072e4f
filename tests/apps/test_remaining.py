"""How long a run takes, and why it may take longer than it was given."""

import pytest

from apps.learning.remaining import after_learning_s, held_out_of, how_far


def test_what_comes_after_learning_grows_with_frames_and_pixels():
    few = after_learning_s(2, 270, fitted=False)
    assert few < after_learning_s(12, 270, fitted=False) < after_learning_s(12, 540, fitted=False)
    assert after_learning_s(12, 540, fitted=True) > after_learning_s(12, 540, fitted=False)
    assert after_learning_s(2, 270, fitted=False, slowed=3.0) == pytest.approx(3.0 * few)


@pytest.mark.parametrize(
    ("frames", "every", "held"),
    [(120, 10, 12), (8, 10, 1), (None, 10, 100), (9000, 10, 100), (120, 0, 0)],
)
def test_how_many_frames_will_be_held_out(frames, every, held):
    assert held_out_of(frames, every, 100) == held


@pytest.mark.parametrize(
    ("wall_s", "reading", "said"),
    [
        (12.2, (5, 24), "12 of 40 s, step 9"),
        (54.0, (12, 24), "54 s, more than the 40 s that were given, because every frame is trained "
         "on at least once: 12 of 24 frames read, then it ends"),
        (54.0, (12, None), "12 frames read, then it ends"),
        (54.0, None, "54 s, more than the 40 s that were given: the last steps"),
    ],
)  # fmt: skip
def test_time_that_is_up_is_explained(wall_s, reading, said):
    found = how_far(wall_s=wall_s, given_s=40.0, step=9, steps=None, reading=reading)
    assert found.endswith(said)


def test_steps_that_were_asked_for_are_counted():
    found = how_far(wall_s=54.0, given_s=40.0, step=9, steps=100, reading=None)
    assert found == "step 9 of 100, 54 s"
