"""The pinhole camera: the only place where a pixel becomes a ray."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

Vector3 = Float[np.ndarray, "3"]
"""A place, a direction or an axis-angle."""

Matrix3 = Float[np.ndarray, "3 3"]
"""A rotation, or a camera's matrix K."""

Transform = Float[np.ndarray, "4 4"]
"""A rigid transform."""

PointsInPlane = Float[np.ndarray, "*batch 2"]
"""Points of an image, pixels, or of the plane at depth 1."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """A pinhole camera with OpenCV axes (x right, y down, z forward) and OpenCV distortion.

    A pixel is a point (x, y) of the image plane in pixels; the pixel in row i and column j
    covers [j, j+1) x [i, i+1) and has its centre at (j + 0.5, i + 0.5).

    Attributes:
        focal_px: Focal lengths along x and y.
        center_px: Principal point.
        size_px: Width and height of the image.
        camera_from_world: Rigid 4x4 transform, metres.
        distortion: OpenCV coefficients k1 k2 p1 p2 [k3 …]; empty for none.
    """

    focal_px: tuple[float, float]
    center_px: tuple[float, float]
    size_px: tuple[int, int]
    camera_from_world: Transform
    distortion: tuple[float, ...] = ()

    @classmethod
    def from_intrinsic(
        cls,
        intrinsic: Matrix3,
        size_px: tuple[int, int],
        camera_from_world: Transform | None = None,
        distortion: Sequence[float] = (),
    ) -> "Camera":
        """A camera from its 3x3 matrix K; at the world's origin if no pose is given."""
        return cls(
            focal_px=(float(intrinsic[0, 0]), float(intrinsic[1, 1])),
            center_px=(float(intrinsic[0, 2]), float(intrinsic[1, 2])),
            size_px=size_px,
            camera_from_world=np.eye(4) if camera_from_world is None else camera_from_world,
            distortion=tuple(float(k) for k in distortion),
        )

    @classmethod
    def at(cls, eye: Vector3, axes: Matrix3, focal_px: float, size_px: tuple[int, int]) -> "Camera":
        """A camera at a place, metres, with its right, down and forward axes in the world as rows.

        Its principal point is the image's middle.
        """
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3], camera_from_world[:3, 3] = axes, -axes @ eye
        return cls(
            focal_px=(focal_px, focal_px),
            center_px=(0.5 * size_px[0], 0.5 * size_px[1]),
            size_px=size_px,
            camera_from_world=camera_from_world,
        )

    @property
    def intrinsic(self) -> Matrix3:
        """The 3x3 matrix K."""
        (fx, fy), (cx, cy) = self.focal_px, self.center_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    @property
    def center_world(self) -> Vector3:
        """The camera's position, metres."""
        rotation, translation = self.camera_from_world[:3, :3], self.camera_from_world[:3, 3]
        return -rotation.T @ translation

    def resize(self, size_px: tuple[int, int]) -> "Camera":
        """The same camera for an image scaled to another size (the same field of view)."""
        sx, sy = size_px[0] / self.size_px[0], size_px[1] / self.size_px[1]
        return replace(
            self,
            focal_px=(self.focal_px[0] * sx, self.focal_px[1] * sy),
            center_px=(self.center_px[0] * sx, self.center_px[1] * sy),
            size_px=size_px,
        )

    def crop(self, corner_px: tuple[int, int], size_px: tuple[int, int]) -> "Camera":
        """The camera of a part of the image: its upper left corner (x, y), width and height."""
        (cx, cy), (left, top) = self.center_px, corner_px
        return replace(self, center_px=(cx - left, cy - top), size_px=size_px)

    def scale_focal(self, factor: float) -> "Camera":
        """The same camera with focal lengths times a factor."""
        return replace(self, focal_px=(self.focal_px[0] * factor, self.focal_px[1] * factor))

    def resize_longer_side(self, longer_px: int) -> "Camera":
        """The same camera for an image with a longer side of `longer_px`."""
        scale = longer_px / max(self.size_px)
        width, height = (max(1, round(side * scale)) for side in self.size_px)
        return self.resize((width, height))

    def ray_directions(self, pixels: PointsInPlane) -> Float[np.ndarray, "*batch 3"]:
        """Unit directions in the world of the rays through `pixels` (x, y).

        All rays start at `center_world`.
        """
        if self.distortion:
            plane = self._undistort(pixels)
        else:
            plane = (pixels - np.array(self.center_px)) / np.array(self.focal_px)
        in_camera = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
        in_world = in_camera @ self.camera_from_world[:3, :3]
        return in_world / np.linalg.norm(in_world, axis=-1, keepdims=True)

    def project(self, points_world: Float[np.ndarray, "*batch 3"]) -> PointsInPlane:
        """Project points of the world to (x, y) in pixels; meaningless behind the camera."""
        rotation, translation = self.camera_from_world[:3, :3], self.camera_from_world[:3, 3]
        in_camera = points_world @ rotation.T + translation
        plane = in_camera[..., :2] / in_camera[..., 2:]
        if self.distortion:
            plane = self._distort(plane)
        return plane * np.array(self.focal_px) + np.array(self.center_px)

    def _undistort(self, pixels: PointsInPlane) -> PointsInPlane:
        """Pixels as points of the plane at depth 1, as a lens without distortion sees them."""
        import cv2  # heavy, and only needed for lenses that bend

        flat = pixels.reshape(-1, 1, 2).astype(np.float64)
        plane = cv2.undistortPoints(flat, self.intrinsic, np.array(self.distortion))
        return np.asarray(plane).reshape(pixels.shape)

    def _distort(self, plane: PointsInPlane) -> PointsInPlane:
        """Points of the plane at depth 1, moved to where the lens bends them."""
        import cv2  # heavy, and only needed for lenses that bend

        rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
        rays, zero = rays.reshape(-1, 1, 3).astype(np.float64), np.zeros(3)
        bent, _ = cv2.projectPoints(rays, zero, zero, np.eye(3), np.array(self.distortion))
        return np.asarray(bent).reshape(plane.shape)


def same_aspect_ratio(a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Return whether two images have one aspect ratio: scaled, their sides agree to 1 px or 1 %."""
    large, small = sorted((a, b), key=max, reverse=True)
    scale = max(small) / max(large)
    return all(
        abs(side * scale - wanted) <= max(1.0, 0.01 * wanted)
        for side, wanted in zip(large, small, strict=True)
    )
