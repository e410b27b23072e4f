"""The room that a phone is carried around in: furniture, painted surfaces, and a camera's images.

Every surface follows the dead-leaves model: shapes of all sizes that hide each other have corners
at every scale, as the world has (Lee, Mumford and Huang 2001). They never repeat, or, in the style
"tiles", they only do.
"""

from dataclasses import dataclass, replace
from typing import Literal, final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8

from capture.camera import Camera
from capture.source import RgbImage
from instant_avatar.studio.lighting import rasterize

RoomStyle = Literal["room", "tiles"]

ROOM_LOW_M, ROOM_HIGH_M = (-3.7, 0.0, -3.1), (3.7, 2.7, 3.5)
"""Corners of the room; the actor stands near the origin, on the floor y = 0."""
SUPERSAMPLING = 3
"""Subsamples along each side of a pixel."""
TILE_M, TILE_COLOR, GROUT_COLOR = 0.30, (160, 156, 146), (104, 104, 100)
"""Edge of a tile, metres, its color and that of its border."""
LEAF_SIZES_M = (0.012, 0.45)
"""Smallest and largest leaf, metres."""
SUBPIXEL_BITS = 4
"""Fractional bits of the coordinates that OpenCV draws at."""


@dataclass(frozen=True)
class FurnitureBox:
    """A piece of furniture: a box, painted in one color.

    Attributes:
        center_xz_m: Its middle on the floor (x, z), metres.
        size_m: Size along x, y, z before it is turned.
        base_height_m: Height of its lower face.
        yaw_deg: Turn about the vertical.
    """

    center_xz_m: tuple[float, float]
    size_m: tuple[float, float, float]
    color: tuple[int, int, int]
    base_height_m: float = 0.0
    yaw_deg: float = 0.0


WALNUT, OAK, PINE = (104, 74, 52), (168, 128, 86), (196, 164, 118)

