"""The room around the actor: its furniture, its surfaces, and the images of a camera in it."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, final

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8

from capture.camera import Camera
from instant_avatar.studio.painted_surfaces import (
    TexturePainter,
    books,
    dead_leaves,
    planks,
    plaster,
    repeat_motif,
    wood,
)
from instant_avatar.studio.room_raycast import RoomView, TexturedBoxes, raycast_boxes

RoomStyle = Literal["room", "tiles"]

ROOM_LOW_M, ROOM_HIGH_M = (-3.7, 0.0, -3.1), (3.7, 2.7, 3.5)
"""Corners of the room; the actor stands near the origin, on the floor y = 0."""
FACE_LIGHT = np.array([0.84, 0.92, 0.90, 1.02, 0.97, 0.88], dtype=np.float32)
"""Brightness of faces: low x, high x, low y, …"""
FLOOR_FACE = 2
"""Number of the floor among all faces: low y of solid 0."""
SENSOR_NOISE = 1.5
"""Standard deviation of the sensor's noise, of 255."""


@dataclass(frozen=True)
class FurnitureBox:
    """A piece of furniture: a box.

    Attributes:
        center_xz_m: Its middle on the floor (x, z), metres.
        size_m: Size along x, y, z before it is turned.
        base_height_m: Height of its lower face.
        yaw_deg: Turn about the vertical.
    """

    center_xz_m: tuple[float, float]
    size_m: tuple[float, float, float]
    texture: TexturePainter
    base_height_m: float = 0.0
    yaw_deg: float = 0.0


WALNUT, OAK, PINE = (104, 74, 52), (168, 128, 86), (196, 164, 118)

FURNITURE = (
    FurnitureBox((-2.3, -2.9), (1.4, 2.1, 0.36), books(WALNUT)),
    FurnitureBox((0.3, -2.82), (1.7, 0.8, 0.48), wood(OAK)),
    FurnitureBox((0.55, -2.84), (0.9, 0.55, 0.1), dead_leaves((70, 84, 110), 44.0), 0.84),
    FurnitureBox((-0.35, -2.8), (0.25, 0.32, 0.2), dead_leaves((190, 120, 70)), 0.8, 30.0),
    FurnitureBox((1.85, -2.3), (0.42, 0.46, 0.42), dead_leaves((84, 110, 72), 34.0), yaw_deg=25.0),
    FurnitureBox((3.36, -1.5), (0.6, 2.15, 1.3), wood(PINE)),
    FurnitureBox((2.75, -0.1), (0.55, 0.5, 0.55), dead_leaves((150, 110, 64), 32.0), yaw_deg=20.0),
    FurnitureBox((2.72, -0.12), (0.36, 0.34, 0.4), dead_leaves((110, 120, 150), 32.0), 0.5, -12.0),
    FurnitureBox((-2.95, -0.7), (0.8, 0.05, 1.4), wood(WALNUT), 0.7),
    FurnitureBox((-3.25, -1.3), (0.07, 0.7, 0.07), wood(WALNUT)),
    FurnitureBox((-2.65, -1.3), (0.07, 0.7, 0.07), wood(WALNUT)),
    FurnitureBox((-3.25, -0.1), (0.07, 0.7, 0.07), wood(WALNUT)),
    FurnitureBox((-2.65, -0.1), (0.07, 0.7, 0.07), wood(WALNUT)),
    FurnitureBox((-3.0, -0.55), (0.3, 0.22, 0.4), dead_leaves((170, 60, 60), 34.0), 0.75, 15.0),
    FurnitureBox((-1.55, -2.0), (0.42, 0.45, 0.42), dead_leaves((90, 96, 140), 34.0), yaw_deg=35.0),
    FurnitureBox((3.35, 0.95), (0.5, 0.45, 1.1), dead_leaves((160, 150, 128), 36.0)),
)
"""None of it comes within 1.8 m of the actor, or between the actor and the camera."""

WALLS = (
    plaster((170, 182, 172)), plaster((198, 176, 142)), planks((168, 124, 84)),
    plaster((214, 212, 204), 6.0), plaster((176, 160, 172)), plaster((160, 176, 190)),
)  # fmt: skip
"""Of the room: low x, high x, floor, ceiling, low z, high z."""

