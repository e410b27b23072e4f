"""Bakes a trained field into the tables that the player draws."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Int32, Shaped, UInt8, UInt16

from avatar.rig import Rig
from export.bake_skin import skin_of
from export.compiled import grown, mark_reached
from export.errors import ExportRefused
from export.hull import Hull, find_hull
from export.lattice import FAINTEST, FieldAt, Lattice, read_field
from export.tables import (
    BRICK,
    COLOR_STEP,
    DENSITY_STEP,
    NODES,
    SURFEL_BITS,
    THICKNESS_STEP_M,
    Bricks,
    Surfels,
    Tables,
    density_codes,
    rounded,
)
from export.tiers import TIERS
from preprocess.kinematics import body_from_rest

FAINT_SHARE = 0.1
"""The hull's level is at most this share of what the densest percent of a field reaches."""
MARGIN_M = 0.012
"""Bricks reach this far outside of the hull."""
VOXEL_SHARE = 0.53
"""Brick voxels as a share of the field's finest cells: finer ones cost bytes and show nothing."""
FINEST_M, COARSEST_M = 0.0038, 0.006
FINER = 0.62
"""So much finer are voxels where the player is too far from the renderer: 1 to 1.5 dB, and twice
the bytes. An avatar learnt from few photographs weighs less than others."""
HASTY = 1.5
"""How much coarser a package is that cannot wait."""
POSITION_STEP, NORMAL_STEP = 32, 7
"""Codes are rounded to multiples of these, a millimetre and three degrees, so that they deflate
well."""
TUNED = 16
"""Pictures that bricks are fine-tuned on, half a second each."""
EMPTY = (
    f"The avatar is empty: its density is nowhere above {FAINTEST:g} per metre. "
    "No package was written. Train it longer (--resume), or check the masks."
)


@dataclass(frozen=True, kw_only=True)
class BakeConfig:
    """How finely an avatar is baked.

    Attributes:
        voxel_m: Distance between brick voxels.
        surfel_spacing_m: Cell on which the hull is taken; made coarser if there are too many.
        hull_density: Density of the hull's level set, 1/m; less where the whole field is faint.
        tiers: Which qualities the package has; "hq" is always among them.
        tuned: On how many pictures bricks are fine-tuned; 0 for none.
    """

    voxel_m: float = 0.004
    surfel_spacing_m: float = 0.006
    hull_density: float = 20.0
    tiers: tuple[str, ...] = tuple(TIERS)
    tuned: int = 0

    @classmethod
    def for_cells(cls, finest_m: float) -> "BakeConfig":
        """For a field whose finest cells are that long: about two voxels each; fine-tuned."""
        voxel_m = float(np.clip(VOXEL_SHARE * finest_m, FINEST_M, COARSEST_M))
        return cls(voxel_m=voxel_m, tuned=TUNED)

    def finer(self) -> "BakeConfig":
        """For an avatar that these voxels do not show well enough."""
        return replace(self, voxel_m=FINER * self.voxel_m)

    def hasty(self) -> "BakeConfig":
        """For a package that is wanted at once, and that a finer one will follow."""
        return replace(
            self,
            voxel_m=min(HASTY * self.voxel_m, COARSEST_M),
            surfel_spacing_m=HASTY * self.surfel_spacing_m,
            tiers=("hq",),
            tuned=0,
        )


def bake(
    field_at: FieldAt,
    rig: Rig,
    *,
    occupied: UInt8[np.ndarray, "cx cy cz"],
    config: BakeConfig | None = None,
) -> Tables:
    """The tables of a trained field.

    Args:
        field_at: The field; asked only inside `occupied`.
        rig: What moves it.
        occupied: Cells of the rig's box that are not empty, as in `rig.distance`.
        config: How finely.

    Raises:
        ExportRefused: If there is nothing to be seen in the field.
    """
    config = config or BakeConfig()
    return tables_of(read(field_at, rig, occupied=occupied, config=config), rig, config)


def read(
    field_at: FieldAt, rig: Rig, *, occupied: UInt8[np.ndarray, "cx cy cz"], config: BakeConfig
) -> Lattice:
    """The first half of baking: all that the field is asked for. Arguments as of `bake`."""
    if not occupied.any():
        raise ExportRefused(EMPTY)
    return read_field(field_at, rig, occupied, config.voxel_m)


def tables_of(lattice: Lattice, rig: Rig, config: BakeConfig) -> Tables:
    """The second half: numpy and serial kernels only, on whatever thread.

    Args:
        lattice: What the field said.
        rig: What moves it.
        config: How finely.

    Raises:
        ExportRefused: If there is nothing to be seen in the field.
    """
    hull = _hull_that_fits(lattice, config)
    canonical = body_from_rest(rig.rest_joints, rig.parents, rig.canonical_rotations)
    pelvis = canonical[0, :3, :3] @ rig.rest_joints[0] + canonical[0, :3, 3]
    reached = _within_reach(lattice, hull)
    return Tables(
        surfels=_surfels(hull),
        bricks=_bricks(lattice, reached),
        skin=skin_of(rig, hull),
        pelvis=pelvis.astype(np.float32),
        reach_m=_reach(rig),
    )