FURNITURE = (
    FurnitureBox((-2.3, -2.9), (1.4, 2.1, 0.36), WALNUT),
    FurnitureBox((0.3, -2.82), (1.7, 0.8, 0.48), OAK),
    FurnitureBox((0.55, -2.84), (0.9, 0.55, 0.1), (70, 84, 110), 0.84),
    FurnitureBox((-0.35, -2.8), (0.25, 0.32, 0.2), (190, 120, 70), 0.8, 30.0),
    FurnitureBox((1.85, -2.3), (0.42, 0.46, 0.42), (84, 110, 72), yaw_deg=25.0),
    FurnitureBox((3.36, -1.5), (0.6, 2.15, 1.3), PINE),
    FurnitureBox((2.75, -0.1), (0.55, 0.5, 0.55), (150, 110, 64), yaw_deg=20.0),
    FurnitureBox((2.72, -0.12), (0.36, 0.34, 0.4), (110, 120, 150), 0.5, -12.0),
    FurnitureBox((-2.95, -0.7), (0.8, 0.05, 1.4), WALNUT, 0.7),
    FurnitureBox((-3.25, -1.3), (0.07, 0.7, 0.07), WALNUT),
    FurnitureBox((-2.65, -1.3), (0.07, 0.7, 0.07), WALNUT),
    FurnitureBox((-3.25, -0.1), (0.07, 0.7, 0.07), WALNUT),
    FurnitureBox((-2.65, -0.1), (0.07, 0.7, 0.07), WALNUT),
    FurnitureBox((-3.0, -0.55), (0.3, 0.22, 0.4), (170, 60, 60), 0.75, 15.0),
    FurnitureBox((-1.55, -2.0), (0.42, 0.45, 0.42), (90, 96, 140), yaw_deg=35.0),
    FurnitureBox((3.35, 0.95), (0.5, 0.45, 1.1), (160, 150, 128)),
)
"""None of it comes within 1.8 m of the actor, or between the actor and the camera."""
WALL_COLORS = (
    (170, 182, 172), (198, 176, 142), (168, 124, 84), (214, 212, 204), (176, 160, 172),
    (160, 176, 190),
)  # fmt: skip
"""Of the room: low x, high x, floor, ceiling, low z, high z."""
WALL_CONTRAST, FURNITURE_CONTRAST = 20.0, 34.0
"""Standard deviation of the leaves' brightness, of 255."""


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class FurnishedRoom:
    """A furnished room: triangles in the world and the texture of each face.

    Attributes:
        places: Column and row of each vertex in its face's texture.
        face_of: Face of each triangle: six times the number of a box, plus that of its side.
        texels: All textures, one after the other.
        textures: Of each face: its first texel, rows, columns.
        seed: Of the furniture's places, the patterns and the sensor's noise.
    """

    points: Float[np.ndarray, "vertices 3"]
    places: Float32[np.ndarray, "vertices 2"]
    triangles: Int32[np.ndarray, "triangles 3"]
    face_of: Int32[np.ndarray, "triangles"]
    texels: UInt8[np.ndarray, "texels 3"]
    textures: Int32[np.ndarray, "faces 3"]
    seed: int

    @classmethod
    def furnished(cls, style: RoomStyle, size: int, seed: int) -> "FurnishedRoom":
        """Furnish a room, with texels that match images of `size` pixels.

        In "room" nothing repeats; in "tiles" everything on walls, floor and furniture does.
        """
        generator = np.random.default_rng([seed, 4])
        texel_m = float(np.clip(2.9 / size, 0.0018, 0.025))
        low, high = np.array(ROOM_LOW_M), np.array(ROOM_HIGH_M)
        middle = (low + high) / 2.0
        around = FurnitureBox((middle[0], middle[2]), tuple(high - low), WALL_COLORS[0])
        grids, texels, textures, count, vertices = [], [], [], 0, 0
        for number, box in enumerate([around, *(_jitter(each, generator) for each in FURNITURE)]):
            contrast = FURNITURE_CONTRAST if number else WALL_CONTRAST
            for side, (corner, right, down) in enumerate(_box_faces(box)):
                size_px = tuple(
                    max(2, round(float(np.linalg.norm(edge)) / texel_m)) for edge in (right, down)
                )
                color = box.color if number else WALL_COLORS[side]
                texture = _paint(style, size_px, texel_m, color, contrast, generator)
                texels.append(texture.reshape(-1, 3))
                textures.append((count, *texture.shape[:2]))
                count += len(texels[-1])
                grid = _subdivide(corner, right, down, size_px)
                grids.append((*grid[:2], grid[2] + vertices, np.full(len(grid[2]), len(grids))))
                vertices += len(grid[0])
        points, places, triangles, face_of = (
            np.concatenate(part) for part in zip(*grids, strict=True)
        )
        return cls(
            points=points,
            places=places.astype(np.float32),
            triangles=triangles.astype(np.int32),
            face_of=face_of.astype(np.int32),
            texels=np.concatenate(texels),
            textures=np.array(textures, dtype=np.int32),
            seed=seed,
        )

    def render(
        self, camera: Camera, feet_world: Float[np.ndarray, "feet 3"], number: int
    ) -> RgbImage:
        """Render the room with soft shadows around the feet, and noise by the image's `number`."""
        seen = rasterize(self.points, self.triangles, camera, supersampling=SUPERSAMPLING)
        triangle, (b, c) = np.maximum(seen.face, 0), np.moveaxis(seen.barycentric, -1, 0)
        corners, shares = self.triangles[triangle], (1.0 - b - c, b, c)
        column, row = np.zeros((2, *triangle.shape), dtype=np.float32)
        for corner, share in enumerate(shares):
            place = self.places[corners[..., corner]]
            column, row = column + share * place[..., 0], row + share * place[..., 1]
        face = self.face_of[triangle]
        first, rows, columns = np.moveaxis(self.textures[face], -1, 0)
        column = np.clip(column.astype(np.int32), 0, columns - 1)
        texel = first + np.clip(row.astype(np.int32), 0, rows - 1) * columns + column
        light = np.array([0.84, 0.92, 0.90, 1.02, 0.97, 0.88], dtype=np.float32)  # by side
        rgb = self.texels[texel] * light[face % 6][..., None]
        width, height = camera.size_px
        rgb = rgb.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 3).mean(axis=(1, 3))
        thin = np.s_[::SUPERSAMPLING, ::SUPERSAMPLING]
        rgb *= _foot_shadows(face[thin], seen.depth[thin], camera, feet_world)[..., None]
        generator = np.random.default_rng([self.seed, 6, number])
        rgb += 1.5 * generator.standard_normal(rgb.shape, dtype=np.float32)
        return np.clip(rgb + 0.5, 0.0, 255.0).astype(np.uint8)


