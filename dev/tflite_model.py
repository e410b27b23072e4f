"""Reads TensorFlow Lite files: their tensors, constants and operators.

A .tflite file is a FlatBuffer: tables refer to their fields by a list of offsets, and fields have
numbers, which TensorFlow's schema (tensorflow/compiler/mlir/lite/schema/schema.fbs) gives names.
"""

import struct
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int, Shaped

DTYPES = {0: "<f4", 1: "<f2", 2: "<i4", 3: "u1", 4: "<i8", 9: "i1"}
"""numpy's type of the schema's TensorType."""
OPERATORS = {
    0: "ADD",
    2: "CONCATENATION",
    3: "CONV_2D",
    4: "DEPTHWISE_CONV_2D",
    5: "DEPTH_TO_SPACE",
    6: "DEQUANTIZE",
    14: "LOGISTIC",
    17: "MAX_POOL_2D",
    22: "RESHAPE",
    23: "RESIZE_BILINEAR",
    34: "PAD",
    124: "DENSIFY",
}
"""Names of the schema's BuiltinOperator, as far as they are needed."""
SPARSE_INDICES = {1: "<i4", 2: "<u2", 3: "u1"}
"""numpy's type of the schema's SparseIndexVector."""


class FlatTable:
    """One table of a FlatBuffer; fields are counted from 0, an absent one has its default."""

    def __init__(self, data: bytes, start: int) -> None:
        """Finds the table's list of offsets.

        Args:
            data: The whole file.
            start: Where the table begins.
        """
        self._data = data
        self._start = start
        self._offsets = start - struct.unpack_from("<i", data, start)[0]
        self._offsets_end = self._offsets + struct.unpack_from("<H", data, self._offsets)[0]

    @classmethod
    def root(cls, data: bytes) -> "FlatTable":
        """The table at the root of a file."""
        return cls(data, struct.unpack_from("<I", data, 0)[0])

    def _place(self, field: int) -> int | None:
        entry = self._offsets + 4 + 2 * field
        if entry >= self._offsets_end:
            return None
        offset = struct.unpack_from("<H", self._data, entry)[0]
        return self._start + offset if offset else None

    def _target(self, place: int) -> int:
        return place + struct.unpack_from("<I", self._data, place)[0]

    def number(self, field: int, form: str = "<i", default: int = 0) -> int:
        """A number; `form` is that of the module `struct`."""
        place = self._place(field)
        return default if place is None else struct.unpack_from(form, self._data, place)[0]

    def table(self, field: int) -> "FlatTable | None":
        """A table, or a union's; None if it is absent."""
        place = self._place(field)
        return None if place is None else FlatTable(self._data, self._target(place))

    def tables(self, field: int) -> list["FlatTable"]:
        """A list of tables."""
        place = self._place(field)
        if place is None:
            return []
        start = self._target(place)
        count = struct.unpack_from("<I", self._data, start)[0]
        places = range(start + 4, start + 4 + 4 * count, 4)
        return [FlatTable(self._data, self._target(place)) for place in places]

    def array(self, field: int, dtype: str = "<i4") -> Shaped[np.ndarray, "..."]:
        """A list of numbers."""
        place = self._place(field)
        if place is None:
            return np.zeros(0, dtype)
        start = self._target(place)
        count = struct.unpack_from("<I", self._data, start)[0]
        return np.frombuffer(self._data, dtype, count, start + 4)

    def text(self, field: int) -> str:
        """A string."""
        return self.array(field, "u1").tobytes().decode()


@dataclass(frozen=True, eq=False, kw_only=True)
class TfliteOperator:
    """One operator.

    Attributes:
        kind: Its name in the schema.
        inputs: Numbers of the tensors that it reads; -1 for one that is left out.
        output: Number of the tensor that it writes.
        options: Its options' table.
    """

    kind: str
    inputs: list[int]
    output: int
    options: FlatTable | None


