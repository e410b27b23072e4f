"""The outline of a posed body in a picture, and how far pixels are from one."""

from typing import final

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from capture.camera import Camera
from preprocess.body import ShapedBody
from preprocess.pose import BodyPose

NEAR_PLANE_M = 0.05
"""Bodies that come nearer to the camera than this are not drawn."""

SUBPIXEL_BITS = 4
"""Corners are drawn to a sixteenth of a pixel."""


@final
class MeshSilhouette:
    """Draws one person's body, or what has its triangles, as a filled shape.

    OpenCV fills many polygons at once by the even-odd rule; so each call gets the triangles of one
    limb that look towards the camera, or away from it: these do not lie over each other.
    """

    def __init__(self, shaped: ShapedBody) -> None:
        """Sorts the triangles by limbs."""
        self._shaped = shaped
        faces = shaped.body.faces
        limb = shaped.body.weights[faces].sum(axis=1).argmax(axis=1)
        limbs = [faces[limb == joint] for joint in range(24) if (limb == joint).any()]
        self._limbs = [(each, np.unique(each)) for each in limbs]

    def draw_pose(self, pose: BodyPose, camera: Camera) -> Bool[np.ndarray, "height width"]:
        """The pixels that the body covers; none if it comes too near or behind the camera."""
        return self.draw_vertices(self._shaped.with_pose(pose).vertices(), camera) > 0

    def draw_vertices(
        self, vertices: Float[np.ndarray, "vertices 3"], camera: Camera
    ) -> UInt8[np.ndarray, "height width"]:
        """The pixels that the body's triangles cover, their corners elsewhere: 1, else 0.

        Args:
            vertices: In the world, metres.
            camera: If any of them is too near to it or behind it, nothing is drawn.
        """
        width, height = camera.size_px
        picture = np.zeros((height, width), dtype=np.uint8)
        depth = vertices @ camera.camera_from_world[2, :3] + camera.camera_from_world[2, 3]
        if depth.min() < NEAR_PLANE_M:
            return picture
        pixels = (camera.project(vertices) - 0.5) * (1 << SUBPIXEL_BITS)
        corners = np.clip(np.round(pixels), -(1 << 20), 1 << 20).astype(np.int32)
        for faces, used in self._limbs:
            triangles = corners[faces].astype(np.int64)
            a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
            towards = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]
            points = corners[used]
            low = np.clip((points.min(axis=0) >> SUBPIXEL_BITS) - 1, 0, (width, height))
            high = np.clip((points.max(axis=0) >> SUBPIXEL_BITS) + 3, 0, (width, height))
            part = picture[low[1] : high[1], low[0] : high[0]]
            triangles -= low << SUBPIXEL_BITS
            for side in (towards, ~towards):
                filled = np.zeros(part.shape, dtype=np.uint8)
                polygons = list(triangles[side].astype(np.int32))
                if polygons and part.size:
                    cv2.fillPoly(filled, polygons, 1, cv2.LINE_8, SUBPIXEL_BITS)
                part |= filled
        closed = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
        return np.asarray(closed, dtype=np.uint8)


def signed_distance_px(mask: Bool[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    """How far the middle of each pixel is outside a shape, in pixels; inside negative."""
    hard = mask.astype(np.uint8)
    outside = cv2.distanceTransform(1 - hard, cv2.DIST_L2, 5)
    inside = cv2.distanceTransform(hard, cv2.DIST_L2, 5)
    return np.asarray(outside - inside + np.where(mask, 0.5, -0.5), dtype=np.float32)
