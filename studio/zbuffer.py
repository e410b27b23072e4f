"""The z-buffer: which triangle each subsample of a picture sees, and where on it.

Letters: a subsample grid is `fine` times finer than the picture; `a b c` are a triangle's corners.
Barycentrics are made perspective-correct by dividing by depth, so what is interpolated lies on the
surface and not on the screen.
"""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Float32, Int32

from avatar.numba_kernels.kernel_compiler import compile_kernel
from capture.camera import Camera
from studio.outfit import is_visible

NO_FACE = -1


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class ZBuffer:
    """What the subsamples see.

    Attributes:
        face: Index of the nearest triangle, or -1.
        share: Perspective-correct weights of the triangle's second and third corner.
        depth: Distance along the camera's axis in metres; infinite where there is nothing.
        fine: Subsamples along each side of a pixel.
    """

    face: Int32[np.ndarray, "rows columns"]
    barycentric: Float32[np.ndarray, "rows columns 2"]
    depth: Float32[np.ndarray, "rows columns"]
    supersampling: int


def rasterize(
    points_world: Float[np.ndarray, "vertices 3"],
    faces: Int32[np.ndarray, "faces 3"],
    camera: Camera,
    *,
    supersampling: int = 4,
    template_points: Float32[np.ndarray, "vertices 3"] | None = None,
    materials: Int32[np.ndarray, "faces"] | None = None,
    measures: Float32[np.ndarray, "cuts"] | None = None,
) -> ZBuffer:
    """Draws triangles into a z-buffer of `fine` × `fine` subsamples a pixel.

    Args:
        points_world: Vertices, metres; triangles with a corner nearer than 1 cm are left out.
        faces: Triangles, seen from both sides.
        camera: Where from; a bent lens bends the corners, not the edges between them.
        fine: Subsamples along each side of a pixel.
        texture: Where each vertex lies on the undressed body at rest; needed for `kinds`.
        kinds: What each triangle is made of; parts of it that `cut.keeps` denies are not drawn.
        cut: The tailor's measures that `cut.keeps` reads.
    """
    rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    depth = points_world @ rotation[2] + translation[2]
    screen = np.empty((len(points_world), 3), dtype=np.float32)
    screen[:, :2] = camera.project(points_world) * supersampling
    screen[:, 2] = depth
    if template_points is None or materials is None or measures is None:
        template_points = np.zeros((1, 3), dtype=np.float32)
        materials = np.zeros(0, dtype=np.int32)
        measures = np.zeros(0, dtype=np.float32)
    rows, columns = camera.size_px[1] * supersampling, camera.size_px[0] * supersampling
    seen = ZBuffer(
        face=np.full((rows, columns), NO_FACE, dtype=np.int32),
        barycentric=np.zeros((rows, columns, 2), dtype=np.float32),
        depth=np.full((rows, columns), np.inf, dtype=np.float32),
        supersampling=supersampling,
    )
    _rasterize_faces(
        screen, faces, template_points, materials, measures, seen.face, seen.barycentric, seen.depth
    )
    return seen


@compile_kernel(nogil=True, error_model="numpy")
def _rasterize_faces(
    screen: Float32[np.ndarray, "vertices 3"],
    faces: Int32[np.ndarray, "faces 3"],
    texture: Float32[np.ndarray, "places 3"],
    kinds: Int32[np.ndarray, "kinds"],
    cut: Float32[np.ndarray, "cuts"],
    face_out: Int32[np.ndarray, "rows columns"],
    share_out: Float32[np.ndarray, "rows columns 2"],
    depth_out: Float32[np.ndarray, "rows columns"],
) -> None:
    rows, columns = face_out.shape
    for face in range(faces.shape[0]):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        xa, ya, za = screen[a, 0], screen[a, 1], screen[a, 2]
        xb, yb, zb = screen[b, 0], screen[b, 1], screen[b, 2]
        xc, yc, zc = screen[c, 0], screen[c, 1], screen[c, 2]
        if min(za, zb, zc) < 0.01:
            continue
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if abs(area) < 1e-9:
            continue
        left = max(int(np.ceil(min(xa, xb, xc) - 0.5)), 0)
        right = min(int(np.floor(max(xa, xb, xc) - 0.5)), columns - 1)
        top = max(int(np.ceil(min(ya, yb, yc) - 0.5)), 0)
        bottom = min(int(np.floor(max(ya, yb, yc) - 0.5)), rows - 1)
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                on_b = ((x - xa) * (yc - ya) - (xc - xa) * (y - ya)) / area
                on_c = ((xb - xa) * (y - ya) - (x - xa) * (yb - ya)) / area
                on_a = 1.0 - on_b - on_c
                if on_a < 0.0 or on_b < 0.0 or on_c < 0.0:
                    continue
                depth = 1.0 / (on_a / za + on_b / zb + on_c / zc)
                if depth >= depth_out[row, column]:
                    continue
                share_b, share_c = on_b * depth / zb, on_c * depth / zc
                if kinds.shape[0] > 0:
                    share_a = 1.0 - share_b - share_c
                    u = (
                        share_a * texture[a, 0] + share_b * texture[b, 0] + share_c * texture[c, 0],
                        share_a * texture[a, 1] + share_b * texture[b, 1] + share_c * texture[c, 1],
                        share_a * texture[a, 2] + share_b * texture[b, 2] + share_c * texture[c, 2],
                    )
                    if not is_visible(kinds[face], u[0], u[1], u[2], cut):
                        continue
                depth_out[row, column] = depth
                face_out[row, column] = face
                share_out[row, column, 0] = share_b
                share_out[row, column, 1] = share_c
