"""Reads TensorFlow Lite files by the package `tflite`: their tensors, constants and operators."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int, Shaped

DTYPES = {0: "<f4", 1: "<f2", 2: "<i4", 3: "u1", 4: "<i8", 9: "i1"}
"""numpy's type of the schema's TensorType."""
OPTIONS = {
    "ADD": "AddOptions",
    "CONCATENATION": "ConcatenationOptions",
    "CONV_2D": "Conv2DOptions",
    "DEPTHWISE_CONV_2D": "DepthwiseConv2DOptions",
    "DEPTH_TO_SPACE": "DepthToSpaceOptions",
    "MAX_POOL_2D": "Pool2DOptions",
    "RESIZE_BILINEAR": "ResizeBilinearOptions",
}
"""The schema's record of an operator's options, for those whose options are read."""
SPARSE_INDICES = {1: "Int32Vector", 2: "Uint16Vector", 3: "Uint8Vector"}
"""The schema's record of a SparseIndexVector."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TfliteOperator:
    """One operator.

    Attributes:
        kind: Its name in the schema.
        inputs: Numbers of the tensors that it reads; -1 for one that is left out.
        output: Number of the tensor that it writes.
        options: The schema's record of its options; None where they are not read, or left out.
    """

    kind: str
    inputs: list[int]
    output: int
    options: Any


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
        """Read a file's content."""
        import tflite

        model = tflite.Model.GetRootAsModel(data, 0)
        graph = model.Subgraphs(0)
        tensors = [graph.Tensors(index) for index in range(graph.TensorsLength())]
        self.shapes = [tuple(np.ravel(tensor.ShapeAsNumpy()).tolist()) for tensor in tensors]
        self.names = [tensor.Name().decode() for tensor in tensors]
        self.inputs, self.outputs = graph.InputsAsNumpy().tolist(), graph.OutputsAsNumpy().tolist()
        self.constants: dict[int, Shaped[np.ndarray, ...]] = {}
        for index, tensor in enumerate(tensors):
            buffer = model.Buffers(tensor.Buffer())
            if buffer.DataLength():
                values = np.frombuffer(buffer.DataAsNumpy().tobytes(), DTYPES[tensor.Type()])
                sparsity = tensor.Sparsity()
                self.constants[index] = (
                    values.reshape(self.shapes[index])
                    if sparsity is None
                    else fill_in(values, self.shapes[index], sparsity)
                )
        self.operators = []
        for each in (graph.Operators(index) for index in range(graph.OperatorsLength())):
            code = model.OperatorCodes(each.OpcodeIndex())
            kind = tflite.opcode2name(max(code.DeprecatedBuiltinCode(), code.BuiltinCode()))
            self.operators.append(
                TfliteOperator(
                    kind=kind,
                    inputs=each.InputsAsNumpy().tolist(),
                    output=int(each.Outputs(0)),
                    options=_read_as(OPTIONS.get(kind), each.BuiltinOptions()),
                )
            )


def _read_as(record: str | None, table: Any) -> Any:
    """Return a union's table as a record of the schema."""
    if record is None or table is None:
        return None
    import tflite

    found = getattr(tflite, record)()
    found.Init(table.Bytes, table.Pos)
    return found


def fill_in(
    values: Shaped[np.ndarray, "values"], shape: tuple[int, ...], sparsity: Any
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
    order = sparsity.TraversalOrderAsNumpy()
    blocked = sparsity.BlockMapAsNumpy() if sparsity.BlockMapLength() else np.zeros(0, np.int64)
    levels = [sparsity.DimMetadata(index) for index in range(sparsity.DimMetadataLength())]
    rank = len(shape)
    nodes: Int[np.ndarray, "nodes levels"] = np.zeros((1, 0), np.int64)
    for level in levels:
        if level.Format() == 0:
            counts = np.full(len(nodes), level.DenseSize())
            indices = np.tile(np.arange(level.DenseSize()), len(nodes))
        else:
            starts = _read_as(SPARSE_INDICES[level.ArraySegmentsType()], level.ArraySegments())
            places = _read_as(SPARSE_INDICES[level.ArrayIndicesType()], level.ArrayIndices())
            counts = np.diff(starts.ValuesAsNumpy().astype(np.int64))
            indices = places.ValuesAsNumpy().astype(np.int64)
        nodes = np.concatenate([np.repeat(nodes, counts, axis=0), indices[:, None]], axis=1)
    block_size = np.ones(rank, np.int64)
    for level, dimension in zip(levels, order, strict=True):
        if dimension >= rank:
            block_size[blocked[dimension - rank]] = level.DenseSize()
    place = np.zeros((len(nodes), rank), np.int64)
    for index, dimension in zip(nodes.T, order, strict=True):
        if dimension < rank:
            place[:, dimension] += index * block_size[dimension]
        else:
            place[:, blocked[dimension - rank]] += index
    dense = np.zeros(shape, values.dtype)
    dense[tuple(place.T)] = values
    return dense
