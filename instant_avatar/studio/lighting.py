"""From triangles to colors: a z-buffer, light that is painted onto the body, and shading.

The z-buffer says which triangle each subsample sees, and where on it; the grid of subsamples is
`supersampling` times finer than the picture. Barycentrics are made perspective-correct by dividing
by depth, so what is interpolated lies on the surface and not on the screen.

Light is how much of the sky and the lamp each vertex sees in the A-pose (by the z-buffer, from each
direction far away). It is baked once and moves with the skin, because the field that is to learn it
knows neither pose nor view. A pixel is the mean of its covered subsamples.
"""

from dataclasses import dataclass
from typing import NamedTuple, final

import numpy as np
from jaxtyping import Float, Float32, Int32

from avatar.kernels.kernel_compiler import compile_kernel
from capture.camera import Camera
from capture.source import AlphaMask, RgbImage
from instant_avatar.studio.outfit import Measures, Palette, PerVertex, Vertices, is_visible
from instant_avatar.studio.procedural_albedo import albedo_at

RenderedFrame = tuple[RgbImage, AlphaMask]
"""A picture of the actor before a background, and the exact soft mask."""
NO_FACE = -1


class ClothingCut(NamedTuple):
    """Where garments end: which parts of triangles `is_visible` denies.

    `template_points` are the vertices' positions on the undressed template.
    """

    template_points: Float32[np.ndarray, "vertices 3"]
    materials: Int32[np.ndarray, "faces"]
    measures: Measures


UNCUT = ClothingCut(
    np.zeros((1, 3), dtype=np.float32), np.zeros(0, dtype=np.int32), np.zeros(0, dtype=np.float32)
)
"""Triangles that are drawn as a whole."""


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class ZBuffer:
    """Nearest triangles of the subsamples.

    Attributes:
        face: Index of the nearest triangle, or -1.
        barycentric: Perspective-correct weights of the triangle's second and third corner.
        depth: Distance along the camera's axis in metres; infinite where there is nothing.
        supersampling: Subsamples along each side of a pixel.
    """

    face: Int32[np.ndarray, "rows columns"]
    barycentric: Float32[np.ndarray, "rows columns 2"]
    depth: Float32[np.ndarray, "rows columns"]
    supersampling: int


def rasterize(
    points_world: Vertices,
    faces: Int32[np.ndarray, "faces 3"],
    camera: Camera,
    *,
    supersampling: int = 4,
    cut: ClothingCut = UNCUT,
) -> ZBuffer:
    """Draw triangles, seen from both sides, into a z-buffer.

    A bent lens bends the corners, not the edges between them; triangles with a corner nearer than 1
    cm are left out.
    """
    rotation, translation = camera.camera_from_world[:3, :3], camera.camera_from_world[:3, 3]
    depth = points_world @ rotation[2] + translation[2]
    screen = np.empty((len(points_world), 3), dtype=np.float32)
    screen[:, :2] = camera.project(points_world) * supersampling
    screen[:, 2] = depth
    rows, columns = camera.size_px[1] * supersampling, camera.size_px[0] * supersampling
    seen = ZBuffer(
        face=np.full((rows, columns), NO_FACE, dtype=np.int32),
        barycentric=np.zeros((rows, columns, 2), dtype=np.float32),
        depth=np.full((rows, columns), np.inf, dtype=np.float32),
        supersampling=supersampling,
    )
    _rasterize_faces(screen, faces, *cut, seen.face, seen.barycentric, seen.depth)
    return seen


@compile_kernel(nogil=True, error_model="numpy")
def _rasterize_faces(
    screen: Float32[np.ndarray, "vertices 3"],
    faces: Int32[np.ndarray, "faces 3"],
    texture: Float32[np.ndarray, "places 3"],
    kinds: Int32[np.ndarray, "kinds"],
    cut: Measures,
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
                # shares of the triangle's area on the screen are barycentrics; 1 / depth is linear
                # there, so dividing by the corners' depths makes them perspective-correct
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


LAMP_RGB = np.array([1.00, 0.96, 0.88])
LAMP_STRENGTH = 0.42
"""Light of the lamp, as a factor of color."""


def bake_light(
    points: Vertices,
    normals: Vertices,
    faces: Int32[np.ndarray, "faces 3"],
    cut: ClothingCut,
    *,
    lamp_strength: float = LAMP_STRENGTH,
) -> Float32[np.ndarray, "vertices 3"]:
    """Light on each vertex as a factor of its color, about 0.45 in folds to 1.15 in the lamp."""
    sky_rgb, floor_rgb = np.array([0.92, 0.97, 1.00]), np.array([0.62, 0.56, 0.50])
    lamp_from = np.array([0.45, 0.75, 0.85]) / np.linalg.norm([0.45, 0.75, 0.85])
    sky = np.zeros((len(points), 3))
    lamp = np.zeros(len(points))
    weight = lamp_weight = 0.0
    for toward in fibonacci_directions(32):
        free = lamp_visibility(points, faces, toward, cut)
        facing = np.maximum(normals @ toward, 0.0) * free
        up = 0.5 + 0.5 * toward[1]
        sky += facing[:, None] * (up * sky_rgb + (1.0 - up) * floor_rgb)
        weight += 0.25
        near_lamp = max(float(toward @ lamp_from) - 0.55, 0.0)
        lamp += facing * near_lamp
        lamp_weight += near_lamp
    light = 0.32 + 0.58 * sky / weight + lamp_strength * LAMP_RGB * (lamp / lamp_weight)[:, None]
    return light.astype(np.float32)


def lamp_visibility(
    points: Vertices,
    faces: Int32[np.ndarray, "faces 3"],
    toward: Float[np.ndarray, "3"],
    cut: ClothingCut,
) -> PerVertex:
    """Return the light of a lamp far away that reaches each vertex past the others, in [0, 1].

    `toward` is the unit vector to the lamp.
    """
    camera = _directional_camera(points, toward)
    seen = rasterize(points, faces, camera, supersampling=1, cut=cut)
    return _visibility(points, camera, seen.depth)


def fibonacci_directions(count: int) -> Float[np.ndarray, "directions 3"]:
    """Directions spread evenly over the sphere (Fibonacci's lattice)."""
    height = 1.0 - 2.0 * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - height**2)
    return np.stack([ring * np.cos(angle), height, ring * np.sin(angle)], axis=1)