class TfliteModel:
    """The one graph of a .tflite file.

    Attributes:
        shapes: Shape of each tensor.
        names: Name of each tensor.
        constants: Values of constant tensors, by the tensor's number; sparse ones are filled in.
        operators: In the order in which they run.
        inputs, outputs: Numbers of the graph's own inputs and outputs.
    """

    def __init__(self, data: bytes) -> None:
        """Reads a file's content.

        Raises:
            ValueError: If it has an operator that is not known here.
        """
        model = FlatTable.root(data)
        (graph,), buffers = model.tables(2), model.tables(4)
        tensors = graph.tables(0)
        self.shapes = [tuple(int(size) for size in tensor.array(0)) for tensor in tensors]
        self.names = [tensor.text(3) for tensor in tensors]
        self.inputs, self.outputs = graph.array(1).tolist(), graph.array(2).tolist()
        self.constants: dict[int, Shaped[np.ndarray, ...]] = {}
        for index, tensor in enumerate(tensors):
            raw = buffers[tensor.number(2, "<I")].array(0, "u1")
            if len(raw):
                values = np.frombuffer(raw.tobytes(), DTYPES[tensor.number(1, "<b")])
                sparsity = tensor.table(6)
                self.constants[index] = (
                    values.reshape(self.shapes[index])
                    if sparsity is None
                    else fill_in(values, self.shapes[index], sparsity)
                )
        codes = [max(code.number(0, "<b"), code.number(3)) for code in model.tables(1)]
        if unknown := set(codes) - set(OPERATORS):
            raise ValueError(f"Operators {sorted(unknown)} of the schema are not supported.")
        self.operators = [
            TfliteOperator(
                kind=OPERATORS[codes[each.number(0, "<I")]],
                inputs=each.array(1).tolist(),
                output=int(each.array(2)[0]),
                options=each.table(4),
            )
            for each in graph.tables(3)
        ]


def fill_in(
    values: Shaped[np.ndarray, "values"], shape: tuple[int, ...], sparsity: FlatTable
) -> Shaped[np.ndarray, "..."]:
    """Make the dense tensor of a sparse one.

    A sparse tensor is a tree with one level for each dimension, and one more for each dimension
    that is cut into blocks. A level is dense (each of its indices) or compressed (a list for each
    node of the level above); the leaves have the values, in this order.

    Args:
        values: The values that are stored; all others are 0.
        shape: The tensor's.
        sparsity: The schema's SparsityParameters.
    """
    order, blocked, levels = sparsity.array(0), sparsity.array(1), sparsity.tables(2)
    rank = len(shape)
    nodes: Int[np.ndarray, "nodes levels"] = np.zeros((1, 0), np.int64)
    for level in levels:
        if level.number(0, "<b") == 0:
            counts = np.full(len(nodes), level.number(1))
            indices = np.tile(np.arange(level.number(1)), len(nodes))
        else:
            counts, indices = np.diff(compressed(level, 2)), compressed(level, 4)
        nodes = np.concatenate([np.repeat(nodes, counts, axis=0), indices[:, None]], axis=1)
    block_size = np.ones(rank, np.int64)
    for level, dimension in zip(levels, order, strict=True):
        if dimension >= rank:
            block_size[blocked[dimension - rank]] = level.number(1)
    place = np.zeros((len(nodes), rank), np.int64)
    for index, dimension in zip(nodes.T, order, strict=True):
        if dimension < rank:
            place[:, dimension] += index * block_size[dimension]
        else:
            place[:, blocked[dimension - rank]] += index
    dense = np.zeros(shape, values.dtype)
    dense[tuple(place.T)] = values
    return dense


def compressed(level: FlatTable, field: int) -> Int[np.ndarray, "numbers"]:
    """One list of a compressed level: its type is in `field`, its numbers are in the next one."""
    numbers = level.table(field + 1)
    assert numbers is not None
    return numbers.array(0, SPARSE_INDICES[level.number(field, "<B")]).astype(np.int64)
