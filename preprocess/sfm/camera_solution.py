"""A solution: a camera for every frame, what each of them rests on, and its files."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from capture.atomic_files import write_text_atomically
from capture.camera import Camera
from preprocess.sfm.quality_gates import QualityGate
from preprocess.sfm.sparse_model import SparseModel

MISSING, INTERPOLATED, PLACED, KEY = range(4)
"""What a frame's camera is: none, between its neighbours', by known points, or a key frame's."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraSolution:
    """Cameras in a world of unknown size, or the news that the camera stood still.

    Attributes:
        still: Whether it did; there is nothing else then.
        moved: How far the background moved, in longer sides of the picture; NaN if it was lost.
        gates: What the solution has passed.
        model: The key frames' cameras and the points; None if it stood still.
        camera_from_solved: One for every frame of the file.
        marks: What each of them is: MISSING, INTERPOLATED, PLACED or KEY.
        keys: How many key frames there were.
        costs: Of all stages together.
    """

    still: bool
    moved: float
    gates: tuple[QualityGate, ...]
    model: SparseModel | None
    camera_from_solved: Float[np.ndarray, "frames 4 4"]
    frame_status: Int[np.ndarray, "frames"]
    keys: int
    costs: dict[str, Any]

    def lens(self, size_px: tuple[int, int]) -> Camera:
        """The lens, for pictures of the frames' size."""
        assert self.model is not None
        return self.model.camera(np.eye(4)).resize(size_px)

    def save(self, folder: Path) -> None:
        """Writes it as `solved.json`, `solved.npz` and `model.npz`."""
        if self.model is not None:
            self.model.save(folder / "model.npz")
        np.savez(
            folder / "solved.npz",
            camera_from_solved=self.camera_from_solved,
            marks=self.frame_status,
        )
        content = {
            "still": self.still, "moved": self.moved, "keys": self.keys, "costs": self.costs,
            "gates": [asdict(gate) for gate in self.gates],
        }  # fmt: skip
        write_text_atomically(
            folder / "solved.json", json.dumps(content, indent=1)
        )  # last: the rest is there

    @classmethod
    def load(cls, folder: Path) -> "CameraSolution":
        """What `save` wrote."""
        content = json.loads((folder / "solved.json").read_text(encoding="utf-8"))
        with np.load(folder / "solved.npz", allow_pickle=False) as file:
            cameras, marks = file["camera_from_solved"], file["marks"]
        gates = tuple(QualityGate(**gate) for gate in content.pop("gates"))
        model = None if content["still"] else SparseModel.load(folder / "model.npz")
        return cls(
            gates=gates, model=model, camera_from_solved=cameras, frame_status=marks, **content
        )
