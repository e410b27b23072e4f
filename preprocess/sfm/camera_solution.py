"""A solution: a camera for every frame, the model that each rests on, its gates, and its files."""

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from capture.atomic_files import write_text_atomically
from capture.camera import Camera


@dataclass(frozen=True, eq=False, kw_only=True)
class SparseModel:
    """What structure from motion found.

    Attributes:
        frames: Number of the frame that each camera belongs to, ascending.
        camera_from_world: Rigid transforms; the world's unit is unknown.
        focal_px: Focal length.
        center_px: Principal point; the first pixel's centre is at (0.5, 0.5).
        radial_distortion: First coefficient of radial distortion.
        size_px: Width and height of the pictures.
        points: What the cameras see.
        observation_camera, observation_point: Rows of each observation's camera and point.
        pixels: Where it was seen.
    """

    frames: Int[np.ndarray, "cameras"]
    camera_from_world: Float[np.ndarray, "cameras 4 4"]
    focal_px: float
    center_px: tuple[float, float]
    radial_distortion: float
    size_px: tuple[int, int]
    points: Float[np.ndarray, "points 3"]
    observation_camera: Int[np.ndarray, "observations"]
    observation_point: Int[np.ndarray, "observations"]
    pixels: Float[np.ndarray, "observations 2"]

    def camera(self, camera_from_world: Float[np.ndarray, "4 4"]) -> Camera:
        """The lens, standing somewhere."""
        return Camera(
            focal_px=(self.focal_px, self.focal_px),
            center_px=self.center_px,
            size_px=self.size_px,
            camera_from_world=camera_from_world,
            distortion=(self.radial_distortion, 0.0, 0.0, 0.0) if self.radial_distortion else (),
        )

    def camera_centers(self) -> Float[np.ndarray, "cameras 3"]:
        """Where the cameras stand."""
        turned, moved = self.camera_from_world[:, :3, :3], self.camera_from_world[:, :3, 3]
        return -np.einsum("cba,cb->ca", turned, moved)

    def reprojection_errors_px(self) -> Float[np.ndarray, "observations"]:
        """How far from each observation its point is projected, in pixels."""
        off = np.zeros(len(self.pixels))
        for row, transform in enumerate(self.camera_from_world):
            mine = self.observation_camera == row
            if mine.any():
                drawn = self.camera(transform).project(self.points[self.observation_point[mine]])
                off[mine] = np.linalg.norm(drawn - self.pixels[mine], axis=1)
        return off

    def observations_of_camera(self, row: int) -> Int[np.ndarray, "seen"]:
        """The observations of one camera."""
        return np.flatnonzero(self.observation_camera == row)

    def without_cameras(self, doubtful: Bool[np.ndarray, "cameras"]) -> "SparseModel":
        """The model without some of its cameras and their observations."""
        kept = ~doubtful[self.observation_camera]
        row_of = np.cumsum(~doubtful) - 1
        return replace(
            self,
            frames=self.frames[~doubtful],
            camera_from_world=self.camera_from_world[~doubtful],
            observation_camera=row_of[self.observation_camera[kept]],
            observation_point=self.observation_point[kept],
            pixels=self.pixels[kept],
        )

    def save(self, path: Path) -> None:
        """As an .npz without objects."""
        np.savez(path, allow_pickle=False, **vars(self))

    @classmethod
    def load(cls, path: Path) -> "SparseModel":
        """What `save` wrote."""
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in file.files if key != "allow_pickle"}
        x, y = (float(value) for value in arrays.pop("center_px"))
        width, height = (int(value) for value in arrays.pop("size_px"))
        numbers = {key: float(arrays.pop(key)) for key in ("focal_px", "radial_distortion")}
        return cls(center_px=(x, y), size_px=(width, height), **numbers, **arrays)


@dataclass(frozen=True, kw_only=True)
class QualityGate:
    """One figure and its bound.

    Attributes:
        name: Key in the report.
        value: Measured figure.
        bound: Threshold that it is compared with.
        passed: Whether it is good enough.
        failure_reason: What it means if it is not.
    """

    name: str
    value: float
    bound: float
    passed: bool
    failure_reason: str


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
