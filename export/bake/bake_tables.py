"""Baking: a trained field and its rig as the tables that the player draws."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int32, Int64, Shaped, UInt8, UInt16

from avatar.rig import Rig
from export.bake.proxy_surface import (
    MIN_DENSITY,
    FieldFunction,
    FieldGrid,
    ProxySurface,
    extract_proxy_surface,
    mark_visible_nodes,
    sample_field_grid,
)
from export.bake.voxel_grid import dilate
from export.package.player_tables import (
    BRICK_NODES,
    BRICK_SIZE,
    COLOR_CODE_STEP,
    DENSITY_CODE_STEP,
    SURFEL_BITS,
    THICKNESS_STEP_M,
    WEIGHT_SCALE,
    BrickTable,
    PlayerTables,
    SkinningGrid,
    SurfelTable,
    encode_density,
    round_codes,
)
from preprocess.body.kinematics import body_from_rest


class ExportRefused(RuntimeError):  # noqa: N818 - names what happened
    """The avatar is empty, or its graph does not draw what its rays see; no package is written."""


PROBE_SPACING_M = 0.012
"""Distance between probes along a normal, metres: much less than a cell of the rig's grid."""


def bake_skinning(rig: Rig, surface: ProxySurface) -> SkinningGrid:
    """Keep the cells of the rig's skinning grid in which rays may be marched."""
    shape = np.array(rig.weights.shape[:3])
    step_m = (rig.box_high - rig.box_low) / (shape - 1)
    depths = np.arange(-0.012, float(surface.thickness.max()) + PROBE_SPACING_M, PROBE_SPACING_M)
    within = depths <= surface.thickness[:, None] + PROBE_SPACING_M
    points = surface.positions[:, None] - surface.normals[:, None] * depths[:, None].astype(
        np.float32
    )
    cells = np.floor((points[within] - rig.box_low) / step_m).astype(np.int64)
    touched = np.zeros(shape - 1, dtype=bool)
    touched[tuple(np.clip(cells, 0, shape - 2).T)] = True
    cells = np.argwhere(touched)
    first, last = cells.min(axis=0), cells.max(axis=0) + 2
    stored = np.zeros(last - first, dtype=bool)
    for corner in np.ndindex(2, 2, 2):
        stored[tuple((cells - first + corner).T)] = True
    index = np.zeros(stored.shape, dtype=np.int32)
    index[stored] = np.arange(1, stored.sum() + 1)
    part = rig.weights[first[0] : last[0], first[1] : last[1], first[2] : last[2]]
    codes = np.zeros((24, stored.sum() + 1), dtype=np.uint16)
    codes[0, 0] = WEIGHT_SCALE
    codes[:, 1:] = encode_weights(part[stored]).T
    return SkinningGrid(
        low=(rig.box_low + first * step_m).astype(np.float32),
        step_m=step_m.astype(np.float32),
        index=index,
        weight_codes=codes,
    )


def encode_weights(weights: Float32[np.ndarray, "nodes 24"]) -> UInt16[np.ndarray, "nodes 24"]:
    """Quantize weights to rows that sum to `WEIGHT_SCALE`; the largest weight takes the rest."""
    codes: Int64[np.ndarray, "nodes 24"] = np.round(weights * WEIGHT_SCALE).astype(np.int64)
    rows = np.arange(len(codes))
    codes[rows, codes.argmax(axis=1)] += WEIGHT_SCALE - codes.sum(axis=1)
    return codes.astype(np.uint16)


THICK_FAINT_FRACTION = 0.04
"""`BakeConfig.faint_fraction` of thick fields: haze of 10/m about a core of 120/m is seen."""
MIN_VOXEL_M = 0.0038
"""Smallest voxel that follows from a field's samples, metres."""
MAX_VOXEL_M = 0.006
"""Largest voxel, metres."""
BRICK_BYTES = 2.4e6
"""Deflated size of the bricks of a thick field, about: a package of less than 4 MB."""
VOXEL_FACTORS = (0.62, 1.6)
"""Bounds of the factor on voxels of a thick field. Finer ones gain 1 to 1.5 dB on the light avatar
of few photographs; in fog 0.3 dB for three times the bytes."""
NORMAL_CODE_STEP = 7
"""Multiple to which normal codes are rounded, about three degrees, so that they deflate well."""
FINE_TUNING_PICTURES = 10
"""Pictures on which bricks are fine-tuned, a second each: both tiers learn from all of them."""
EMPTY_AVATAR_MESSAGE = (
    f"The avatar is empty: its density is nowhere above {MIN_DENSITY:g} per metre. "
    "No package was written. Train it longer (--resume), or check the masks."
)
"""Message of `ExportRefused` for an empty field."""


