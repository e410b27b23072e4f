"""A pose's step goes where the rays agree; neighbors tell of its error if errors wander."""

import numpy as np
import pytest

from avatar.training.pose_correction import (
    FULL_EVIDENCE,
    MAX_FRAME_GAP,
    MIN_EVIDENCE,
    MIN_RAY_LOSS,
    SIGMA_OF_ROW,
    UNINFORMATIVE_PRIOR,
    NormalEquations,
    PosePrior,
    RaySums,
    TemporalPosePrior,
    gauss_newton_step,
    interpolate_correction,
    prior_from_neighbors,
)

NONE, SCALE = np.zeros((25, 3)), SIGMA_OF_ROW[:, None]


@pytest.fixture
def slopes(rng):
    """What each of 600 rays' residual does for one spread of each of the 75 numbers."""
    return rng.normal(size=(600, 25, 3)) / SCALE


def pulls_of(slopes, off):
    """Gradients and losses of rays whose residuals are linear, in a pose that is off."""
    residual = np.einsum("rja,ja->r", slopes, off)
    return residual[:, None, None] * slopes, 0.5 * residual**2


def summed(gradients, loss):
    """Normal equations of rays, by their definition."""
    scaled = (gradients * SCALE).reshape(-1, 75)
    curved = scaled / (2.0 * (loss + MIN_RAY_LOSS))[:, None]
    room = ((0, 0), (0, 5))
    stiffness = (scaled**2).sum() / ((curved * scaled).sum() + 1e-12) + 1e-12
    return NormalEquations(
        np.pad(curved.T @ scaled, room).astype(np.float32),
        np.pad(scaled.sum(axis=0), (0, 5)).astype(np.float32),
        np.pad(scaled.T @ scaled, room).astype(np.float32),
        float(stiffness),
    )


def rays_of(slopes, off):
    return summed(*pulls_of(slopes, off))


def test_the_step_solves_what_is_linear_and_goes_as_much_farther_as_it_says(slopes, rng):
    off = rng.normal(size=(25, 3)) * SCALE * 0.3
    step = gauss_newton_step(rays_of(slopes, off), NONE, 1.0)
    assert step.evidence > FULL_EVIDENCE
    np.testing.assert_allclose(step.change / SCALE, -off / SCALE, atol=0.05)


def test_rays_that_pull_by_chance_move_nothing(slopes, rng):
    gradients, loss = pulls_of(slopes, rng.normal(size=(25, 3)) * SCALE * 0.3)
    signs = rng.choice([-1.0, 1.0], size=(len(loss), 1, 1))
    step = gauss_newton_step(summed(gradients * signs, loss), NONE, 1.0)
    assert step.evidence == pytest.approx(1.0, abs=0.4)
    assert not step.change.any()


def test_what_no_ray_feels_goes_to_where_it_was_given_or_is_expected(slopes, rng):
    off, there = rng.normal(size=(25, 3)) * SCALE * 0.3, np.zeros((25, 3))
    slopes[:, 7], off[7], there[7] = 0.0, 0.0, 0.02
    back = gauss_newton_step(rays_of(slopes, off), there, 1.0)
    np.testing.assert_allclose(back.change[7], -0.02, rtol=1e-3)
    step = gauss_newton_step(rays_of(slopes, off), NONE, 1.0, prior=PosePrior(there, 5.0))
    np.testing.assert_allclose(step.change[7], 0.02, rtol=1e-3)
    assert np.linalg.norm(np.delete(step.change, 7, axis=0)) > 0.1


def test_rays_that_feel_nothing_ask_for_nothing():
    step = gauss_newton_step(summed(np.zeros((9, 25, 3)), np.zeros(9)), NONE, 1.0)
    assert step.evidence == 0.0
    assert not step.change.any()


def test_evidence_that_would_not_move_a_pose_moves_it_where_other_frames_are_off(slopes, rng):
    gradients, loss = pulls_of(slopes, rng.normal(size=(25, 3)) * SCALE * 0.3)
    signs = rng.choice([-1.0, 1.0], size=(len(loss), 1, 1), p=[0.3, 0.7])
    alone, among = (
        gauss_newton_step(summed(gradients * signs, loss), NONE, common) for common in (1.0, 3.0)
    )
    assert alone.evidence == among.evidence < 2.0 * MIN_EVIDENCE - 1.0
    assert not alone.change.any()
    assert among.change.any()


def test_a_pose_that_is_to_move_in_any_case_makes_the_whole_step_without_evidence(slopes, rng):
    gradients, loss = pulls_of(slopes, rng.normal(size=(25, 3)) * SCALE * 0.3)
    whole = gauss_newton_step(summed(gradients, loss), NONE, np.inf)
    gated = gauss_newton_step(summed(gradients, loss), NONE, 100.0)
    assert whole.evidence == np.inf
    np.testing.assert_array_equal(whole.change, gated.change)


def remembering(rays: NormalEquations) -> RaySums:
    """Sums of one slot, which hold these rays."""
    sums = RaySums(np.arange(-1, 23), 1, with_moments=True)
    for store, values in zip(sums.equations(0)[:3], rays[:3], strict=True):
        assert store is not None
        store[:] = values
    return sums


def test_earlier_rays_count_as_if_they_had_been_followed_from_here(slopes, rng):
    """Equations are linear: their gradients at another correction give those at this one."""
    off = rng.normal(size=(25, 3)) * SCALE * 0.3
    there, here = rng.normal(size=(2, 25, 3)) * SCALE * 0.1
    sums = remembering(rays_of(slopes, off + there))
    sums.fade(0, here - there, 0.7)
    found, asked = sums.equations(0), rays_of(slopes, off + here)
    # residuals below the floor of the loss are not linear
    scale = 0.7 * np.abs(asked.gradient).max()
    np.testing.assert_allclose(found.gradient, 0.7 * asked.gradient, atol=0.02 * scale)
    np.testing.assert_allclose(found.curvature, 0.7 * rays_of(slopes, off + there).curvature)
    sums.clear(0)
    assert not any(np.any(part) for part in sums.equations(0)[:3])


@pytest.mark.parametrize("times", [1e3, 1e6])
def test_the_step_is_finite_where_one_ray_outweighs_all_others(slopes, rng, times):
    gradients, loss = pulls_of(slopes, rng.normal(size=(25, 3)) * SCALE * 0.3)
    gradients[0] *= times
    step = gauss_newton_step(summed(gradients, loss), NONE, np.inf)
    assert np.isfinite(step.change).all()
    assert step.change.any()


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