WALLPAPER = repeat_motif(dead_leaves((186, 178, 150), 34.0), 0.30, (170, 160, 132))
TILES = repeat_motif(dead_leaves((150, 156, 160), 30.0), 0.30, (96, 96, 96))
PANELS = repeat_motif(dead_leaves((206, 206, 200), 12.0), 0.60, (150, 150, 150))
VENEER = repeat_motif(dead_leaves((150, 116, 80), 24.0), 0.20, (120, 92, 62))


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class FurnishedRoom:
    """A furnished room.

    Attributes:
        style: "room": nothing repeats; "tiles": on walls, floor and furniture everything does.
        seed: Of the furniture's places, the patterns and the sensor's noise.
    """

    style: RoomStyle
    solids: TexturedBoxes
    seed: int

    @classmethod
    def furnished(cls, style: RoomStyle, size: int, seed: int) -> "FurnishedRoom":
        """Furnish a room, with texels that match images of `size` pixels."""
        generator = np.random.default_rng([seed, 4])
        pieces = [_jitter(piece, generator) for piece in FURNITURE]
        low, high = [np.array(ROOM_LOW_M)], [np.array(ROOM_HIGH_M)]
        for piece in pieces:
            half = 0.5 * np.array(piece.size_m)
            middle = np.array(
                [piece.center_xz_m[0], piece.base_height_m + half[1], piece.center_xz_m[1]]
            )
            low.append(middle - half)
            high.append(middle + half)
        turns = np.deg2rad([0.0] + [piece.yaw_deg for piece in pieces])
        texel_m = float(np.clip(2.9 / size, 0.0018, 0.025))
        boxes = np.array(low), np.array(high)
        texels, pyramid, textures = _paint_faces(style, *boxes, pieces, texel_m, generator)
        return cls(
            style=style,
            seed=seed,
            solids=TexturedBoxes(
                low=boxes[0],
                high=boxes[1],
                yaw_cos_sin=np.column_stack([np.cos(turns), np.sin(turns)]),
                centers_xz=0.5 * (boxes[0] + boxes[1])[:, [0, 2]],
                textures=textures,
                texels=texels,
                mip_levels=pyramid,
                texel_m=texel_m,
                light=FACE_LIGHT,
            ),
        )

    def view_from(self, camera: Camera) -> RoomView:
        """Render the room for a camera; the view of a static camera is cached."""
        key = (camera.camera_from_world.tobytes(), camera.size_px, camera.focal_px)
        if key not in self._view_cache:
            self._view_cache.clear()
            self._view_cache[key] = raycast_boxes(self.solids, camera)
        return self._view_cache[key]

    @cached_property
    def _view_cache(self) -> dict[tuple[bytes, tuple[int, int], tuple[float, float]], RoomView]:
        return {}

    def render(
        self, camera: Camera, feet_world: Float[np.ndarray, "feet 3"], number: int
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Render the room with soft shadows around the feet, and noise by the image's `number`."""
        seen = self.view_from(camera)
        rgb = seen.rgb * _foot_shadows(seen, camera, feet_world)[..., None]
        generator = np.random.default_rng([self.seed, 6, number])
        rgb += SENSOR_NOISE * generator.standard_normal(rgb.shape, dtype=np.float32)
        return np.clip(rgb + 0.5, 0.0, 255.0).astype(np.uint8)


def _foot_shadows(
    seen: RoomView, camera: Camera, feet_world: Float[np.ndarray, "feet 3"]
) -> Float32[np.ndarray, "height width"]:
    """Return the factor of the floor's light about the feet."""
    light = np.ones(seen.depth.shape, dtype=np.float32)
    floor = seen.face == FLOOR_FACE
    height, width = floor.shape
    y, x = np.mgrid[0:height, 0:width][:, floor] + 0.5
    plane = np.stack([x, y], axis=-1) - camera.center_px
    plane /= camera.focal_px
    rays = np.column_stack([plane, np.ones(len(plane))]) @ camera.camera_from_world[:3, :3]
    points = camera.center_world + rays * seen.depth[floor][:, None]
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


def _paint_faces(
    style: RoomStyle,
    low: Float[np.ndarray, "solids 3"],
    high: Float[np.ndarray, "solids 3"],
    pieces: list[FurnitureBox],
    texel_m: float,
    generator: np.random.Generator,
) -> tuple[
    UInt8[np.ndarray, "texels 3"],
    Int64[np.ndarray, "textures levels 3"],
    Int32[np.ndarray, "solids 6"],
]:
    """All faces painted: texels, where each texture's levels begin, and each face's texture."""
    painted, once = [], int(generator.integers(2**31))
    for solid in range(len(low)):
        x, y, z = high[solid] - low[solid]
        for face in range(6):
            wide, tall = ((z, y), (x, z), (x, y))[face // 2]
            size = max(2, round(wide / texel_m)), max(2, round(tall / texel_m))
            pattern = WALLS[face] if solid == 0 else pieces[solid - 1].texture
            if style == "tiles":
                of_room = (WALLPAPER, WALLPAPER, TILES, PANELS, WALLPAPER, WALLPAPER)
                pattern = of_room[face] if solid == 0 else VENEER
                generator = np.random.default_rng([once, solid == 0])
            painted.append(_mip_pyramid(pattern(size, texel_m, generator)))
    count = max(len(levels) for levels in painted)
    pyramid = np.zeros((len(painted), count, 3), dtype=np.int64)
    texels, first = [], 0
    for number, levels in enumerate(painted):
        for level, picture in enumerate(levels):
            pyramid[number, level:] = first, *picture.shape[:2]
            texels.append(picture.reshape(-1, 3))
            first += len(texels[-1])
    textures = np.arange(len(painted), dtype=np.int32).reshape(-1, 6)
    return np.concatenate(texels), pyramid, textures


def _mip_pyramid(
    picture: UInt8[np.ndarray, "rows columns 3"],
) -> list[UInt8[np.ndarray, "_ _ 3"]]:
    """The picture and its halvings, down to a single row or column."""
    levels = [picture]
    while min(levels[-1].shape[:2]) > 1:
        rows, columns = levels[-1].shape[:2]
        half = (max(columns // 2, 1), max(rows // 2, 1))
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return levels
