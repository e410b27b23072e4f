"""A small writer of ONNX graphs: Python's operators become nodes."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, final

import numpy as np
import onnx
from jaxtyping import Shaped
from onnx import TensorProto, helper, numpy_helper

ONNX_OPSET = 18
"""Operator set, which onnxruntime 1.24 and onnxruntime-web run."""
ONNX_IR_VERSION = 9
"""Version of the file format of that operator set."""
ONNX_TYPES = {
    np.dtype(np.float32): TensorProto.FLOAT,
    np.dtype(np.int32): TensorProto.INT32,
    np.dtype(np.int64): TensorProto.INT64,
    np.dtype(np.uint32): TensorProto.UINT32,
    np.dtype(np.uint8): TensorProto.UINT8,
    np.dtype(np.int8): TensorProto.INT8,
    np.dtype(np.bool_): TensorProto.BOOL,
}
"""ONNX's name of each element type."""


def _operator(kind: str, dtype: Any = None, **attributes: Any) -> Callable[..., "GraphValue"]:
    """Return a method that adds a node of ONNX's operator `kind` to a value and its operands.

    The result has the element type `dtype`; None for that of the value.
    """

    def add_node(self: "GraphValue", *others: "Operand") -> "GraphValue":
        operands = [self.graph.value(other, self.dtype) for other in others]
        return self.graph.node(kind, self, *operands, dtype=dtype or self.dtype, **attributes)

    return add_node


