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
