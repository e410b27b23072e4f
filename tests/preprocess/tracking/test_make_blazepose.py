"""Tests of `dev/make_blazepose.py` and of what it converts with, on a small file made here."""

import hashlib
import struct

import numpy as np
import onnxruntime
import pytest

from dev.make_blazepose import NETWORKS, WEIGHTS, verified
from dev.onnx_from_tflite import OnnxWriter
from dev.tflite_model import FlatTable, TfliteModel, fill_in

FLOAT, HALF, INT = 0, 1, 2
"""The schema's TensorType."""
CONV, DEQUANTIZE, RESHAPE = 3, 6, 22
"""The schema's BuiltinOperator."""


def byte(value):
    return struct.pack("<b", value)


def integer(value):
    return struct.pack("<i", value)


def write_table(fields):
    """A FlatBuffer table and where in its bytes it begins; what it refers to lies behind it.

    Args:
        fields: By number: packed bytes, a dict (a table), a list of dicts, or an array.
    """
    body, places = bytearray(4), {}
    for number, value in fields.items():
        places[number] = len(body)
        body += value if isinstance(value, bytes) else bytes(4)
    start = 4 + 2 * (max(fields, default=-1) + 1)
    offsets = [places.get(number, 0) for number in range((start - 4) // 2)]
    data = bytearray(struct.pack(f"<HH{len(offsets)}H", start, len(body), *offsets) + body)
    data[start : start + 4] = integer(start)

    def refer(place, blob, begin):
        data[place : place + 4] = struct.pack("<I", len(data) + begin - place)
        data.extend(blob)

    for number, value in fields.items():
        place = start + places[number]
        if isinstance(value, dict):
            refer(place, *write_table(value))
        elif isinstance(value, np.ndarray):
            refer(place, integer(len(value)) + value.tobytes(), 0)
        elif isinstance(value, list):
            first = len(data) + 4
            refer(place, integer(len(value)) + bytes(4 * len(value)), 0)
            for row, entry in enumerate(value):
                refer(first + 4 * row, *write_table(entry))
    return bytes(data), start


def write_file(root):
    data, start = write_table(root)
    return struct.pack("<I", start + 4) + data


def text(value):
    return np.frombuffer(value.encode(), np.uint8)


def tensor(name, shape, dtype=FLOAT, buffer=0):
    return {
        0: np.array(shape, np.int32),
        1: byte(dtype),
        2: struct.pack("<I", buffer),
        3: text(name),
    }


def operator(code, inputs, output, options=None):
    fields = {
        0: struct.pack("<I", code),
        1: np.array(inputs, np.int32),
        2: np.array([output], np.int32),
    }
    return fields if options is None else {**fields, 4: options}


@pytest.fixture
def weights(rng):
    return rng.normal(size=(3, 3, 3, 2)).astype(np.float16), rng.normal(size=3).astype(np.float32)


@pytest.fixture
def small_file(weights):
    """A picture of 4 x 6 pixels, a convolution with a stride of 2, ReLU6, and a flat output."""
    tensors = [
        tensor("picture", (1, 4, 6, 2)),
        tensor("half", (3, 3, 3, 2), HALF, 1),
        tensor("kernel", (3, 3, 3, 2)),
        tensor("bias", (3,), FLOAT, 2),
        tensor("features", (1, 2, 3, 3)),
        tensor("shape", (2,), INT, 3),
        tensor("Identity", (1, 18)),
    ]
    stride_2_relu6 = {0: byte(0), 1: integer(2), 2: integer(2), 3: byte(3)}
    graph = {
        0: tensors,
        1: np.array([0], np.int32),
        2: np.array([4, 6], np.int32),
        3: [
            operator(0, [1], 2),
            operator(1, [0, 2, 3], 4, stride_2_relu6),
            operator(2, [4, 5], 6),
        ],
    }
    shape = np.array([1, 18], np.int32).view(np.uint8)
    values = [np.zeros(0, np.uint8), *(each.reshape(-1).view(np.uint8) for each in weights), shape]
    codes = [{0: byte(code), 3: integer(code)} for code in (DEQUANTIZE, CONV, RESHAPE)]
    return write_file({1: codes, 2: [graph], 4: [{0: each} for each in values]})


def convolved(picture, kernel, bias):
    """What TensorFlow Lite computes: "same" padding, here one pixel after the last."""
    padded = np.pad(picture, ((0, 1), (0, 1), (0, 0)))
    out = np.empty((2, 3, 3))
    for row, column in np.ndindex(2, 3):
        window = padded[2 * row : 2 * row + 3, 2 * column : 2 * column + 3]
        out[row, column] = np.einsum("abi,oabi->o", window, kernel.astype(float)) + bias
    return np.clip(out, 0, 6)


def test_a_converted_network_computes_what_the_file_says(small_file, weights, rng):
    model = TfliteModel(small_file)
    assert [each.kind for each in model.operators] == ["DEQUANTIZE", "CONV_2D", "RESHAPE"]
    written = OnnxWriter(model).write({"features": "maps", "Identity": "flat"})
    session = onnxruntime.InferenceSession(
        written.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    picture = rng.normal(size=(1, 4, 6, 2)).astype(np.float32)
    maps, flat = session.run(["maps", "flat"], {"image": picture})
    expected = convolved(picture[0], *weights)
    np.testing.assert_allclose(maps[0].transpose(1, 2, 0), expected, atol=1e-5)
    np.testing.assert_allclose(flat[0], expected.ravel(), atol=1e-5)
    assert 0 < (expected == 0).mean() < 1


def test_an_operator_that_is_not_known_is_refused():
    graph = {0: [tensor("picture", (1, 4, 6, 2))]}
    with pytest.raises(ValueError, match=r"\[99\] of the schema are not supported"):
        TfliteModel(write_file({1: [{0: byte(99)}], 2: [graph], 4: [{}]}))


def test_a_sparse_tensor_is_filled_in():
    """Three rows of four numbers, whose columns come in blocks of two; half of them are stored."""
    dense = {0: byte(0)}
    segments, indices = np.array([0, 1, 1, 3], np.uint8), np.array([1, 0, 1], np.uint8)
    columns = {
        0: byte(1),
        2: byte(3),
        3: {0: segments},
        4: byte(3),
        5: {0: indices},
    }
    sparsity = {
        0: np.array([0, 1, 2], np.int32),
        1: np.array([1], np.int32),
        2: [{**dense, 1: integer(3)}, columns, {**dense, 1: integer(2)}],
    }
    filled = fill_in(np.arange(1, 7), (3, 4), FlatTable.root(write_file(sparsity)))
    np.testing.assert_array_equal(filled, [[0, 0, 1, 2], [0, 0, 0, 0], [3, 4, 5, 6]])


@pytest.mark.parametrize("name", ["blazepose_detector", "blazepose_landmarks_full"])
def test_the_networks_here_are_the_ones_that_the_script_makes(name):
    data = (WEIGHTS / f"{name}.onnx").read_bytes()
    assert hashlib.sha256(data).hexdigest() == NETWORKS[name].sha256


def test_other_data_are_refused():
    with pytest.raises(SystemExit, match="model: SHA-256 is"):
        verified(b"other", "0" * 64, "model")