@dataclass(frozen=True, kw_only=True)
class BakeConfig:
    """Resolution and content of a package.

    Attributes:
        surfel_spacing_m: Cell of the surface's extraction; enlarged until surfels can be numbered.
        surface_density: Density of the surface, 1/m; less where the whole field is faint.
        faint_fraction: Upper bound of that, as a fraction of visible density's 99th percentile.
        fine_tuning_pictures: Pictures on which bricks are fine-tuned; 0 for no fine-tuning.
    """

    voxel_m: float = 0.004
    surfel_spacing_m: float = 0.006
    surface_density: float = 20.0
    faint_fraction: float = 0.1
    fine_tuning_pictures: int = 0

    @classmethod
    def for_sample_step(cls, sample_step_m: float) -> "BakeConfig":
        """Choose voxels of about half the distance of samples, within bounds, and fine-tuning."""
        # finer voxels cost bytes and show nothing, also where cells are finer for the head
        voxel_m = float(np.clip(0.53 * sample_step_m, MIN_VOXEL_M, MAX_VOXEL_M))
        return cls(voxel_m=voxel_m, fine_tuning_pictures=FINE_TUNING_PICTURES)

    def for_thick_field(self, brick_bytes: float) -> "BakeConfig":
        """Add haze; scale voxels until bricks, now of `brick_bytes`, take about `BRICK_BYTES`."""
        factor = (brick_bytes / BRICK_BYTES) ** (1.0 / 2.5)  # they grow by this power
        factor = float(np.clip(factor, *VOXEL_FACTORS))
        return replace(
            self,
            voxel_m=factor * self.voxel_m,
            surface_density=12.0,  # 1/m: ten centimetres hide 70 % of what is behind
            faint_fraction=THICK_FAINT_FRACTION,
        )


def sample_field(
    field_at: FieldFunction,
    rig: Rig,
    *,
    occupied: UInt8[np.ndarray, "cx cy cz"],
    config: BakeConfig,
) -> FieldGrid:
    """Evaluate the field, the first half of baking; `ExportRefused` if it is empty."""
    if not occupied.any():
        raise ExportRefused(EMPTY_AVATAR_MESSAGE)
    return sample_field_grid(field_at, rig, occupied, config.voxel_m)


def bake_tables(grid: FieldGrid, rig: Rig, config: BakeConfig) -> PlayerTables:
    """Bake sampled density and color, the second half; numpy and serial kernels, on any threads."""
    surface = _surface_within_surfel_limit(grid, config)
    canonical = body_from_rest(rig.rest_joints, rig.parents, rig.canonical_rotations)
    pelvis = canonical[0, :3, :3] @ rig.rest_joints[0] + canonical[0, :3, 3]
    with ThreadPoolExecutor(1) as beside:
        skinning = beside.submit(bake_skinning, rig, surface)
        surfels = beside.submit(_encode_surfels, surface)
        bricks = _encode_bricks(grid, _visible_nodes(grid, surface))
    return PlayerTables(
        surfels=surfels.result(),
        bricks=bricks,
        skinning=skinning.result(),
        pelvis=pelvis.astype(np.float32),
        reach_m=_max_reach_m(rig),
    )


def _surface_within_surfel_limit(grid: FieldGrid, config: BakeConfig) -> ProxySurface:
    """Extract the surface on the finest grid whose surfel numbers fit into z-buffer keys."""
    visible = grid.density[grid.density > MIN_DENSITY]
    if visible.size == 0:
        raise ExportRefused(EMPTY_AVATAR_MESSAGE)
    faint = config.faint_fraction * float(np.percentile(visible, 99))
    level = min(config.surface_density, faint)
    spacing_m = config.surfel_spacing_m
    while True:
        surface = extract_proxy_surface(grid, level=level, spacing_m=spacing_m)
        if 0 < len(surface.positions) < 1 << SURFEL_BITS:
            return surface
        spacing_m *= 1.02 * max(1.0, len(surface.positions) / (1 << SURFEL_BITS)) ** 0.5


