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
"""Status of a frame: no camera, between its neighbors, placed by known points, or a key frame."""


@dataclass(frozen=True, eq=False, kw_only=True)
class CameraSolution:
    """Cameras in a world of unknown scale, or the finding that the camera stood still.

    Attributes:
        is_static: Whether the camera stood still; then there is no model.
        background_motion: Largest shift of the background, as a fraction of the image's longer
            side; NaN if it was lost.
        gates: What the solution has passed.
        model: The key frames' cameras and the points; None if it stood still.
        camera_from_solved: One for every frame of the file.
        frame_status: What each of them is: MISSING, INTERPOLATED, PLACED or KEY.
        keyframe_count: Number of key frames.
        costs: Time and memory of all stages together.
    """

    is_static: bool
    background_motion: float
    gates: tuple[QualityGate, ...]
    model: SparseModel | None
    camera_from_solved: Float[np.ndarray, "frames 4 4"]
    frame_status: Int[np.ndarray, "frames"]
    keyframe_count: int
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
            "is_static": self.is_static, "background_motion": self.background_motion,
            "keyframe_count": self.keyframe_count, "costs": self.costs,
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
        model = None if content["is_static"] else SparseModel.load(folder / "model.npz")
        return cls(
            gates=gates, model=model, camera_from_solved=cameras, frame_status=marks, **content
        )
