"""The tracker's networks in tests: each is loaded once, and run once on each image."""

import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from preprocess.tracking.blazepose_networks import OnnxNetwork


@pytest.fixture(scope="session", autouse=True)
def networks_run_once() -> Iterator[None]:
    """The same outputs of a network for the same image, of which tests track many twice."""
    load, run, loaded = OnnxNetwork.__init__, OnnxNetwork.run, dict[Path, OnnxNetwork]()

    def load_once(network: OnnxNetwork, path: Path) -> None:
        if path not in loaded:
            load(network, path)
            loaded[path] = network
        vars(network).update(vars(loaded[path]), path=path)

    @functools.lru_cache(maxsize=500)
    def run_once(path: Path, content: bytes, size: int, low: float, high: float):
        image = np.frombuffer(content, dtype=np.uint8).reshape(size, size, 3)
        return run(loaded[path], image, low, high)

    def cached(network: OnnxNetwork, image: np.ndarray, low: float, high: float):
        outputs = run_once(network.path, image.tobytes(), len(image), low, high)
        return {name: output.copy() for name, output in outputs.items()}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OnnxNetwork, "__init__", load_once)
        patch.setattr(OnnxNetwork, "run", cached)
        yield
