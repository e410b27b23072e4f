"""Images of boxes: the nearest face along every ray, and its texture, filtered.

A solid is a box that may be turned about the vertical; the first is the room itself, seen from
within. Rays are not normalised: they advance one metre along the camera's axis, so that the
parameter of a hit is its depth. A pixel whose neighbors see another face is cast again with 4 x 4
rays; elsewhere four lookups on the one face do, at one level of its pyramid.

Letters: `o` and `d` are a ray's start and direction; `a` is the axis that a face is perpendicular
to, `u` and `v` are column and row on its texture, in texels.
"""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64, UInt8

from avatar.kernels.kernel_compiler import FAST_MATH, compile_kernel
from capture.camera import Camera


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class TexturedBoxes:
    """Boxes and their textures.

    Attributes:
        low, high: Corners of each box in its own frame, metres, in the world where it is not
            turned; the first is the room.
        yaw_cos_sin: Cosine and sine of its turn about the vertical through its middle.
        centers_xz: The center of each box (x, z).
        textures: Texture of each face (low x, high x, low y, …).
        texels: All textures and their halvings, one after the other.
        mip_levels: Of each texture and level: first texel, rows, columns.
        texel_m: Size of a texel of the finest level.
        light: Factor of the colors of each face.
    """

    low: Float[np.ndarray, "solids 3"]
    high: Float[np.ndarray, "solids 3"]
    yaw_cos_sin: Float[np.ndarray, "solids 2"]
    centers_xz: Float[np.ndarray, "solids 2"]
    textures: Int32[np.ndarray, "solids 6"]
    texels: UInt8[np.ndarray, "texels 3"]
    mip_levels: Int64[np.ndarray, "textures levels 3"]
    texel_m: float
    light: Float32[np.ndarray, "6"]


@final
@dataclass(frozen=True, eq=False, kw_only=True)
class RoomView:
    """Image of the solids by a camera.

    Attributes:
        rgb: Colors, 0 to 255, not rounded.
        depth: Along the camera's axis, at the middle of each pixel, metres.
        face: Six times the solid's number, plus its face's.
    """

    rgb: Float32[np.ndarray, "height width 3"]
    depth: Float32[np.ndarray, "height width"]
    face: Int32[np.ndarray, "height width"]


def raycast_boxes(solids: TexturedBoxes, camera: Camera) -> RoomView:
    """Cast the rays of a camera within the first of the solids."""
    width, height = camera.size_px
    seen = RoomView(
        rgb=np.empty((height, width, 3), dtype=np.float32),
        depth=np.empty((height, width), dtype=np.float32),
        face=np.empty((height, width), dtype=np.int32),
    )
    view = np.empty((4, 3))
    view[0] = camera.center_world
    rotation, (fx, fy), (cx, cy) = (
        camera.camera_from_world[:3, :3], camera.focal_px, camera.center_px,
    )  # fmt: skip
    view[1], view[2] = rotation[0] / fx, rotation[1] / fy
    view[3] = rotation[2] - cx * view[1] - cy * view[2]
    boxes = np.ascontiguousarray(
        np.concatenate([solids.low, solids.high, solids.yaw_cos_sin, solids.centers_xz], axis=1)
    )
    _find_hits(view, boxes, seen.depth, seen.face)
    _sample_textures(
        view, boxes, solids.textures, solids.texels, solids.mip_levels, 1.0 / solids.texel_m,
        solids.light, seen.face, seen.rgb,
    )  # fmt: skip
    return seen


@compile_kernel(**FAST_MATH, inline="always")
def _to_box_frame(
    box: Float[np.ndarray, "10"], x: float, y: float, z: float, point: bool
) -> tuple[float, float, float]:
    """A point or direction of the world in a box's own frame."""
    cosine, sine = box[6], box[7]
    if point:
        x, z = x - box[8], z - box[9]
    own_x, own_z = cosine * x - sine * z, sine * x + cosine * z
    if point:
        own_x, own_z = own_x + box[8], own_z + box[9]
    return own_x, y, own_z


@compile_kernel(**FAST_MATH)
def _hit(
    view: Float[np.ndarray, "4 3"], boxes: Float[np.ndarray, "solids 10"], x: float, y: float
) -> tuple[float, int]:
    """Depth and face of what the ray through a point of the picture hits first."""
    dx = view[3, 0] + x * view[1, 0] + y * view[2, 0]
    dy = view[3, 1] + x * view[1, 1] + y * view[2, 1]
    dz = view[3, 2] + x * view[1, 2] + y * view[2, 2]
    best, face = np.inf, 0
    for axis in range(3):
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        if d != 0.0:
            side = 1 if d > 0.0 else 0
            t = (boxes[0, axis + 3 * side] - view[0, axis]) / d
            if t < best:
                best, face = t, 2 * axis + side
    for solid in range(1, boxes.shape[0]):
        box = boxes[solid]
        o = _to_box_frame(box, view[0, 0], view[0, 1], view[0, 2], True)
        d = _to_box_frame(box, dx, dy, dz, False)
        # slabs: in by the last of the three near planes, out by the first of the far ones
        into, out, entered = 1e-3, best, -1
        for axis in range(3):
            step = d[axis] if d[axis] != 0.0 else 1e-30
            near, far = (box[axis] - o[axis]) / step, (box[axis + 3] - o[axis]) / step
            side = 0
            if near > far:
                near, far, side = far, near, 1
            if near > into:
                into, entered = near, 2 * axis + side
            out = min(out, far)
        if entered >= 0 and into < out:
            best, face = into, 6 * solid + entered
    return best, face


