"""Preprocess: the mask, the body pose and the camera of each frame."""

import os

# As in export/__init__.py: onnxruntime shall not record what runs here. It reads this on import.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
