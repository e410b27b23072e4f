import numpy as np
import onnxruntime
import pytest

from export.graph.onnx_builder import GraphBuilder


def run(graph, value, **inputs):
    graph.output(value, "out", ["n"])
    session = onnxruntime.InferenceSession(
        graph.model().SerializeToString(), providers=["CPUExecutionProvider"]
    )
    return session.run(None, inputs)[0]


@pytest.mark.parametrize(
    "formula",
    [
        lambda x: 2.0 * x + 1.0 - x * x,
        lambda x: 3.0 - x / 4.0,
        lambda x: 1.0 / x,
        lambda x: -x * (x - 0.5),
    ],
)
def test_an_expression_means_the_same_in_numpy_and_in_a_graph(formula):
    x = np.random.default_rng(0).normal(size=50).astype(np.float32)
    graph = GraphBuilder()
    result = run(graph, formula(graph.input("x", np.float32, [50])), x=x)
    np.testing.assert_allclose(result, formula(x), rtol=1e-6)


def test_a_number_takes_the_type_of_the_value_beside_it():
    graph = GraphBuilder()
    x = graph.input("x", np.int32, [3])
    result = run(graph, (x * 5 + 1) // 2, x=np.array([0, 1, 7], dtype=np.int32))
    assert result.dtype == np.int32
    assert result.tolist() == [0, 3, 18]


def test_bits_are_masked_and_shifted_without_a_sign():
    graph = GraphBuilder()
    x = graph.input("x", np.int32, [2])
    numbers = np.array([-1, 0x12345678], dtype=np.int32)
    assert run(graph, x.shift_right(16), x=numbers).tolist() == [0xFFFF, 0x1234]
    graph = GraphBuilder()
    x = graph.input("x", np.int32, [2])
    assert run(graph, x.bitwise_and(0xFFFF), x=numbers).tolist() == [0xFFFF, 0x5678]


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


def test_what_a_condition_chooses_is_what_numpy_chooses():
    graph = GraphBuilder()
    x = graph.input("x", np.float32, [40])
    numbers = np.random.default_rng(1).normal(size=40).astype(np.float32)
    result = run(graph, graph.range(graph.size(x).cast(np.int32)).compress(x > 0.3), x=numbers)
    assert result.dtype == np.int32
    np.testing.assert_array_equal(result, np.flatnonzero(numbers > 0.3))


def test_pieces_of_a_split_make_up_its_sum_again():
    graph = GraphBuilder()
    x = graph.input("x", np.float32, [3, 5])
    a, b, c = graph.split(x, 3)
    numbers = np.random.default_rng(2).normal(size=(3, 5)).astype(np.float32)
    result = run(graph, (a + b + c).reshape(-1) - x.reduce_sum(0), x=numbers)
    np.testing.assert_allclose(result, np.zeros(5), atol=1e-6)


def test_smallest_and_largest_are_scalars():
    graph = GraphBuilder()
    x = graph.input("x", np.float32, [4])
    result = run(
        graph, x.reduce_max() - x.reduce_min(), x=np.array([3, -2, 5, 1], dtype=np.float32)
    )
    assert result.shape == ()
    assert result == 7.0


def test_columns_are_chosen_for_all_rows_and_weighed():
    graph = GraphBuilder()
    x = graph.input("x", np.float32, [3, 5])
    places = graph.input("places", np.int32, [2])
    numbers = np.random.default_rng(3).normal(size=(3, 5)).astype(np.float32)
    chosen = np.array([4, 1], dtype=np.int32)
    turned = x.gather_columns(places.repeat_rows(3)).take((1, 2, 0))
    result = run(graph, turned.weighted_sum(np.array([1.0, -2.0, 0.5])), x=numbers, places=chosen)
    some = numbers[:, chosen]
    np.testing.assert_allclose(result, some[1] - 2.0 * some[2] + 0.5 * some[0], atol=1e-6)
