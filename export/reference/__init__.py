"""The player in numpy: the reference of the ONNX graph."""
