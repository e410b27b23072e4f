"""The graph's builder, and the tables that the player reads."""

import numpy as np
import onnxruntime
import pytest

from baselines.reference_skinning import PosedNodes, skin_trilinear
from capture.input_error import InputError
from export.graph.onnx_builder import GraphBuilder
from export.package.player_tables import RenderSettings, round_codes
from export.player_inputs import skinning_nodes


@pytest.fixture(scope="module")
def skin(tables):
    return tables.skinning


@pytest.mark.parametrize("per_step", [1, 2])
def test_nodes_have_the_rigs_own_weights_whatever_their_step(stand_in, skin, per_step):
    nodes = skinning_nodes(skin, per_step)
    place = np.argwhere(nodes.index > 0)
    rows = nodes.index[tuple(place.T)]
    points = nodes.low + place * nodes.step_m
    np.testing.assert_allclose(nodes.positions[rows], points, atol=1e-6)
    exact = stand_in.rig.weights_at(points)
    np.testing.assert_allclose(nodes.weights[:, rows].T, exact, atol=2e-4)
    both = (nodes.index[..., :-1] > 0) & (nodes.index[..., 1:] > 0)
    assert (np.diff(nodes.index, axis=2)[both] == 1).all()  # along z rows follow each other


def test_the_skinning_grid_surrounds_all_visible_depths(tables, skin):
    """All eight corners of the cell about anything that may be seen are stored."""
    surfels = tables.surfels
    for share in (0.0, 0.3, 1.0):
        points = surfels.positions - share * surfels.thickness[:, None] * surfels.normals
        cell = np.floor((points - skin.low) / skin.step_m).astype(int)
        stored = [skin.index[tuple((cell + corner).T)] > 0 for corner in np.ndindex(2, 2, 2)]
        assert np.mean(stored) > 0.999  # normals and depths are rounded where they are stored


@pytest.mark.parametrize("per_step", [1, 2])
def test_no_inverse_is_taken_of_the_skin_beyond_its_stored_cells(skin, per_step):
    """There the derivative is taken between unrelated nodes, and rays go anywhere: stray dots."""
    nodes, stretch = skinning_nodes(skin, per_step), RenderSettings().max_volume_ratio
    whole, some = np.ones(np.subtract(skin.index.shape, 1), bool), np.zeros(1, bool)
    x, y, z = skin.index.shape
    for i, j, k in np.ndindex(2, 2, 2):
        stored = skin.index[i : x - 1 + i, j : y - 1 + j, k : z - 1 + k] > 0
        whole, some = whole & stored, some | stored

    def trusted(cells):
        inside = np.random.default_rng(0).uniform(0.01, 0.99, (len(cells), 3))
        points = (skin.low + (cells + inside) * skin.step_m).astype(np.float32)
        volume = np.linalg.det(skin_trilinear(PosedNodes(nodes, nodes.positions), points)[1])
        return ((volume > 1 / stretch) & (volume < stretch)).mean()

    assert trusted(np.argwhere(whole)) == 1.0
    assert trusted(np.argwhere(some & ~whole)) == 0.0


def test_stored_normals_point_outward_and_are_nearly_unit(tables):
    normals = tables.surfels.normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=0.06)
    codes = tables.surfels.normal_codes
    assert codes.max() <= 127
    assert codes.min() >= -127
    middle = tables.surfels.positions.mean(axis=0)
    outward = ((tables.surfels.positions - middle) * normals).sum(axis=1)
    assert (outward > 0).mean() > 0.6


@pytest.mark.parametrize(("step", "largest"), [(8, 255), (16, 255), (32, 65535), (1, 255)])
def test_rounding_codes_moves_none_by_more_than_a_step(step, largest):
    codes = np.arange(largest + 1).astype(np.uint16 if largest > 255 else np.uint8)
    near = round_codes(codes, step, largest)
    assert near.dtype == codes.dtype
    assert (near % step == 0).all()
    error = np.abs(near.astype(int) - codes.astype(int))
    assert error[: largest - step].max() <= step // 2
    assert error.max() < step


def test_steps_cut_in_other_ways_are_refused(skin):
    with pytest.raises(InputError, match="7 parts"):
        skinning_nodes(skin, 7)


def run(graph, value, **inputs):
    graph.output(value, "out", ["n"])
    session = onnxruntime.InferenceSession(
        graph.model().SerializeToString(), providers=["CPUExecutionProvider"]
    )
    return session.run(None, inputs)[0]


@pytest.mark.parametrize("turns", [0, 1, 7])
def test_a_loop_runs_its_body_the_given_number_of_times(turns):
    graph = GraphBuilder()
    x, count = graph.input("x", np.float32, [4]), graph.input("count", np.int64, [])

    def body(turn, states):
        power, total = states
        return [power * x, total + power * turn.cast(np.float32)]

    _, total = graph.loop(count, [x * 0.0 + 1.0, x * 0.0], body)
    numbers = np.array([0.5, 1.0, -1.0, 2.0], dtype=np.float32)
    expected = sum((numbers**i * i for i in range(turns)), np.zeros(4))
    result = run(graph, total, x=numbers, count=np.array(turns))
    np.testing.assert_allclose(result, expected, rtol=1e-6)


def test_a_loop_whose_states_shrink_ends_when_nothing_is_left():
    graph = GraphBuilder()
    x = graph.input("x", np.float32, [6])
    place = graph.node("Range", *(graph.constant(np.int64(n)) for n in (0, 6, 1)), dtype=np.int64)

    def halved(turn, states):
        steps, place, left = states
        ended = place.compress(left < 1.0)
        turns = left.compress(left < 1.0) * 0.0 + turn.cast(np.float32)
        steps = steps.scatter(ended, turns)
        place, left = place.compress(left > 1.0), left.compress(left > 1.0)
        return graph.size(place) > 0, [steps, place, left * 0.5]

    steps = graph.loop_while(graph.constant(np.int64(50)), [x * 0.0 - 1.0, place, x], halved)[0]
    numbers = np.array([0.5, 3.0, 100.0, 0.9, 1.5, 5e3], dtype=np.float32)
    expected = np.maximum(np.ceil(np.log2(numbers)), 0.0)
    np.testing.assert_array_equal(run(graph, steps, x=numbers), expected)


def test_equal_constants_are_stored_once():
    graph = GraphBuilder()
    x = graph.input("x", np.float32, [1])
    graph.output((x + 2.0) * 2.0 - 2.0, "out", [1])
    assert len(graph.model().graph.initializer) == 1
