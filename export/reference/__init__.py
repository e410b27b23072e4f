"""The player written plainly: what the ONNX graph must agree with."""
