"""The graph that `ia-play --bench` times beside the player.

python tests/instant_avatar/animation/test_player_timing.py        # writes it again
"""

import onnx
from onnx import TensorProto, helper

from instant_avatar.animation.player_checks import REFERENCE_GRAPH


def reference_model() -> onnx.ModelProto:
    """GatherElements, MatMul and ScatterElements of fixed sizes."""
    nodes = [
        helper.make_node("GatherElements", ["table", "places"], ["taken"], axis=0),
        helper.make_node("MatMul", ["taken", "matrix"], ["product"]),
        helper.make_node(
            "ScatterElements", ["table", "places", "product"], ["out"], axis=0, reduction="min"
        ),
    ]
    shapes = {"table": [1 << 15, 16], "matrix": [16, 16]}
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in shapes.items()]
    inputs.append(helper.make_tensor_value_info("places", TensorProto.INT64, [1 << 15, 16]))
    outputs = [helper.make_tensor_value_info("out", TensorProto.FLOAT, [1 << 15, 16])]
    graph = helper.make_graph(nodes, "reference", inputs, outputs)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


def test_the_stored_graph_is_the_one_described_here():
    assert onnx.load(REFERENCE_GRAPH) == reference_model()


if __name__ == "__main__":
    REFERENCE_GRAPH.write_bytes(reference_model().SerializeToString())
