"""Export: an avatar that plays without torch."""

import os

# Newer wheels of onnxruntime number the machine and record in the home folder what runs on it, for
# Microsoft, unless this is set before they are imported. An avatar is a likeness of a person.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