@final
class GraphValue:
    """A tensor of the graph: known by its name and element type, computed when the graph runs.

    Arithmetic between values, or between a value and a number, adds a node. A plain number takes
    the element type of the value it is combined with.
    """

    def __init__(self, graph: "GraphBuilder", name: str, dtype: np.dtype) -> None:
        """Wrap an output of a graph; called by `GraphBuilder`."""
        self.graph, self.name, self.dtype = graph, name, np.dtype(dtype)

    __add__ = __radd__ = _operator("Add")
    __sub__ = _operator("Sub")
    __mul__ = __rmul__ = _operator("Mul")
    __truediv__ = _operator("Div")
    __neg__ = _operator("Neg")
    __lt__ = _operator("Less", np.bool_)
    __gt__ = _operator("Greater", np.bool_)
    __and__ = _operator("And")  # of truth values, as `|` is
    __or__ = _operator("Or")
    equal = _operator("Equal", np.bool_)
    logical_not = _operator("Not")
    bitwise_and = _operator("BitwiseAnd")
    floor = _operator("Floor")
    exp = _operator("Exp")
    sqrt = _operator("Sqrt")
    reciprocal = _operator("Reciprocal")
    minimum = _operator("Min")
    maximum = _operator("Max")
    clip = _operator("Clip")
    reduce_min = _operator("ReduceMin", keepdims=0)  # a scalar
    reduce_max = _operator("ReduceMax", keepdims=0)
    matmul = _operator("MatMul")
    gather = _operator("GatherElements", axis=0)  # x[places] in 1D: 5 times as fast as "Gather"
    gather_rows = _operator("Gather", axis=0)  # x[rows] of more than one dimension
    gather_columns = _operator("GatherElements", axis=1)  # x[i, places[i]]: see `repeat_rows`
    compress = _operator("Compress", axis=0)  # x[condition] in 1D
    compress_columns = _operator("Compress", axis=1)  # x[:, condition]

    def __rsub__(self, other: "Operand") -> "GraphValue":
        """Difference."""
        return self.graph.value(other, self.dtype) - self

    def __rtruediv__(self, other: "Operand") -> "GraphValue":
        """Quotient of floats."""
        return self.graph.value(other, self.dtype) / self

    def __floordiv__(self, other: "Operand") -> "GraphValue":
        """Quotient of integers that are not negative (ONNX rounds towards zero)."""
        assert self.dtype.kind in "iu"
        return self / other

    def shift_right(self, bits: int) -> "GraphValue":
        """Bits shifted right, zeros shifted in (ONNX shifts unsigned integers only)."""
        unsigned = self.cast(np.uint32)
        by = self.graph.value(bits, unsigned.dtype)
        return self.graph.node("BitShift", unsigned, by, direction="RIGHT")

    def cast(self, dtype: Any) -> "GraphValue":
        """Cast to another element type; floats are truncated."""
        return self.graph.node("Cast", self, dtype=dtype, to=ONNX_TYPES[np.dtype(dtype)])

    def exp2(self) -> "GraphValue":
        """Two to the power of it."""
        return self.graph.node("Pow", self.graph.value(2.0, self.dtype), self)

    def reduce_sum(self, axis: int) -> "GraphValue":
        """The sum along one axis, which goes away."""
        along = self.graph.constant(np.array([axis], dtype=np.int64))
        return self.graph.node("ReduceSum", self, along, keepdims=0)

    def weighted_sum(self, weights: Shaped[np.ndarray, "rows"]) -> "GraphValue":
        """The sum of the rows times their weights (of floats; a matrix product is fastest)."""
        return self.graph.constant(weights.astype(self.dtype)).matmul(self)

    def row(self, index: int) -> "GraphValue":
        """`self[index]`."""
        return self.gather_rows(self.graph.constant(np.int64(index)))

    def take(self, indices: Sequence[int], axis: int = 0) -> "GraphValue":
        """`self[indices]`, or along another axis."""
        places = self.graph.constant(np.array(indices, dtype=np.int64))
        return self.graph.node("Gather", self, places, axis=axis)

    def repeat_rows(self, rows: int) -> "GraphValue":
        """A 1D value as each of `rows` rows; as places, one column for all rows of a matrix."""
        return self.graph.node("Expand", self, self.graph.shape(rows, 1))

    def transpose(self, *order: int) -> "GraphValue":
        """Axes in another order."""
        return self.graph.node("Transpose", self, perm=list(order))

    def reshape(self, *shape: "Operand") -> "GraphValue":
        """Another shape; sizes may be values, and one may be -1."""
        return self.graph.node("Reshape", self, self.graph.shape(*shape))

    def slice_axes(self, starts: "Sequence[Operand]", ends: "Sequence[Operand]") -> "GraphValue":
        """`self[starts[0]:ends[0], …]` over the leading axes."""
        bounds = self.graph.shape(*starts), self.graph.shape(*ends)
        axes = self.graph.constant(np.arange(len(starts), dtype=np.int64))
        return self.graph.node("Slice", self, *bounds, axes)

    def scatter(
        self, places: "GraphValue", updates: "GraphValue", reduction: str = "none", axis: int = 0
    ) -> "GraphValue":
        """A copy with `updates` written (or reduced) into `places` along an axis."""
        operands = (self, places, updates)
        return self.graph.node("ScatterElements", *operands, axis=axis, reduction=reduction)


