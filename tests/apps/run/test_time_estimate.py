"""How long a run takes, and why it may take longer than it was given."""

import pytest

from apps.run.run_timing import describe_position, expected_held_out, post_training_seconds


def test_what_comes_after_learning_grows_with_frames_and_pixels():
    few = post_training_seconds(2, 270, fit_poses=False)
    assert (
        few
        < post_training_seconds(12, 270, fit_poses=False)
        < post_training_seconds(12, 540, fit_poses=False)
    )
    assert post_training_seconds(12, 540, fit_poses=True) > post_training_seconds(
        12, 540, fit_poses=False
    )
    assert post_training_seconds(2, 270, fit_poses=False, slowdown=3.0) == pytest.approx(3.0 * few)


@pytest.mark.parametrize(
    ("frames", "every", "held"),
    [(120, 10, 12), (8, 10, 1), (None, 10, 100), (9000, 10, 100), (120, 0, 0)],
)
def test_how_many_frames_will_be_held_out(frames, every, held):
    assert expected_held_out(frames, every, 100) == held


@pytest.mark.parametrize(
    ("elapsed_s", "frames_read", "expected"),
    [
        (12.2, (5, 24), "12 of 40 s, step 9"),
        (54.0, (12, 24), "54 s (limit 40 s): finishing the first pass over the video, 12 of 24 "
         "frames read"),
        (54.0, (12, None), "12 frames read"),
        (54.0, None, "54 s (limit 40 s): last steps"),
    ],
)  # fmt: skip
def test_time_beyond_the_limit_is_explained(elapsed_s, frames_read, expected):
    found = describe_position(
        elapsed_s=elapsed_s, budget_s=40.0, step=9, steps=None, frames_read=frames_read
    )
    assert found.endswith(expected)


def test_steps_that_were_asked_for_are_counted():
    found = describe_position(elapsed_s=54.0, budget_s=40.0, step=9, steps=100, frames_read=None)
    assert found == "step 9 of 100, 54 s"
