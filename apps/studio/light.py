"""Light painted onto the body: how much of the sky and the lamp each vertex sees in the A-pose.

It is baked once and moves with the skin, because the field that is to learn it knows neither pose
nor view. Visibility comes from the z-buffer, seen from each direction far away.
"""

import numpy as np
from jaxtyping import Float, Float32, Int32

from apps.studio.raster import rasterize
from capture.camera import Camera

LAMP_FROM = np.array([0.45, 0.75, 0.85]) / np.linalg.norm([0.45, 0.75, 0.85])
LAMP_RGB = np.array([1.00, 0.96, 0.88])
SKY_RGB = np.array([0.92, 0.97, 1.00])
FLOOR_RGB = np.array([0.62, 0.56, 0.50])

SHADOW_BIAS_M = 0.02
"""A surface does not shade itself nearer than this."""


def bake_light(
    points: Float[np.ndarray, "vertices 3"],
    normals: Float[np.ndarray, "vertices 3"],
    faces: Int32[np.ndarray, "faces 3"],
    *,
    template_points: Float32[np.ndarray, "vertices 3"],
    materials: Int32[np.ndarray, "faces"],
    measures: Float32[np.ndarray, "cuts"],
    directions: int = 32,
) -> Float32[np.ndarray, "vertices 3"]:
    """Light on each vertex as a factor of its colour, about 0.45 in folds to 1.15 in the lamp."""
    sky = np.zeros((len(points), 3))
    lamp = np.zeros(len(points))
    weight = lamp_weight = 0.0
    for toward in _fibonacci_directions(directions):
        camera = _directional_camera(points, toward)
        depth_seen = rasterize(
            points, faces, camera, supersampling=1, template_points=template_points, materials=materials, measures=measures
        ).depth
        free = _visibility(points, camera, depth_seen)
        facing = np.maximum(normals @ toward, 0.0) * free
        up = 0.5 + 0.5 * toward[1]
        sky += facing[:, None] * (up * SKY_RGB + (1.0 - up) * FLOOR_RGB)
        weight += 0.25
        near_lamp = max(float(toward @ LAMP_FROM) - 0.55, 0.0)
        lamp += facing * near_lamp
        lamp_weight += near_lamp
    light = 0.32 + 0.58 * sky / weight + 0.42 * LAMP_RGB * (lamp / lamp_weight)[:, None]
    return light.astype(np.float32)


def _fibonacci_directions(count: int) -> Float[np.ndarray, "directions 3"]:
    """Directions spread evenly over the sphere (Fibonacci's lattice)."""
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - height**2)
    return np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1)


def _directional_camera(points: Float[np.ndarray, "vertices 3"], toward: Float[np.ndarray, "3"]) -> Camera:
    """A camera 40 m away in the direction `toward` that sees all points in 256 pixels."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = float(np.linalg.norm(points - middle, axis=1).max())
    forward = -toward
    right = np.cross(forward, [0.0, 1.0, 0.0] if abs(toward[1]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = [right, np.cross(forward, right), forward]
    camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ (middle + 40.0 * toward)
    focal = 126.0 * 40.0 / (reach + 0.01)
    return Camera(
        focal_px=(focal, focal),
        center_px=(128.0, 128.0),
        size_px=(256, 256),
        camera_from_world=camera_from_world,
    )


def _visibility(
    points: Float[np.ndarray, "vertices 3"],
    camera: Camera,
    depth_seen: Float32[np.ndarray, "height width"],
) -> Float[np.ndarray, "vertices"]:
    """How far each point is the first one on its way, in [0, 1], softened over 4 pixels."""
    forward, away = camera.camera_from_world[2, :3], camera.camera_from_world[2, 3]
    depth = points @ forward + away
    pixel = camera.project(points)
    free = np.zeros(len(points))
    for dx, dy in ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)):
        column = np.clip((pixel[:, 0] + dx).astype(int), 0, 255)
        row = np.clip((pixel[:, 1] + dy).astype(int), 0, 255)
        free += 0.25 * np.clip(1.5 - (depth - depth_seen[row, column]) / SHADOW_BIAS_M, 0.0, 1.0)
    return free
