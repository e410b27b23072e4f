"""Writes the ONNX graph that computes what a TensorFlow Lite graph does.

TensorFlow Lite keeps a picture's channels last, ONNX first: tensors of four dimensions are turned
on their way in. Outputs of four dimensions stay (1, channels, rows, columns).
"""

from collections.abc import Mapping

import numpy as np
import onnx
from jaxtyping import Shaped
from onnx import TensorProto, helper, numpy_helper

from dev.tflite_model import TfliteModel, TfliteOperator

CHANNELS_FIRST = (0, 3, 1, 2)
"""Order of a tensor's dimensions for ONNX; `CHANNELS_LAST` turns it back."""
CHANNELS_LAST = (0, 2, 3, 1)
SAME_PADDING = 0
"""Value of the schema's Padding: as much as keeps the size, the odd pixel at the end."""
OPSET = 18
"""Version of ONNX's operators."""


class OnnxWriter:
    """Translates one graph, operator by operator."""

    def __init__(self, model: TfliteModel) -> None:
        """Takes the graph, which has one input: a picture."""
        self._model = model
        self._constants = dict(model.constants)
        self._nodes: list[onnx.NodeProto] = []
        self._initializers: list[onnx.TensorProto] = []
        picture = self._add("Transpose", ["image"], perm=CHANNELS_FIRST)
        self._values = {model.inputs[0]: picture}

    def write(self, output_names: Mapping[str, str]) -> onnx.ModelProto:
        """Translate the graph.

        Args:
            output_names: New name of each output, by its name in the TensorFlow Lite file.
        """
        model = self._model
        for operator in model.operators:
            self._translate(operator)
        outputs = []
        for index in model.outputs:
            name = output_names[model.names[index]]
            self._nodes.append(helper.make_node("Identity", [self._values[index]], [name]))
            shape = model.shapes[index]
            if len(shape) == 4:
                shape = [shape[axis] for axis in CHANNELS_FIRST]
            outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))
        shape = model.shapes[model.inputs[0]]
        image = helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)
        graph = helper.make_graph(self._nodes, "graph", [image], outputs, self._initializers)
        opset = helper.make_opsetid("", OPSET)
        written = helper.make_model(graph, opset_imports=[opset], ir_version=9)
        onnx.checker.check_model(written)
        return written

    def _add(self, kind: str, inputs: list[str], **attributes: object) -> str:
        """Add an operator and return the name of its output."""
        name = f"{kind.lower()}{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def _constant(self, values: Shaped[np.ndarray, "..."]) -> str:
        """Add a constant; one of 16-bit floats is stored so, and computed with in 32 bits."""
        name = f"constant{len(self._initializers)}"
        values = np.ascontiguousarray(values)
        self._initializers.append(numpy_helper.from_array(values, name))
        if values.dtype == np.float16:
            return self._add("Cast", [name], to=TensorProto.FLOAT)
        return name

    def _activated(self, value: str, activation: int) -> str:
        """A value after the schema's ActivationFunctionType."""
        if activation == 0:
            return value
        if activation == 1:
            return self._add("Relu", [value])
        if activation == 3:
            limits = [self._constant(np.float32(limit)[...]) for limit in (0, 6)]
            return self._add("Clip", [value, *limits])
        raise ValueError(f"The schema's activation {activation} is not supported.")

    def _translate(self, operator: TfliteOperator) -> None:
        first = operator.inputs[0]
        if operator.kind in ("DEQUANTIZE", "DENSIFY"):  # of weights, which `TfliteModel` fills in
            self._constants[operator.output] = self._constants[first]
            return
        translate = {
            "ADD": self._sum,
            "CONCATENATION": self._concatenation,
            "CONV_2D": self._convolution,
            "DEPTHWISE_CONV_2D": self._convolution,
            "DEPTH_TO_SPACE": self._depth_to_space,
            "LOGISTIC": lambda operator: self._add("Sigmoid", [self._values[first]]),
            "MAX_POOL_2D": self._max_pooling,
            "PAD": self._padding,
            "RESHAPE": self._reshaping,
            "RESIZE_BILINEAR": self._resizing,
        }
        self._values[operator.output] = translate[operator.kind](operator)

    def _sum(self, operator: TfliteOperator) -> str:
        values = [self._values[index] for index in operator.inputs]
        options = operator.options
        value = self._add("Add", values)
        return self._activated(value, options.FusedActivationFunction() if options else 0)

    def _concatenation(self, operator: TfliteOperator) -> str:
        axis = operator.options.Axis()
        if len(self._model.shapes[operator.output]) == 4:
            axis = CHANNELS_FIRST.index(axis)
        return self._add("Concat", [self._values[index] for index in operator.inputs], axis=axis)

    def _convolution(self, operator: TfliteOperator) -> str:
        options, (source, weights, *bias) = operator.options, operator.inputs
        kernel = self._constants[weights].transpose(0, 3, 1, 2)
        depthwise = operator.kind == "DEPTHWISE_CONV_2D"
        if depthwise:  # (1, rows, columns, channels): a kernel for each channel
            kernel = kernel.transpose(1, 0, 2, 3)
        value = self._add(
            "Conv",
            [
                self._values[source],
                self._constant(kernel),
                *(self._constant(self._constants[index]) for index in bias if index >= 0),
            ],
            group=self._model.shapes[source][3] if depthwise else 1,
            dilations=[options.DilationHFactor(), options.DilationWFactor()],
            **self._window(operator, kernel.shape[2:]),
        )
        return self._activated(value, options.FusedActivationFunction())

    def _max_pooling(self, operator: TfliteOperator) -> str:
        options = operator.options
        window = self._window(operator, (options.FilterHeight(), options.FilterWidth()))
        value = self._add("MaxPool", [self._values[operator.inputs[0]]], **window)
        return self._activated(value, options.FusedActivationFunction())

    def _window(self, operator: TfliteOperator, size: tuple[int, ...]) -> dict[str, list[int]]:
        """ONNX's attributes of a sliding window (without dilation, where it pads)."""
        options = operator.options
        strides = (options.StrideH(), options.StrideW())
        before, after = [0, 0], [0, 0]
        if options.Padding() == SAME_PADDING:
            for axis, (extent, window, stride) in enumerate(
                zip(self._model.shapes[operator.inputs[0]][1:3], size, strides, strict=True)
            ):
                missing = max(0, (-(-extent // stride) - 1) * stride + window - extent)
                before[axis], after[axis] = missing // 2, missing - missing // 2
        return {"kernel_shape": [*size], "strides": [*strides], "pads": [*before, *after]}

    def _padding(self, operator: TfliteOperator) -> str:
        source, widths = operator.inputs
        pads = self._constants[widths][list(CHANNELS_FIRST)].T.reshape(-1).astype(np.int64)
        return self._add("Pad", [self._values[source], self._constant(pads)])

    def _depth_to_space(self, operator: TfliteOperator) -> str:
        block = operator.options.BlockSize()
        source = self._values[operator.inputs[0]]
        return self._add("DepthToSpace", [source], blocksize=block, mode="DCR")

    def _reshaping(self, operator: TfliteOperator) -> str:
        source, target = operator.inputs[0], self._model.shapes[operator.output]
        value = self._values[source]
        if len(self._model.shapes[source]) == 4:
            value = self._add("Transpose", [value], perm=CHANNELS_LAST)
        value = self._add("Reshape", [value, self._constant(np.array(target, np.int64))])
        return self._add("Transpose", [value], perm=CHANNELS_FIRST) if len(target) == 4 else value

    def _resizing(self, operator: TfliteOperator) -> str:
        options, shape = operator.options, self._model.shapes[operator.output]
        size = np.array([shape[axis] for axis in CHANNELS_FIRST], np.int64)
        aligned, half_pixel = options.AlignCorners(), options.HalfPixelCenters()
        mode = "align_corners" if aligned else "half_pixel" if half_pixel else "asymmetric"
        inputs = [self._values[operator.inputs[0]], "", "", self._constant(size)]
        return self._add("Resize", inputs, mode="linear", coordinate_transformation_mode=mode)
