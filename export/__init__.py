"""Export: an avatar that plays without torch."""

import os

# Newer wheels of onnxruntime number the machine and keep a record for Microsoft of what runs on it,
# in the home folder, unless this is said before they are imported. An avatar is a difference.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
