"""Neighbours tell of a pose's error what a wandering tracker lets them, and else nothing."""

import numpy as np

from avatar.training.pose_correction import (
    MAX_FRAME_GAP,
    UNINFORMATIVE_PRIOR,
    TemporalPosePrior,
    interpolate_correction,
    prior_from_neighbors,
)


def errors_of(rng, frames, *, alike):
    """An autoregressive process of unit variance, of this correlation from frame to frame."""
    errors = [rng.normal(size=(25, 3))]
    for _ in range(frames - 1):
        errors.append(alike * errors[-1] + np.sqrt(1.0 - alike**2) * rng.normal(size=(25, 3)))
    return np.array(errors)


def test_a_frame_is_expected_to_err_as_those_around_it_do_the_nearest_most(rng):
    errors = errors_of(rng, 40, alike=0.95)
    frames = np.delete(np.arange(41), 20)
    held = np.ones(41, dtype=bool)
    told = prior_from_neighbors(
        20, np.append(frames, 19), np.append(errors, errors[:1], axis=0), np.append(held[1:], False)
    )
    distances = np.abs(frames - 20)
    weights = np.where(distances <= MAX_FRAME_GAP, 1.0 / distances, 0.0)
    mean = np.average(errors, axis=0, weights=weights)
    assert told.precision == 9.0
    np.testing.assert_allclose(told.mean, 8.0 / 9.0 * mean)
    between = interpolate_correction(20, dict(zip(frames.tolist(), errors, strict=True)))
    np.testing.assert_allclose(between, told.mean)


def test_the_error_of_a_frame_in_between_is_guessed_where_errors_wander(rng):
    errors = errors_of(rng, 60, alike=0.97)
    known = {frame: error for frame, error in enumerate(errors) if frame % 10}
    missed = [errors[frame] - interpolate_correction(frame, known) for frame in range(10, 60, 10)]
    assert np.mean(np.square(missed)) < 0.3 * np.mean(np.square(errors[10::10]))


def test_a_pose_is_predicted_by_its_neighbours_and_not_by_itself(rng):
    errors, neighbours = errors_of(rng, 40, alike=0.95), TemporalPosePrior(40)
    for slot in range(40):
        neighbours.set_frame(slot, slot)
    before = neighbours.prior_for(20, errors)
    assert before.precision > 8.0
    errors[20] += 100.0
    np.testing.assert_array_equal(neighbours.prior_for(20, errors).mean, before.mean)
    neighbours.set_frame(20, None)
    assert neighbours.prior_for(20, errors) is UNINFORMATIVE_PRIOR


def test_without_a_neighbor_nothing_is_expected(rng):
    wandering = errors_of(rng, 40, alike=0.95)
    assert not interpolate_correction(60, dict(enumerate(wandering))).any()
    assert not interpolate_correction(20, {}).any()
