"""Lossless coding of tables as byte streams that deflate well: differences between neighbors."""

import zlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int32, Shaped, UInt8, UInt16

from export.package.player_tables import (
    BRICK_NODES,
    BRICK_SIZE,
    WEIGHT_SCALE,
    BrickTable,
    PlayerTables,
    SkinningGrid,
    SurfelTable,
)


@dataclass(frozen=True, eq=False, kw_only=True)
class TableLayout:
    """Sizes and scales of the streams, as in the tables they are of. Lengths in metres.

    Attributes:
        bricks: Number of bricks without the empty one.
        brick_counts: Blocks of the grid along x, y, z.
        skin_nodes: Number of stored nodes of the skinning grid.
        skin_counts: Nodes of that grid along x, y, z.
    """

    surfels: int
    surfel_low: tuple[float, float, float]
    surfel_extent_m: float
    surfel_spacing_m: float
    bricks: int
    brick_counts: tuple[int, int, int]
    brick_low: tuple[float, float, float]
    voxel_m: float
    skin_nodes: int
    skin_counts: tuple[int, int, int]
    skin_low: tuple[float, float, float]
    skin_step_m: tuple[float, float, float]
    pelvis: tuple[float, float, float]
    reach_m: float

    @classmethod
    def of(cls, tables: PlayerTables) -> "TableLayout":
        """Describe tables."""
        surfels, bricks, skin = tables.surfels, tables.bricks, tables.skinning
        x, y, z = bricks.index.shape
        i, j, k = skin.index.shape
        return cls(
            surfels=len(surfels),
            surfel_low=_triple(surfels.low),
            surfel_extent_m=surfels.extent_m,
            surfel_spacing_m=surfels.spacing_m,
            bricks=len(bricks.voxels) - 1,
            brick_counts=(x, y, z),
            brick_low=_triple(bricks.low),
            voxel_m=bricks.voxel_m,
            skin_nodes=skin.weight_codes.shape[1] - 1,
            skin_counts=(i, j, k),
            skin_low=_triple(skin.low),
            skin_step_m=_triple(skin.step_m),
            pelvis=_triple(tables.pelvis),
            reach_m=tables.reach_m,
        )

    def stream_types(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """Return element type and shape of every stream."""
        x, y, z = self.brick_counts
        i, j, k = self.skin_counts
        return {
            "blocks": ("u1", ((x * y * z + 7) // 8,)),
            "voxels": ("u1", (4, self.bricks, BRICK_SIZE, BRICK_SIZE, BRICK_SIZE)),
            "positions": ("<u2", (3, self.surfels)),
            "normals": ("i1", (3, self.surfels)),
            "thickness": ("u1", (self.surfels,)),
            "skin_nodes": ("u1", ((i * j * k + 7) // 8,)),
            "skin_weights": ("<u2", (24, self.skin_nodes)),
        }


def _triple(vector: Shaped[np.ndarray, "3"]) -> tuple[float, float, float]:
    x, y, z = (float(component) for component in vector)
    return x, y, z


def encode_tables(tables: PlayerTables) -> dict[str, bytes]:
    """Encode tables as streams; `TableLayout.of(tables)` has their types and shapes."""
    surfels, bricks = tables.surfels, tables.bricks
    core = _decorrelate_colors(
        np.moveaxis(bricks.voxels[1:, :BRICK_SIZE, :BRICK_SIZE, :BRICK_SIZE], -1, 0)
    )
    arrays = {
        "blocks": np.packbits(bricks.index.ravel() > 0),
        "voxels": _delta_encode(core, axes=(-3, -2, -1)),
        "positions": _delta_encode(surfels.position_codes.T, axes=(-1,)),
        "normals": surfels.normal_codes.T,
        "thickness": surfels.thickness_codes,
        "skin_nodes": np.packbits(tables.skinning.index.ravel() > 0),
        "skin_weights": tables.skinning.weight_codes[:, 1:],
    }
    layout = TableLayout.of(tables).stream_types()
    return {name: array.astype(layout[name][0]).tobytes() for name, array in arrays.items()}


def estimate_brick_bytes(bricks: BrickTable) -> float:
    """Estimate the deflated size of the bricks' voxels, bytes, from every eighth brick."""
    core = bricks.voxels[1::8, :BRICK_SIZE, :BRICK_SIZE, :BRICK_SIZE]
    codes = _delta_encode(_decorrelate_colors(np.moveaxis(core, -1, 0)), axes=(-3, -2, -1))
    share = len(core) / max(len(bricks.voxels) - 1, 1)
    return len(zlib.compress(codes.tobytes())) / max(share, 1e-9)


def decode_tables(streams: dict[str, bytes], layout: TableLayout) -> PlayerTables:
    """Decode the streams of `encode_tables`; `ValueError` if they are of other sizes."""
    arrays = {
        name: np.frombuffer(streams[name], dtype=dtype).reshape(shape)
        for name, (dtype, shape) in layout.stream_types().items()
    }
    return PlayerTables(
        surfels=SurfelTable(
            low=np.array(layout.surfel_low, dtype=np.float32),
            extent_m=layout.surfel_extent_m,
            spacing_m=layout.surfel_spacing_m,
            position_codes=np.cumsum(arrays["positions"], axis=-1, dtype=np.uint16).T,
            normal_codes=arrays["normals"].T,
            thickness_codes=arrays["thickness"],
        ),
        bricks=_decode_bricks(arrays["blocks"], arrays["voxels"], layout),
        skinning=_decode_skinning(arrays["skin_nodes"], arrays["skin_weights"], layout),
        pelvis=np.array(layout.pelvis, dtype=np.float32),
        reach_m=layout.reach_m,
    )


def _delta_encode(
    codes: Shaped[np.ndarray, "*shape"], *, axes: tuple[int, ...]
) -> Shaped[np.ndarray, "*shape"]:
    """Subtract from each code the one before it along each axis in turn, modulo its type."""
    for axis in axes:
        codes = np.diff(codes, axis=axis, prepend=codes.dtype.type(0))
    return codes


def cumsum_cubes(codes: UInt8[np.ndarray, "*cubes 8 8 8"]) -> UInt8[np.ndarray, "*cubes 8 8 8"]:
    """Sum cumulatively along the last three axes: a third of the time of numpy's cumsum."""
    sums = codes.copy()
    for axis in (-3, -2, -1):
        layers = np.moveaxis(sums, axis, 0)
        for layer in range(1, BRICK_SIZE):
            layers[layer] += layers[layer - 1]
    return sums


def _decorrelate_colors(voxels: UInt8[np.ndarray, "4 *nodes"]) -> UInt8[np.ndarray, "4 *nodes"]:
    """Subtract green from red and blue, modulo 256, as the channels correlate."""
    red, green, blue, density = voxels
    return np.stack([red - green, green, blue - green, density])


def _decode_bricks(
    blocks: UInt8[np.ndarray, "bytes"],
    voxels: UInt8[np.ndarray, "4 bricks 8 8 8"],
    layout: TableLayout,
) -> BrickTable:
    index = _number_set_bits(blocks, layout.brick_counts, layout.bricks)
    core = np.moveaxis(cumsum_cubes(voxels), 0, -1)
    core[..., [0, 2]] += core[..., 1:2]  # as `_decorrelate_colors` subtracted green
    whole = add_border_voxels(index, np.pad(core, [(1, 0), *[(0, 0)] * 4]))
    low = np.array(layout.brick_low, dtype=np.float32)
    return BrickTable(low=low, voxel_m=layout.voxel_m, index=index, voxels=whole)


def add_border_voxels(
    index: Int32[np.ndarray, "bx by bz"], own_voxels: UInt8[np.ndarray, "bricks 8 8 8 4"]
) -> UInt8[np.ndarray, "bricks 9 9 9 4"]:
    """Append to bricks' own voxels the first layers of their next neighbors; brick 0 is empty."""
    whole = np.zeros((len(own_voxels), BRICK_NODES, BRICK_NODES, BRICK_NODES, 4), dtype=np.uint8)
    padded = np.pad(index, [(0, 1)] * 3)
    place = np.argwhere(index > 0)
    for step in np.ndindex(2, 2, 2):  # the brick itself, then its next neighbors
        neighbor = padded[tuple((place + step).T)]
        target = tuple(slice(BRICK_SIZE, BRICK_NODES) if s else slice(0, BRICK_SIZE) for s in step)
        source = tuple(slice(0, 1) if s else slice(0, BRICK_SIZE) for s in step)
        whole[(slice(1, None), *target)] = own_voxels[neighbor][(slice(None), *source)]
    return whole


def _decode_skinning(
    nodes: UInt8[np.ndarray, "bytes"], weights: UInt16[np.ndarray, "24 nodes"], layout: TableLayout
) -> SkinningGrid:
    codes = np.zeros((24, layout.skin_nodes + 1), dtype=np.uint16)
    codes[0, 0] = WEIGHT_SCALE
    codes[:, 1:] = weights
    return SkinningGrid(
        low=np.array(layout.skin_low, dtype=np.float32),
        step_m=np.array(layout.skin_step_m, dtype=np.float32),
        index=_number_set_bits(nodes, layout.skin_counts, layout.skin_nodes),
        weight_codes=codes,
    )


def _number_set_bits(
    bits: UInt8[np.ndarray, "bytes"], counts: tuple[int, int, int], expected: int
) -> Int32[np.ndarray, "x y z"]:
    """Number the set bits from 1 in C order; 0 for the others."""
    used = np.unpackbits(bits)[: int(np.prod(counts))].astype(np.int32)
    if used.sum() != expected:
        raise ValueError(f"{used.sum()} places of a grid {counts} are marked, {expected} stored")
    return (np.cumsum(used, dtype=np.int32) * used).reshape(counts)