def _box_faces(box: FurnitureBox) -> list[Float[np.ndarray, "3 3"]]:
    """Return of each face of a box one corner, and the edges to its right and down."""
    cosine, sine = np.cos(np.deg2rad(box.yaw_deg)), np.sin(np.deg2rad(box.yaw_deg))
    turned = np.array([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
    edges = np.diag(box.size_m)
    base = np.array([box.center_xz_m[0], box.base_height_m, box.center_xz_m[1]])
    faces = []
    for axis, (right, down) in enumerate(((2, 1), (0, 2), (0, 1))):
        for far in (0.0, 1.0):
            corner = far * edges[axis] - 0.5 * np.array([box.size_m[0], 0.0, box.size_m[2]])
            faces.append(np.stack([corner, edges[right], edges[down]]) @ turned)
            faces[-1][0] += base
    return faces


def _subdivide(
    corner: Float[np.ndarray, "3"],
    right: Float[np.ndarray, "3"],
    down: Float[np.ndarray, "3"],
    size_px: tuple[int, ...],
) -> tuple[
    Float[np.ndarray, "vertices 3"], Float[np.ndarray, "vertices 2"], Int64[np.ndarray, "some 3"]
]:
    """Cut a face into quads; return vertices, their places in its texture, and triangles."""
    # quads: those that reach behind a camera are lost
    nx, ny = (int(np.ceil(np.linalg.norm(edge) / 0.3)) for edge in (right, down))
    share = np.stack(np.meshgrid(np.arange(nx + 1) / nx, np.arange(ny + 1) / ny), -1).reshape(-1, 2)
    first = (np.arange(ny)[:, None] * (nx + 1) + np.arange(nx)).reshape(-1, 1)
    halves = np.array([[0, 1, nx + 1], [1, nx + 2, nx + 1]])
    triangles = np.concatenate([first + corners for corners in halves])
    return corner + share @ np.stack([right, down]), share * np.array(size_px), triangles


def _foot_shadows(
    face: Int32[np.ndarray, "height width"],
    depth: Float32[np.ndarray, "height width"],
    camera: Camera,
    feet_world: Float[np.ndarray, "feet 3"],
) -> Float32[np.ndarray, "height width"]:
    """Return the factor of the floor's light about the feet."""
    light = np.ones(depth.shape, dtype=np.float32)
    floor = face == 2  # low y of the room
    height, width = floor.shape
    y, x = np.mgrid[0:height, 0:width][:, floor] + 0.5
    plane = np.stack([x, y], axis=-1) - camera.center_px
    plane /= camera.focal_px
    rays = np.column_stack([plane, np.ones(len(plane))]) @ camera.camera_from_world[:3, :3]
    points = camera.center_world + rays * depth[floor][:, None]
    shade = np.ones(len(points))
    for foot in feet_world:
        far = ((points[:, [0, 2]] - foot[[0, 2]]) ** 2).sum(axis=1) / 0.22**2
        shade *= 1.0 - 0.30 * np.exp(-2.0 * far)
    light[floor] = shade
    return light


def _jitter(piece: FurnitureBox, generator: np.random.Generator) -> FurnitureBox:
    """The piece, not quite where it always is; what stands on others stays on them."""
    if (
        min(piece.size_m) < 0.1
        or piece.base_height_m > 0.0
        or max(map(abs, piece.center_xz_m)) > 2.7
    ):
        return piece
    x, z = generator.uniform(-0.06, 0.06, 2)
    return replace(
        piece,
        center_xz_m=(piece.center_xz_m[0] + x, piece.center_xz_m[1] + z),
        yaw_deg=piece.yaw_deg + generator.uniform(-6.0, 6.0),
    )


def _paint(
    style: RoomStyle,
    size_px: tuple[int, ...],
    texel_m: float,
    color: tuple[int, int, int],
    contrast: float,
    generator: np.random.Generator,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Paint a face of `size_px` (columns, rows): leaves, or one tile of them over and over."""
    if style == "room":
        return _paint_dead_leaves(size_px, texel_m, color, contrast, generator)
    side = max(round(TILE_M / texel_m), 4)
    always = np.random.default_rng(0)
    tile = _paint_dead_leaves((side, side), texel_m, TILE_COLOR, 30.0, always)
    line = max(side // 40, 1)
    tile[:line], tile[:, :line] = GROUT_COLOR, GROUT_COLOR
    times = (-(-size_px[1] // side), -(-size_px[0] // side), 1)
    return np.ascontiguousarray(np.tile(tile, times)[: size_px[1], : size_px[0]])


def _paint_dead_leaves(
    size_px: tuple[int, ...],
    texel_m: float,
    color: tuple[int, int, int],
    contrast: float,
    generator: np.random.Generator,
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Shapes that hide each other, sizes by a power law, colors around one."""
    columns, rows = size_px
    image = np.full((rows, columns, 3), color, dtype=np.uint8)
    low = LEAF_SIZES_M[0]
    high = min(LEAF_SIZES_M[1], 0.5 * max(size_px) * texel_m + low)
    count = int(min(columns * rows * texel_m**2 * 900.0, 60_000)) + 4
    # The number of leaves above a radius falls with its square, so that every scale covers alike.
    drawn = generator.uniform(high**-2.0, low**-2.0, count) ** -0.5
    drawn[: count // 8] = np.geomspace(high, 4.0 * low, count // 8)  # the ground is covered
    radii = drawn / texel_m * 2**SUBPIXEL_BITS
    places = generator.uniform(0.0, 1.0, (count, 2)) * size_px * 2**SUBPIXEL_BITS
    tones = np.array(color) + contrast * generator.standard_normal((count, 1))
    tones = np.clip(tones + 0.3 * contrast * generator.standard_normal((count, 3)), 4, 251)
    angles = np.sort(generator.uniform(0.0, 2.0 * np.pi, (count, 5)), axis=1)
    rings = np.stack([np.cos(angles), np.sin(angles)], axis=-1) * radii[:, None, None]
    polygons = (places[:, None] + rings).astype(np.int32)
    for i in range(count):
        corners, ink = polygons[i, : 3 + i % 3], tones[i].tolist()
        cv2.fillConvexPoly(image, corners, ink, cv2.LINE_AA, SUBPIXEL_BITS)
    return image
