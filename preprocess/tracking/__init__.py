"""Tracking of the person in a video: key points and masks by networks, poses by a fit."""

import os

# As in export/__init__.py: onnxruntime shall not record what runs here.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