@final
class GraphBuilder:
    """An ONNX graph being written."""

    def __init__(self) -> None:
        """An empty graph."""
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], GraphValue] = {}
        self._initializers: list[onnx.TensorProto] = []
        self._inputs: list[onnx.ValueInfoProto] = []
        self._outputs: list[onnx.ValueInfoProto] = []
        self._count = 0

    def input(self, name: str, dtype: Any, shape: Sequence[int]) -> GraphValue:
        """An input of the graph."""
        kind = ONNX_TYPES[np.dtype(dtype)]
        self._inputs.append(helper.make_tensor_value_info(name, kind, list(shape)))
        return GraphValue(self, name, np.dtype(dtype))

    def output(self, value: GraphValue, name: str, shape: Sequence[int | str]) -> None:
        """An output of the graph; named sizes are known only when it runs."""
        self._nodes.append(helper.make_node("Identity", [value.name], [name]))
        kind = ONNX_TYPES[value.dtype]
        self._outputs.append(helper.make_tensor_value_info(name, kind, list(shape)))

    def table(self, name: str, array: Shaped[np.ndarray, "..."]) -> GraphValue:
        """Add a named external initializer, a "file" of its own name."""
        tensor = TensorProto(name=name, data_type=ONNX_TYPES[array.dtype], dims=array.shape)
        tensor.data_location = TensorProto.EXTERNAL
        for key, value in (("location", name), ("offset", 0), ("length", array.nbytes)):
            tensor.external_data.add(key=key, value=str(value))
        self._initializers.append(tensor)
        return GraphValue(self, name, array.dtype)

    def constant(self, array: Any) -> GraphValue:
        """Add a small initializer inside the graph; store equal ones once."""
        array = np.asarray(array)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._constants:
            name = f"constant_{len(self._constants)}"
            self._initializers.append(numpy_helper.from_array(array, name))
            self._constants[key] = GraphValue(self, name, array.dtype)
        return self._constants[key]

    def value(self, operand: "Operand", dtype: Any) -> GraphValue:
        """The operand itself if it is a value, else a constant of that element type."""
        if isinstance(operand, GraphValue):
            return operand
        return self.constant(np.asarray(operand, dtype=dtype))

    def shape(self, *sizes: "Operand") -> GraphValue:
        """A list of sizes, some of them known only when the graph runs (int64 scalars)."""
        if not any(isinstance(size, GraphValue) for size in sizes):
            return self.constant(np.array(sizes, dtype=np.int64))
        whole = self.constant(np.array([1], dtype=np.int64))
        lists = [self.node("Reshape", self.value(size, np.int64), whole) for size in sizes]
        return self.concatenate(lists)

    def node(
        self, kind: str, *operands: GraphValue, dtype: Any = None, **attributes: Any
    ) -> GraphValue:
        """One node with one output, of the first operand's element type unless said otherwise."""
        self._count += 1
        name = f"{kind.lower()}_{self._count}"
        inputs = [operand.name for operand in operands]
        self._nodes.append(helper.make_node(kind, inputs, [name], name=name, **attributes))
        return GraphValue(self, name, np.dtype(dtype or operands[0].dtype))

    def where(self, condition: GraphValue, yes: "Operand", no: "Operand") -> GraphValue:
        """`yes` where the condition holds, else `no`; at least one of them is a value."""
        known = yes if isinstance(yes, GraphValue) else no
        assert isinstance(known, GraphValue)
        yes, no = self.value(yes, known.dtype), self.value(no, known.dtype)
        return self.node("Where", condition, yes, no, dtype=known.dtype)

    def range(self, count: GraphValue) -> GraphValue:
        """0, 1, … count − 1, of the count's type; the count is a scalar."""
        limits = [self.value(limit, count.dtype) for limit in (0, 1)]
        return self.node("Range", limits[0], count, limits[1])

    def size(self, value: GraphValue) -> GraphValue:
        """Number of elements of a value, int64 scalar."""
        return self.node("Size", value, dtype=np.int64)

    def concatenate(self, values: Sequence[GraphValue], axis: int = 0) -> GraphValue:
        """Values one after the other."""
        return self.node("Concat", *values, axis=axis)

    def full(self, shape: GraphValue, number: Any) -> GraphValue:
        """A tensor that holds one number (numpy scalar) everywhere."""
        number = np.asarray(number).reshape(1)
        fill = numpy_helper.from_array(number)
        return self.node("ConstantOfShape", shape, dtype=number.dtype, value=fill)

    def loop(
        self,
        count: GraphValue,
        states: Sequence[GraphValue],
        body: Callable[[GraphValue, list[GraphValue]], Sequence[GraphValue]],
    ) -> list[GraphValue]:
        """`for i in range(count): states = body(i, states)`; the body may use any outer value."""

        return self.loop_while(count, states, lambda turn, held: (None, list(body(turn, held))))

    def loop_while(
        self,
        max_turns: GraphValue,
        states: Sequence[GraphValue],
        body: Callable[[GraphValue, list[GraphValue]], tuple[GraphValue | None, list[GraphValue]]],
    ) -> list[GraphValue]:
        """`for i in range(max_turns): go, states = body(i, states)` while `go` holds.

        The states' lengths may change from turn to turn; None for `go` holds always.
        """
        self._count += 1
        prefix = f"loop_{self._count}"
        before, self._nodes = self._nodes, []
        go = GraphValue(self, f"{prefix}_go", np.dtype(np.bool_))
        turn = GraphValue(self, f"{prefix}_turn", np.dtype(np.int64))
        held = [GraphValue(self, f"{prefix}_state_{i}", s.dtype) for i, s in enumerate(states)]
        more, after = body(turn, held)
        results = [self.node("Identity", go if more is None else more), *after]
        # states of no rank: for a known one onnxruntime plans reuse, a search quadratic in nodes
        inner = helper.make_graph(
            self._nodes,
            prefix,
            [_value_info(turn, []), _value_info(go, []), *(_value_info(v, None) for v in held)],
            [_value_info(results[0], []), *(_value_info(v, None) for v in results[1:])],
        )
        self._nodes = before
        outputs = [GraphValue(self, f"{prefix}_result_{i}", s.dtype) for i, s in enumerate(states)]
        inputs = [max_turns.name, self.constant(np.array(True)).name, *(s.name for s in states)]
        names = [output.name for output in outputs]
        self._nodes.append(helper.make_node("Loop", inputs, names, name=prefix, body=inner))
        return outputs

    def stack(self, rows: Sequence[GraphValue]) -> GraphValue:
        """1D values as the rows of a matrix."""
        return self.concatenate([row.reshape(1, -1) for row in rows])

    def split(self, value: GraphValue, parts: int, axis: int = 0) -> list[GraphValue]:
        """Split along an axis of length `parts`, which stays, of length 1."""
        return self._split([value], parts, axis=axis, num_outputs=parts)

    def halve_columns(self, value: GraphValue, width: GraphValue) -> list[GraphValue]:
        """Split a matrix of 2 × `width` columns, an int64 scalar, which may be 0."""
        both = width * self.constant(np.ones(2, dtype=np.int64))
        return self._split([value, both], 2, axis=1)

    def _split(
        self, operands: Sequence[GraphValue], parts: int, **attributes: Any
    ) -> list[GraphValue]:
        self._count += 1
        names = [f"split_{self._count}_{i}" for i in range(parts)]
        inputs = [operand.name for operand in operands]
        self._nodes.append(helper.make_node("Split", inputs, names, **attributes))
        return [GraphValue(self, name, operands[0].dtype) for name in names]

    def model(self) -> onnx.ModelProto:
        """Return the model; the tables that it uses are passed to the runtime separately."""
        used = _names_used(self._nodes)
        initializers = [tensor for tensor in self._initializers if tensor.name in used]
        return helper.make_model(
            helper.make_graph(self._nodes, "avatar", self._inputs, self._outputs, initializers),
            opset_imports=[helper.make_opsetid("", ONNX_OPSET)],
            ir_version=ONNX_IR_VERSION,
        )


def _names_used(nodes: Iterable[onnx.NodeProto]) -> set[str]:
    """Names of all inputs of nodes, and of those in their bodies."""
    used = {name for node in nodes for name in node.input}
    bodies = (part.g.node for node in nodes for part in node.attribute)
    return used.union(*(_names_used(body) for body in bodies))


def _value_info(value: GraphValue, shape: Sequence[int] | None) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(value.name, ONNX_TYPES[value.dtype], shape)


Operand = GraphValue | float | int | np.generic | np.ndarray
"""Another value, or a number, that a value is combined with."""
