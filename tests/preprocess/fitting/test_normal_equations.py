"""Elimination along a chain of frames, against a dense solution."""

import numpy as np

from preprocess.fitting.normal_equations import ChainEquations


def test_the_chain_is_solved_as_the_whole_matrix_is():
    generator = np.random.default_rng(0)
    frames, own, shared = 5, 4, 3
    equations = ChainEquations.empty(frames, own, shared)
    total = frames * own + shared
    dense, right = np.zeros((total, total)), np.zeros(total)
    for frame in range(frames):
        jacobian, jacobian_shared = generator.standard_normal((2, 20, 4))
        jacobian_shared = jacobian_shared[:, :shared]
        residuals, weights = generator.standard_normal(20), generator.random(20)
        equations.add(frame, jacobian, jacobian_shared, residuals, weights)
        whole = np.zeros((20, total))
        whole[:, frame * own : (frame + 1) * own] = jacobian
        whole[:, frames * own :] = jacobian_shared
        dense += whole.T @ (weights[:, None] * whole)
        right -= whole.T @ (weights * residuals)
    state, state_shared = (
        generator.standard_normal((frames, own)),
        generator.standard_normal(shared),
    )
    links, precision = generator.random((frames - 1, own)), generator.random(shared)
    equations.add_chain(state, np.ones(state.shape[1]), links)
    equations.add_shared(precision, state_shared)
    flat = state.ravel()
    dense[range(frames * own), range(frames * own)] += 1.0
    right[: frames * own] -= flat
    for gap in range(frames - 1):
        for each in range(own):
            row = np.zeros(total)
            row[gap * own + each], row[(gap + 1) * own + each] = -1.0, 1.0
            dense += links[gap, each] * np.outer(row, row)
            right -= links[gap, each] * row * (state[gap + 1, each] - state[gap, each])
    corner = range(frames * own, total)
    dense[corner, corner] += precision
    right[frames * own :] -= precision * state_shared
    expected = np.linalg.solve(dense, right)
    found, found_shared = equations.solve()
    assert np.allclose(found.ravel(), expected[: frames * own])
    assert np.allclose(found_shared, expected[frames * own :])


def test_other_parameters_lead_to_the_same_step():
    generator = np.random.default_rng(0)
    by, found = generator.standard_normal((2, 3, 3)), []
    for changes in (False, True):
        equations = ChainEquations.empty(2, 3, 1)
        jacobian, residuals = np.arange(1.0, 13.0).reshape(4, 3) ** 0.5, np.arange(4.0)
        for frame in range(2):
            equations.add(frame, jacobian, np.ones((4, 1)), residuals + frame, np.ones(4))
        equations.blocks[:] += np.eye(3)
        equations.add_shared(np.ones(1), np.zeros(1))
        if changes:
            equations.change_parameters(by)
        moved, shared = equations.solve()
        moved = (by @ moved[..., None])[..., 0] if changes else moved
        found.append(np.append(moved.ravel(), shared))
    assert np.allclose(*found)


def test_what_is_held_does_not_move():
    equations = ChainEquations.empty(2, 3, 2)
    equations.add(0, np.eye(3), np.ones((3, 2)), np.ones(3), np.ones(3))
    equations.add_chain(np.zeros((2, 3)), np.ones(3), np.ones((1, 3)))
    equations.add_shared(np.ones(2), np.zeros(2))
    equations.hold(np.array([1e9, 0.0]), 0.0)
    moved, shared = equations.solve()
    assert abs(shared[0]) < 1e-6 < abs(shared[1])
    assert np.abs(moved[1]).max() > 1e-3  # neighbors are coupled