@compile_kernel(**FAST_MATH)
def _find_hits(
    view: Float[np.ndarray, "4 3"],
    boxes: Float[np.ndarray, "solids 10"],
    depth: Float32[np.ndarray, "height width"],
    face: Int32[np.ndarray, "height width"],
) -> None:
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            depth[i, j], face[i, j] = _hit(view, boxes, j + 0.5, i + 0.5)


@compile_kernel(**FAST_MATH)
def _face_coordinates(
    view: Float[np.ndarray, "4 3"],
    boxes: Float[np.ndarray, "solids 10"],
    face: int,
    x: float,
    y: float,
) -> tuple[float, float]:
    """Return the place where the ray through a pixel meets a face's plane: right, down, metres."""
    box, axis, side = boxes[face // 6], (face % 6) // 2, face % 2
    o = _to_box_frame(box, view[0, 0], view[0, 1], view[0, 2], True)
    d = _to_box_frame(
        box,
        view[3, 0] + x * view[1, 0] + y * view[2, 0],
        view[3, 1] + x * view[1, 1] + y * view[2, 1],
        view[3, 2] + x * view[1, 2] + y * view[2, 2],
        False,
    )
    t = (box[axis + 3 * side] - o[axis]) / d[axis]
    if axis == 0:
        return o[2] + t * d[2] - box[2], box[4] - o[1] - t * d[1]
    if axis == 1:
        return o[0] + t * d[0] - box[0], o[2] + t * d[2] - box[2]
    return o[0] + t * d[0] - box[0], box[4] - o[1] - t * d[1]


@compile_kernel(**FAST_MATH)
def _add_texel(
    texels: UInt8[np.ndarray, "texels 3"],
    level: Int64[np.ndarray, "3"],
    u: float,
    v: float,
    weight: float,
    out: Float32[np.ndarray, "3"],
) -> None:
    """Add a bilinear lookup in one level; `u`, `v` in its texels."""
    first, rows, columns = level[0], level[1], level[2]
    u, v = min(max(u - 0.5, 0.0), columns - 1.0), min(max(v - 0.5, 0.0), rows - 1.0)
    left, top = int(u), int(v)
    right, bottom = min(left + 1, columns - 1), min(top + 1, rows - 1)
    u, v = u - left, v - top
    for channel in range(3):
        upper = (1.0 - u) * texels[first + top * columns + left, channel]
        upper += u * texels[first + top * columns + right, channel]
        lower = (1.0 - u) * texels[first + bottom * columns + left, channel]
        lower += u * texels[first + bottom * columns + right, channel]
        out[channel] += weight * ((1.0 - v) * upper + v * lower)


@compile_kernel(**FAST_MATH)
def _add_lookup(
    texels: UInt8[np.ndarray, "texels 3"],
    levels: Int64[np.ndarray, "levels 3"],
    u: float,
    v: float,
    level: float,
    weight: float,
    out: Float32[np.ndarray, "3"],
) -> None:
    """Add a lookup between two levels; `u`, `v` in texels of the finest."""
    level = min(max(level, 0.0), levels.shape[0] - 1.001)
    whole = int(level)
    part = level - whole
    for finer in range(2):
        at = whole + finer
        share = weight * (part if finer == 1 else 1.0 - part)
        if share > 0.0:
            across, down = levels[at, 2] / levels[0, 2], levels[at, 1] / levels[0, 1]
            _add_texel(texels, levels[at], u * across, v * down, share, out)


@compile_kernel(**FAST_MATH)
def _mip_level(
    view: Float[np.ndarray, "4 3"],
    boxes: Float[np.ndarray, "solids 10"],
    face: int,
    x: float,
    y: float,
    step: float,
) -> float:
    """The level of the pyramid for rays that are `step` apart, where steps are 1 texel at 0."""
    u, v = _face_coordinates(view, boxes, face, x, y)
    u_x, v_x = _face_coordinates(view, boxes, face, x + 1.0, y)
    u_y, v_y = _face_coordinates(view, boxes, face, x, y + 1.0)
    # log2 of the texels that one ray's step covers, along the axis on which they are more
    squared = max((u_x - u) ** 2 + (v_x - v) ** 2, (u_y - u) ** 2 + (v_y - v) ** 2)
    return 0.5 * np.log2(max(squared, 1e-12)) + np.log2(step)


@compile_kernel(**FAST_MATH)
def _sample_textures(
    view: Float[np.ndarray, "4 3"],
    boxes: Float[np.ndarray, "solids 10"],
    textures: Int32[np.ndarray, "solids 6"],
    texels: UInt8[np.ndarray, "texels 3"],
    pyramid: Int64[np.ndarray, "textures levels 3"],
    per_metre: float,
    light: Float32[np.ndarray, "6"],
    faces: Int32[np.ndarray, "height width"],
    rgb: Float32[np.ndarray, "height width 3"],
) -> None:
    height, width = faces.shape
    for i in range(height):
        for j in range(width):
            face = faces[i, j]
            inner = True
            for k in range(9):
                row = min(max(i + k // 3 - 1, 0), height - 1)
                column = min(max(j + k % 3 - 1, 0), width - 1)
                inner = inner and faces[row, column] == face
            fine = 2 if inner else 4
            level = _mip_level(view, boxes, face, j + 0.5, i + 0.5, per_metre / fine)
            out = rgb[i, j]
            out[:] = 0.0
            for k in range(fine * fine):
                x, y = j + (k % fine + 0.5) / fine, i + (k // fine + 0.5) / fine
                if not inner:
                    _, face = _hit(view, boxes, x, y)
                    level = _mip_level(view, boxes, face, x, y, per_metre / fine)
                u, v = _face_coordinates(view, boxes, face, x, y)
                _add_lookup(
                    texels, pyramid[textures[face // 6, face % 6]], u * per_metre, v * per_metre,
                    level, light[face % 6] / (fine * fine), out,
                )  # fmt: skip
