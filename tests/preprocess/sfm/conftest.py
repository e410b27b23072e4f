"""A room to solve cameras in: a textured box, a turning camera, and where it really stood."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.source import FrameSource
from capture.source_opening import open_source
from preprocess.sfm.camera_solution import SparseModel
from tests.avatar_fixtures import pixel_centers

HALF_M, HEIGHT_M = 3.0, 2.6
PIXELS_PER_M = 160


def looking(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Axes of a camera that stands upright (world y up) and looks at a point."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def walked(
    count: int, *, degrees: float, radius_m: float = 2.2, size_px: tuple[int, int], focal_px: float
) -> list[Camera]:
    """A walk round the middle of the room with an unsteady hand."""
    rng = np.random.default_rng(1)
    cameras = []
    for angle in np.radians(np.linspace(-degrees / 2, degrees / 2, count)):
        eye = np.array([radius_m * np.sin(angle), 1.5, radius_m * np.cos(angle)])
        eye += 0.02 * rng.normal(size=3)
        target = np.array([0.0, 0.9, 0.0]) + 0.02 * rng.normal(size=3)
        cameras.append(Camera.at(eye, looking(eye, target), focal_px, size_px))
    return cameras


@dataclass(frozen=True)
class Room:
    """Six textured faces, seen from inside.

    Attributes:
        textures: By axis and side.
    """

    textures: dict[tuple[int, int], np.ndarray]

    @classmethod
    def of(cls, seed: int = 0) -> "Room":
        """Noise of several sizes on every face, nowhere the same."""
        rng = np.random.default_rng(seed)
        side = round(2 * HALF_M * PIXELS_PER_M)
        textures = {}
        for face in ((axis, end) for axis in range(3) for end in (0, 1)):
            picture = np.zeros((side, side, 3), np.float32)
            for cells, share in ((24, 0.3), (80, 0.3), (240, 0.3)):
                coarse = rng.random((cells, cells, 3), np.float32)
                picture += share * cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
            textures[face] = (255.0 * np.clip(picture, 0.0, 1.0)).astype(np.uint8)
        return cls(textures)

    def seen(self, camera: Camera) -> np.ndarray:
        """The picture, 8-bit RGB."""
        width, height = camera.size_px
        eye = camera.center_world
        rays = camera.ray_directions(pixel_centers(camera))
        low, high = np.array([-HALF_M, 0.0, -HALF_M]), np.array([HALF_M, HEIGHT_M, HALF_M])
        with np.errstate(divide="ignore"):
            ahead = np.where(rays > 0, (high - eye) / rays, (low - eye) / rays)
        axis = ahead.argmin(axis=1)
        points = eye + rays * ahead.min(axis=1)[:, None]
        rgb = np.zeros((len(rays), 3), np.uint8)
        for (face_axis, end), texture in self.textures.items():
            here = (axis == face_axis) & ((rays[:, face_axis] > 0) == bool(end))
            u, v = (i for i in range(3) if i != face_axis)
            places = (points[here][:, [u, v]] - low[[u, v]]) * PIXELS_PER_M
            maps = places.astype(np.float32).reshape(-1, 1, 2)
            if len(maps):
                rgb[here] = _sampled(texture, maps)
        return rgb.reshape(height, width, 3)

    def film(self, folder: Path, cameras: Iterable[Camera]) -> FrameSource:
        return filmed(folder, map(self.seen, cameras))


def filmed(folder: Path, pictures: Iterable[np.ndarray]) -> FrameSource:
    """A folder of 8-bit RGB pictures."""
    folder.mkdir(exist_ok=True)
    for index, rgb in enumerate(pictures):
        cv2.imwrite(str(folder / f"{index:03d}.png"), rgb[..., ::-1])
    return open_source(folder)


def _sampled(texture: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Bilinear; OpenCV takes rows of less than 32,768 pixels."""
    parts = [
        cv2.remap(texture, part[..., 0], part[..., 1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        for part in np.array_split(places, len(places) // 30000 + 1)
    ]
    return np.concatenate(parts).reshape(-1, 3)


@pytest.fixture(scope="session")
def room() -> Room:
    return Room.of()


def exact_model(cameras: list[Camera], points: np.ndarray, noise_px: float = 0.0) -> SparseModel:
    """A model in which every camera sees every point that is in its picture, where it is."""
    rng = np.random.default_rng(2)
    seen_by, seen_point, pixels = [], [], []
    for row, camera in enumerate(cameras):
        depth = points @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        there = camera.project(points)
        inside = (depth > 0.1) & ((there > 0.0) & (there < camera.size_px)).all(axis=1)
        seen_by.append(np.full(inside.sum(), row))
        seen_point.append(np.flatnonzero(inside))
        pixels.append(there[inside] + noise_px * rng.normal(size=(inside.sum(), 2)))
    first = cameras[0]
    return SparseModel(
        frames=np.arange(len(cameras)), points=points, pixels=np.concatenate(pixels),
        camera_from_world=np.stack([camera.camera_from_world for camera in cameras]),
        focal_px=first.focal_px[0], center_px=first.center_px, radial_distortion=0.0,
        size_px=first.size_px, observation_camera=np.concatenate(seen_by),
        observation_point=np.concatenate(seen_point),
    )  # fmt: skip


@pytest.fixture(scope="session")
def room_points() -> np.ndarray:
    """Points on the floor and the walls of the room."""
    rng = np.random.default_rng(3)
    points = rng.uniform([-HALF_M, 0.0, -HALF_M], [HALF_M, HEIGHT_M, HALF_M], (900, 3))
    points[:300, 1] = 0.0
    points[300:600, 0] = np.where(points[300:600, 0] > 0.0, HALF_M, -HALF_M)
    points[600:, 2] = np.where(points[600:, 2] > 0.0, HALF_M, -HALF_M)
    return points


@pytest.fixture
def cameras() -> list[Camera]:
    return walked(24, degrees=100, size_px=(640, 480), focal_px=520.0)


@pytest.fixture
def model(cameras, room_points) -> SparseModel:
    """An exact solution, in metres."""
    return exact_model(cameras, room_points)