def _directional_camera(points: Vertices, toward: Float[np.ndarray, "3"]) -> Camera:
    """A camera 40 m away in the direction `toward` that sees all points in 256 pixels."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = float(np.linalg.norm(points - middle, axis=1).max())
    forward = -toward
    right = np.cross(forward, [0.0, 1.0, 0.0] if abs(toward[1]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    focal_px = 126.0 * 40.0 / (reach + 0.01)
    return Camera.at(middle + 40.0 * toward, axes, focal_px, (256, 256))


def _visibility(points: Vertices, camera: Camera, depth_seen: AlphaMask) -> PerVertex:
    """Return the light that reaches each point, in [0, 1], softened over 4 pixels."""
    forward, away = camera.camera_from_world[2, :3], camera.camera_from_world[2, 3]
    depth = points @ forward + away
    pixel = camera.project(points)
    free = np.zeros(len(points))  # half of it 2 cm behind another surface: none shades itself
    for dx, dy in ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)):
        column = np.clip((pixel[:, 0] + dx).astype(int), 0, 255)
        row = np.clip((pixel[:, 1] + dy).astype(int), 0, 255)
        free += 0.25 * np.clip(1.5 - (depth - depth_seen[row, column]) / 0.02, 0.0, 1.0)
    return free


def shade_pixels(
    zbuffer: ZBuffer,
    *,
    faces: Int32[np.ndarray, "faces 3"],
    cut: ClothingCut,
    light: Float32[np.ndarray, "vertices 3"],
    palette: Palette,
    checked: bool,
) -> tuple[Float32[np.ndarray, "height width 3"], AlphaMask]:
    """Return the color of each pixel's covered part (sRGB in [0, 1]) and the covered fraction.

    `light` is a factor of color.
    """
    height, width = (
        zbuffer.face.shape[0] // zbuffer.supersampling,
        zbuffer.face.shape[1] // zbuffer.supersampling,
    )
    rgb = np.zeros((height, width, 3), dtype=np.float32)
    alpha = np.zeros((height, width), dtype=np.float32)
    _shade(
        zbuffer.face, zbuffer.barycentric, zbuffer.supersampling, faces, cut.materials,
        cut.template_points, light, palette, cut.measures, checked, rgb, alpha,
    )  # fmt: skip
    return rgb, alpha


def composite_over(
    rgb: Float32[np.ndarray, "height width 3"], alpha: AlphaMask, background: RgbImage | None = None
) -> RgbImage:
    """The person in front of a background (white if None)."""
    behind = np.float32(1.0) if background is None else background.astype(np.float32) / 255.0
    mixed = alpha[..., None] * rgb + (1.0 - alpha[..., None]) * behind
    return (np.clip(mixed, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


@compile_kernel(nogil=True, error_model="numpy")
def _shade(
    face_of: Int32[np.ndarray, "rows columns"],
    share_of: Float32[np.ndarray, "rows columns 2"],
    fine: int,
    faces: Int32[np.ndarray, "faces 3"],
    kinds: Int32[np.ndarray, "kinds"],
    place: Float32[np.ndarray, "vertices 3"],
    light: Float32[np.ndarray, "vertices 3"],
    palette: Palette,
    cut: Measures,
    checked: bool,
    rgb: Float32[np.ndarray, "height width 3"],
    alpha: AlphaMask,
) -> None:
    for i in range(alpha.shape[0]):
        for j in range(alpha.shape[1]):
            red, green, blue, covered = 0.0, 0.0, 0.0, 0
            for row in range(i * fine, (i + 1) * fine):
                for column in range(j * fine, (j + 1) * fine):
                    face = face_of[row, column]
                    if face < 0:
                        continue
                    covered += 1
                    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                    on_b, on_c = share_of[row, column, 0], share_of[row, column, 1]
                    on_a = 1.0 - on_b - on_c
                    color = albedo_at(
                        kinds[face],
                        on_a * place[a, 0] + on_b * place[b, 0] + on_c * place[c, 0],
                        on_a * place[a, 1] + on_b * place[b, 1] + on_c * place[c, 1],
                        on_a * place[a, 2] + on_b * place[b, 2] + on_c * place[c, 2],
                        palette,
                        cut,
                        checked,
                    )
                    for_red = on_a * light[a, 0] + on_b * light[b, 0] + on_c * light[c, 0]
                    for_green = on_a * light[a, 1] + on_b * light[b, 1] + on_c * light[c, 1]
                    for_blue = on_a * light[a, 2] + on_b * light[b, 2] + on_c * light[c, 2]
                    red += min(max(color[0] * for_red, 0.0), 1.0)
                    green += min(max(color[1] * for_green, 0.0), 1.0)
                    blue += min(max(color[2] * for_blue, 0.0), 1.0)
            if covered > 0:
                rgb[i, j, 0] = red / covered
                rgb[i, j, 1] = green / covered
                rgb[i, j, 2] = blue / covered
                alpha[i, j] = covered / (fine * fine)