def _hull_that_fits(lattice: Lattice, config: BakeConfig) -> Hull:
    """The hull, on a lattice so coarse that surfel numbers fit into the z-buffer's keys."""
    visible = lattice.density[lattice.density > FAINTEST]
    if visible.size == 0:
        raise ExportRefused(EMPTY)
    level = min(config.hull_density, FAINT_SHARE * float(np.percentile(visible, 99)))
    spacing_m = config.surfel_spacing_m
    while True:
        hull = find_hull(lattice, level=level, spacing_m=spacing_m)
        if 0 < len(hull.positions) < 1 << SURFEL_BITS:
            return hull
        spacing_m *= 1.02 * max(1.0, len(hull.positions) / (1 << SURFEL_BITS)) ** 0.5


def _reach(rig: Rig) -> float:
    """No visible point gets farther from the pelvis in any pose, metres: bones and clothes."""
    along = np.zeros(len(rig.parents))
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            bone = np.linalg.norm(rig.rest_joints[joint] - rig.rest_joints[parent])
            along[joint] = along[parent] + bone
    return float(along.max() + 0.35)


def _surfels(hull: Hull) -> Surfels:
    low = hull.positions.min(axis=0)
    extent_m = float((hull.positions.max(axis=0) - low).max())
    codes = np.round((hull.positions - low) / extent_m * 65535.0).astype(np.uint16)
    order = np.argsort(_morton(codes), kind="stable")
    thickness = np.round(hull.thickness[order] / THICKNESS_STEP_M)
    return Surfels(
        low=low,
        extent_m=extent_m,
        spacing_m=hull.spacing_m,
        position_codes=rounded(codes[order], POSITION_STEP, 65535),
        normal_codes=np.round(hull.normals[order] * 127.0 / NORMAL_STEP).astype(np.int8)
        * np.int8(NORMAL_STEP),
        thickness_codes=np.clip(thickness, 1, 255).astype(np.uint8),
    )


def _morton(codes: UInt16[np.ndarray, "points 3"]) -> Int32[np.ndarray, "points"]:
    """Place along a Z-order curve (10 bits an axis): neighbours in space lie close in memory."""
    order = np.zeros(len(codes), dtype=np.int32)
    for bit in range(10):
        for axis in range(3):
            set_bits = (codes[:, axis] >> (6 + bit) & 1).astype(np.int32)
            order |= set_bits << (3 * bit + axis)
    return order


def _bricks(lattice: Lattice, reached: Bool[np.ndarray, "x y z"]) -> Bricks:
    """The visible part of the lattice near the hull, cut into bricks."""
    counts = np.array(lattice.density.shape) // BRICK
    places = np.flatnonzero(reached)
    seen = density_codes(lattice.density.ravel()[places])
    seen = np.where(seen > 0, np.maximum(rounded(seen, DENSITY_STEP, 255), DENSITY_STEP), 0)
    codes = np.zeros(lattice.density.shape, dtype=np.uint8)
    codes.ravel()[places] = seen
    visible = grown(codes > 0)
    blocks = _blocks(visible)
    used = blocks.any(axis=(3, 4, 5))
    index = np.zeros(counts, dtype=np.int32)
    index[used] = np.arange(1, used.sum() + 1)
    voxels = np.zeros((used.sum() + 1, NODES, NODES, NODES, 4), dtype=np.uint8)
    voxels[1:, ..., 3] = _blocks(codes)[used]
    shown = blocks[used]
    for channel in range(3):
        values = _blocks(lattice.rgb[..., channel])[used]
        voxels[1:, ..., channel] = rounded(values, COLOR_STEP, 255) * shown
    return Bricks(low=lattice.low, voxel_m=lattice.voxel_m, index=index, voxels=voxels)


def _blocks(
    nodes: Shaped[np.ndarray, "x y z"],
) -> Shaped[np.ndarray, "blocks_x blocks_y blocks_z 9 9 9"]:
    """A lattice's blocks of 8 cells along each side; neighbours share a layer of nodes."""
    blocks = np.lib.stride_tricks.sliding_window_view(nodes, (NODES,) * 3)
    return blocks[::BRICK, ::BRICK, ::BRICK]


def _within_reach(lattice: Lattice, hull: Hull) -> Bool[np.ndarray, "x y z"]:
    """Nodes that rays see: from a little outside of the hull as deep as its thickness."""
    reached = np.zeros(lattice.density.shape, dtype=bool)
    mark_reached(
        reached, lattice.low, np.float32(lattice.voxel_m), hull.positions, hull.normals,
        hull.thickness, np.float32(MARGIN_M),
    )  # fmt: skip
    gap = 1 + 2 * int(np.ceil(hull.spacing_m / lattice.voxel_m))  # between neighbouring surfels
    for _ in range(gap // 2):
        reached = grown(reached)
    return reached
