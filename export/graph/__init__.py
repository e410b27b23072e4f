"""The ONNX graph that draws a package."""
