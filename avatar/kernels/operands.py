"""The operands of the kernels (`avatar.kernels.operations`): what they read and write."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32, Int64, UInt8
from torch import Tensor

FEATURES_PER_LEVEL = 4
HIDDEN_WIDTH = 64
"""Features per entry. Fixed: the kernels are compiled for it (16 bytes are one vector)."""
PRIMES = (1, 2654435761, 805459861)
"""Müller et al. 2022, eq. 4: h(x) = (⊕ x_i π_i) mod T."""
MAX_LOG_DENSITY = 9.0
"""Log density (log 1/m) at which the activation is clamped."""

EMPTY_SPACE, TV_PAIRS, INTERIOR, CLOSE_PAIRS, OFF_SKIN, HEAD_INTERIOR, SOURCE_PAIRS = range(7)
"""Kinds of points at which priors hold, in the order of `PriorPoints`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HashLevels:
    """Multi-resolution grid (Müller et al. 2022) over a box that need not be a cube.

    Cells are cubes. A level whose vertices fit into the table is stored densely, others are hashed.

    Attributes:
        low: Corner of the box, metres: vertex (0, 0, 0) of every level.
        cells_per_m: Resolution of each level, coarse to fine, 1/m.
        vertex_counts: Vertices along each axis.
        is_dense: 1 where entry (i, j, k) is `i + nx (j + ny k)`, 0 where it is hashed.
        offsets: First entry of each level in the common table; the last is the table's length.
    """

    low: Float32[np.ndarray, "3"]
    cells_per_m: Float32[np.ndarray, "levels"]
    vertex_counts: Int32[np.ndarray, "levels 3"]
    is_dense: Int32[np.ndarray, "levels"]
    offsets: Int64[np.ndarray, "levels+1"]

    @classmethod
    def spanning(
        cls,
        low: Float32[np.ndarray, "3"],
        high: Float32[np.ndarray, "3"],
        *,
        coarsest_m: float,
        finest_m: float,
        levels: int,
        table_size: int,
    ) -> "HashLevels":
        """Levels in geometric progression between two cell sizes, in a box from `low` to `high`, m.

        A hashed level has `table_size` entries, a power of two.
        """
        if table_size & (table_size - 1):
            raise ValueError(f"The table size must be a power of two, not {table_size}.")
        cell_m = np.geomspace(coarsest_m, finest_m, levels)
        extent = (high - low).astype(np.float64)
        counts = np.ceil(extent / cell_m[:, None] - 1e-6).astype(np.int32) + 1
        entries = counts.astype(np.int64).prod(axis=1)
        dense = entries <= table_size
        sizes = np.where(dense, (entries + 7) // 8 * 8, table_size)
        return cls(
            low=low.astype(np.float32),
            cells_per_m=(1.0 / cell_m).astype(np.float32),
            vertex_counts=counts,
            is_dense=dense.astype(np.int32),
            offsets=np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
        )

    def count_from(self, cell_m: float) -> int:
        """Number of the levels whose cells are at least `cell_m` metres wide; at least one."""
        return max(sum(cells * cell_m <= 1.0 for cells in self.cells_per_m.tolist()), 1)

    @property
    def entries(self) -> int:
        """Length of the table."""
        return int(self.offsets[-1])

    @property
    def feature_width(self) -> int:
        """Features of one point, all levels together."""
        return len(self.cells_per_m) * FEATURES_PER_LEVEL


Points = Float32[Tensor, "points 3"]
"""Canonical positions, metres."""
Features = Float32[Tensor, "points width"]
"""Hash-grid features at points."""
HashTable = Float32[Tensor, "entries 4"]
"""The hash grid's entries, level after level."""
NetworkLayers = tuple[
    Float32[Tensor, "width hidden"],
    Float32[Tensor, "hidden"],
    Float32[Tensor, "hidden 4"],
    Float32[Tensor, "4"],
]
"""Weights and biases of the network's two layers."""
NetworkGradients = tuple[
    Float32[np.ndarray, "width hidden"],
    Float32[np.ndarray, "hidden"],
    Float32[np.ndarray, "hidden 4"],
    Float32[np.ndarray, "4"],
]
"""Gradients of these."""
RawOutputs = Float32[Tensor, "samples 4"]
"""The network's outputs: color logits and log density (log 1/m)."""
PremultipliedPixels = Float32[Tensor, "rays 4"]
"""Premultiplied color and alpha of rays."""


class RaySamples(NamedTuple):
    """Canonical samples of a batch of rays, metres, packed ray by ray from `offsets` on.

    `root_rows` are the rows of the roots, in their slots' grids, that they were warped with.
    """

    points: Float32[Tensor, "samples 3"]
    offsets: Int64[Tensor, "rays"]
    counts: Int32[Tensor, "rays"]
    root_rows: Int32[Tensor, "samples"]


class RayBatch(NamedTuple):
    """Rays in the body frame of the frame that each belongs to; directions are unit vectors.

    Each is marched through the grid of its slot. `jitter` is the offset of its sample lattice, in
    steps; the integer part skips samples.
    """

    origins: Float32[Tensor, "rays 3"]
    directions: Float32[Tensor, "rays 3"]
    slots: Int32[Tensor, "rays"]
    jitter: Float32[Tensor, "rays"]


class CorrespondenceTables(NamedTuple):
    """Correspondence grids of several frames, padded, one slot each.

    Attributes:
        packed_cells: `first_row * 8 + bent * 4 + count` of each cell; an empty cell holds 0, or -n
            if all cells within n - 1 cells of it are empty as well.
        roots: Canonical roots and the derivatives of the warp at them.
        low, shape: Corner of each slot's grid, body frame, metres, and its number of cells.
    """

    packed_cells: Int32[Tensor, "slots cells"]
    roots: Float32[Tensor, "slots roots 12"]
    low: Float32[Tensor, "slots 3"]
    shape: Int32[Tensor, "slots 3"]
    cell_m: float


class DensityGrid(NamedTuple):
    """Canonical occupancy, 1 in occupied cells, and the density cached in each cell, 1/m."""

    occupied: UInt8[Tensor, "x y z"]
    density: Float32[Tensor, "x y z"]
    low: Float32[Tensor, "3"]
    cells_per_m: Float32[Tensor, "3"]


class SkinningVolume(NamedTuple):
    """Skinning weights (`avatar.rig.Rig`) at the nodes of the canonical box."""

    weights: Float32[Tensor, "x y z 24"]
    low: Float32[Tensor, "3"]
    nodes_per_m: Float32[Tensor, "3"]


class NormalVolume(NamedTuple):
    """The skin's outward unit normals in the cells of the canonical box."""

    normals: Float32[Tensor, "x y z 3"]
    low: Float32[Tensor, "3"]
    cells_per_m: Float32[Tensor, "3"]


class MarchSettings(NamedTuple):
    """Spacing, end and number of the samples of a ray.

    Attributes:
        opaque_margin_m: Distance that a ray is marched past the depth at which the cached density
            is opaque, metres; infinity for exact rendering. A margin in samples would shrink with
            the step and cut grazing rays in front of the surface.
    """

    sample_step_m: float
    opaque_margin_m: float
    max_samples: int

    @property
    def opaque_margin_steps(self) -> int:
        """The margin in samples."""
        return int(min(self.opaque_margin_m / self.sample_step_m + 1.0, 1e9))


class AdamSettings(NamedTuple):
    """Rates of one step of Adam (Kingma and Ba 2015); `steps` counts this one in."""

    rate: float
    betas: tuple[float, float]
    eps: float
    steps: int

    @property
    def scales(self) -> tuple[float, float]:
        """Factors of the mean and of the squares' root, which correct that both started at 0."""
        first, second = self.betas
        return self.rate / (1.0 - first**self.steps), (1.0 - second**self.steps) ** -0.5


class AdamArrays(NamedTuple):
    """A parameter's gradient, the means of it and of its square, and the numbers themselves."""

    gradient: Float32[np.ndarray, "numbers"]
    mean: Float32[np.ndarray, "numbers"]
    square: Float32[np.ndarray, "numbers"]
    numbers: Float32[np.ndarray, "numbers"]


class PriorPoints(NamedTuple):
    """Points at which priors hold, in lists of one kind each, and the weights of their terms.

    Attributes:
        lists: Points of each kind; of pairs first all ones, then all others.
        pair_weights: Weight of each pair of `SOURCE_PAIRS`.
        weights: Weights of each kind's terms; a kind with one term has zero in the second place.
        max_slope_per_m: Change of log density over distance up to which pairs are not penalised.
    """

    lists: list[Points]
    pair_weights: Float32[Tensor, "pairs"]
    weights: Float32[np.ndarray, "kinds 2"]
    max_slope_per_m: float


class LitSkin(NamedTuple):
    """The skin's normals, and the light that falls on it.

    Attributes:
        light: Coefficients of the factor by which the light changes neutral colors.
        min_length: Length of a ray's mean normal below which the factor is 1.
        bounds: Least and largest factor.
        is_needed: Whether normals are computed; they are zero otherwise.
    """

    volume: NormalVolume
    light: Float32[Tensor, "harmonics"]
    min_length: float
    bounds: tuple[float, float]
    is_needed: bool


class PosedBones(NamedTuple):
    """Skinning, the bones of all slots' poses, and the number of hash levels that pull at them."""

    skinning: SkinningVolume
    bones: Float32[Tensor, "slots 24 12"]
    levels: int


class LossSettings(NamedTuple):
    """Weights of a step's losses, and how its gradients are drawn.

    Attributes:
        faint: Strength of a point's gradient below which it is propagated by chance.
    """

    sample_step_m: float
    alpha_weight: float
    hard_surface_weight: float
    faint: float


class FeatureGradients(NamedTuple):
    """Gradients of points' features, block by block.

    `rows` are the points that have one. `runs` are the first place in these lists, and the number,
    of those of each block; what lies between is undefined.
    """

    rows: Int64[np.ndarray, "points"]
    gradients: Float32[np.ndarray, "points width"]
    runs: Int64[np.ndarray, "blocks 2"]


class LearntRays(NamedTuple):
    """A forward and backward pass over rays and priors.

    Attributes:
        points: Samples of the rays, then the priors' points.
        log_density: Of the rays' samples.
        rendered: Shaded rendering of each ray.
        normals: World normal of what each ray sees; shorter than 1 where it is thin.
        wrenches: Force and moment that each ray's samples exert on every bone; of no rays if no
            poses were given.
        network: Gradients of the network's layers; None if it is frozen.
        strength: Mean strength of the points' gradients.
    """

    points: Points
    log_density: Float32[Tensor, "samples"]
    rendered: PremultipliedPixels
    loss: Float32[Tensor, "rays"]
    normals: Float32[Tensor, "rays 3"]
    wrenches: Float32[Tensor, "wrenched 24 6"]
    network: NetworkGradients | None
    features: FeatureGradients
    strength: float
