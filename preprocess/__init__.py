"""Preprocess: what is known about each frame, as a mask, a body pose and a camera."""

import os

# As in export/__init__.py: onnxruntime shall not record what runs here. It reads this on import.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
