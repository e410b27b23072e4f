"""Neighbours tell of a pose's error what a wandering tracker lets them, and else nothing."""

import numpy as np
import pytest

from avatar.training.pose_correction import (
    MAX_FRAME_GAP,
    MIN_NEIGHBOR_TRIPLES,
    UNINFORMATIVE_PRIOR,
    TemporalPosePrior,
    interpolate_correction,
    neighbor_correlations,
    neighbor_precision,
    prior_from_neighbors,
)


def errors_of(rng, frames, *, alike):
    """An autoregressive process of unit variance, of this correlation from frame to frame."""
    errors = [rng.normal(size=(25, 3))]
    for _ in range(frames - 1):
        errors.append(alike * errors[-1] + np.sqrt(1.0 - alike**2) * rng.normal(size=(25, 3)))
    return np.array(errors)


@pytest.mark.parametrize("alike", [0.0, 0.5, 0.9])
def test_correlations_of_a_process_are_found_in_any_order_of_its_frames(rng, alike):
    errors, order = errors_of(rng, 100, alike=alike), rng.permutation(130)
    known, held = order < 100, errors_of(rng, 130, alike=0.0)
    held[known] = errors[order[known]]
    found = neighbor_correlations(np.argsort(order), order, held, known)
    np.testing.assert_allclose(found, (alike, alike**2), atol=0.08)


def test_too_few_neighbours_tell_nothing(rng):
    errors = errors_of(rng, MIN_NEIGHBOR_TRIPLES + 2, alike=0.99)
    numbers, known = np.arange(len(errors)), np.ones(len(errors), bool)
    assert neighbor_correlations(numbers, numbers, errors, known)[0] > 0.8
    assert neighbor_precision(numbers, errors, known) > 0.0
    assert neighbor_precision(numbers, errors, numbers > 0) == 0.0
    assert neighbor_precision((MAX_FRAME_GAP + 1) * numbers, errors, known) == 0.0


def test_neighbors_count_more_where_estimates_are_noisy_and_less_where_errors_change_fast(rng):
    numbers, known = np.arange(200), np.ones(200, bool)
    noise = rng.normal(size=(200, 25, 3))

    def precision(alike, share):
        errors = errors_of(rng, 200, alike=alike)
        return neighbor_precision(numbers, errors + share * noise, known)

    assert precision(0.85, 0.8) > 2.5 * precision(0.85, 0.0)
    assert precision(0.85, 0.8) > 2.5 * precision(0.5, 0.8)


def test_a_frame_is_expected_to_err_as_those_around_it_do_the_nearest_most(rng):
    errors = errors_of(rng, 40, alike=0.95)
    frames = np.delete(np.arange(41), 20)
    held = np.ones(41, dtype=bool)
    told = prior_from_neighbors(
        20,
        np.append(frames, 19),
        np.append(errors, errors[:1], axis=0),
        np.append(held[1:], False),
        24.0,
    )
    distances = np.abs(frames - 20)
    weights = np.where(distances <= MAX_FRAME_GAP, 1.0 / distances, 0.0)
    mean = np.average(errors, axis=0, weights=weights)
    assert told.precision == 25.0
    np.testing.assert_allclose(told.mean, 0.96 * mean)
    between = interpolate_correction(20, dict(zip(frames.tolist(), errors, strict=True)))
    share = np.vdot(between, mean) / np.vdot(mean, mean)
    assert 0.9 < share < 1.0
    np.testing.assert_allclose(between, share * mean)


def test_the_error_of_a_frame_in_between_is_guessed_where_errors_wander(rng):
    errors = errors_of(rng, 60, alike=0.97)
    known = {frame: error for frame, error in enumerate(errors) if frame % 10}
    missed = [errors[frame] - interpolate_correction(frame, known) for frame in range(10, 60, 10)]
    assert np.mean(np.square(missed)) < 0.3 * np.mean(np.square(errors[10::10]))


def test_a_pose_is_predicted_by_its_neighbours_and_not_by_itself(rng):
    errors, neighbours = errors_of(rng, 40, alike=0.95), TemporalPosePrior(40)
    for slot in range(40):
        neighbours.set_frame(slot, slot)
        neighbours.record_estimate(slot, errors[slot])
    before = neighbours.prior_for(20, errors)
    assert before.precision > 8.0
    errors[20] += 100.0
    np.testing.assert_array_equal(neighbours.prior_for(20, errors).mean, before.mean)
    neighbours.set_frame(20, None)
    assert neighbours.prior_for(20, errors) is UNINFORMATIVE_PRIOR


def test_neighbors_are_ignored_where_errors_flicker_or_none_is_near(rng):
    flickering, wandering = (errors_of(rng, 40, alike=alike) for alike in (0.0, 0.95))
    assert not interpolate_correction(20, dict(enumerate(flickering))).any()
    assert not interpolate_correction(60, dict(enumerate(wandering))).any()
    assert not interpolate_correction(20, {}).any()