def _max_reach_m(rig: Rig) -> float:
    """Bound poses' reach, metres: the longest chain of bones, 0.35 m for head, hands, clothes."""
    along = np.zeros(len(rig.parents))
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            bone = np.linalg.norm(rig.rest_joints[joint] - rig.rest_joints[parent])
            along[joint] = along[parent] + bone
    return float(along.max() + 0.35)


def _encode_surfels(surface: ProxySurface) -> SurfelTable:
    """Quantize the surface's points in Morton order."""
    low = surface.positions.min(axis=0)
    extent_m = float((surface.positions.max(axis=0) - low).max())
    codes = np.round((surface.positions - low) / extent_m * 65535.0).astype(np.uint16)
    order = np.argsort(_morton_order(codes), kind="stable")
    thickness = np.round(surface.thickness[order] / THICKNESS_STEP_M)
    return SurfelTable(
        low=low,
        extent_m=extent_m,
        spacing_m=surface.spacing_m,
        position_codes=round_codes(codes[order], 32, 65535),  # about a millimetre: deflates well
        normal_codes=np.round(surface.normals[order] * 127.0 / NORMAL_CODE_STEP).astype(np.int8)
        * np.int8(NORMAL_CODE_STEP),
        thickness_codes=np.clip(thickness, 1, 255).astype(np.uint8),
    )


def _morton_order(codes: UInt16[np.ndarray, "points 3"]) -> Int32[np.ndarray, "points"]:
    """Return positions on a Z-order curve, 10 bits an axis: neighbors lie close in memory."""
    order = np.zeros(len(codes), dtype=np.int32)
    for bit in range(10):
        for axis in range(3):
            set_bits = (codes[:, axis] >> (6 + bit) & 1).astype(np.int32)
            order |= set_bits << (3 * bit + axis)
    return order


def _encode_bricks(grid: FieldGrid, reached: Bool[np.ndarray, "x y z"]) -> BrickTable:
    """Cut the visible nodes of the grid into bricks."""
    counts = np.array(grid.density.shape) // BRICK_SIZE
    places = np.flatnonzero(reached)
    seen = encode_density(grid.density.ravel()[places])
    seen = np.where(
        seen > 0, np.maximum(round_codes(seen, DENSITY_CODE_STEP, 255), DENSITY_CODE_STEP), 0
    )
    codes = np.zeros(grid.density.shape, dtype=np.uint8)
    codes.ravel()[places] = seen
    visible = dilate(codes > 0)
    used = visible
    for axis, count in enumerate(counts):
        first = np.arange(count) * BRICK_SIZE
        used = np.logical_or.reduceat(used, first, axis) | used.take(first + BRICK_SIZE, axis)
    index = np.zeros(counts, dtype=np.int32)
    index[used] = np.arange(1, used.sum() + 1)
    voxels = np.zeros((used.sum() + 1, BRICK_NODES, BRICK_NODES, BRICK_NODES, 4), dtype=np.uint8)
    voxels[1:, ..., 3] = _overlapping_blocks(codes)[used]
    shown = _overlapping_blocks(visible)[used]
    rounded = round_codes(np.arange(256, dtype=np.uint8), COLOR_CODE_STEP, 255)
    for channel in range(3):
        values = _overlapping_blocks(grid.rgb[..., channel])[used]
        voxels[1:, ..., channel] = rounded[values] * shown
    return BrickTable(low=grid.low, voxel_m=grid.voxel_m, index=index, voxels=voxels)


def _overlapping_blocks(
    nodes: Shaped[np.ndarray, "x y z"],
) -> Shaped[np.ndarray, "blocks_x blocks_y blocks_z 9 9 9"]:
    """View a grid as blocks of 8 cells along each side; neighbors share a layer of nodes."""
    blocks = np.lib.stride_tricks.sliding_window_view(nodes, (BRICK_NODES,) * 3)
    return blocks[::BRICK_SIZE, ::BRICK_SIZE, ::BRICK_SIZE]


def _visible_nodes(grid: FieldGrid, surface: ProxySurface) -> Bool[np.ndarray, "x y z"]:
    """Mark the nodes that rays see: from 12 mm outside the surface to its thickness."""
    reached = np.zeros(grid.density.shape, dtype=bool)
    mark_visible_nodes(
        reached, grid.low, np.float32(grid.voxel_m), surface.positions, surface.normals,
        surface.thickness, np.float32(0.012),
    )  # fmt: skip
    gap = 1 + 2 * int(np.ceil(surface.spacing_m / grid.voxel_m))  # between neighboring surfels
    for _ in range(gap // 2):
        reached = dilate(reached)
    return reached
