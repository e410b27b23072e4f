"""Networks as ONNX files, run by onnxruntime."""

from pathlib import Path

import numpy as np
import onnxruntime
from jaxtyping import Float, Float32, UInt8

WEIGHTS = Path(__file__).parent / "weights"
"""Folder of this project's own networks."""


class OnnxNetwork:
    """A network that takes one picture.

    Attributes:
        picture_size: Width and height of the picture, pixels.
    """

    def __init__(self, path: Path) -> None:
        """Loads the network; it computes on one thread, which costs least per picture."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        self._session = onnxruntime.InferenceSession(
            str(path), options, providers=["CPUExecutionProvider"]
        )
        (image,) = self._session.get_inputs()
        self._image = image.name
        self._outputs = [output.name for output in self._session.get_outputs()]
        self.picture_size = int(image.shape[1])

    def run(
        self, picture: UInt8[np.ndarray, "size size 3"], low: float, high: float
    ) -> dict[str, Float32[np.ndarray, "..."]]:
        """Run the network on one picture, whose values are spread from `low` to `high`.

        Returns:
            The outputs by their names, without the dimension of pictures.
        """
        values = picture.astype(np.float32)
        values *= np.float32((high - low) / 255)
        if low:
            values += np.float32(low)
        outputs = self._session.run(None, {self._image: values[None]})
        return {
            name: np.asarray(output)[0] for name, output in zip(self._outputs, outputs, strict=True)
        }


def sigmoid(values: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The logistic function."""
    return 1 / (1 + np.exp(-np.clip(values, -50, 50)))
