"""Levels of the hash grid: their resolution and the layout of their entries in the table."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int32, Int64

FEATURES_PER_LEVEL = 4
"""Features per entry. Fixed: the kernels are compiled for it (16 bytes are one vector)."""
PRIMES = (1, 2654435761, 805459861)
"""Müller et al. 2022, eq. 4: h(x) = (⊕ x_i π_i) mod T."""


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
        """Levels in geometric progression between two cell sizes.

        Args:
            low, high: Corners of the box, metres.
            coarsest_m, finest_m: Cell sizes of the first and last level, metres.
            levels: Number of levels.
            table_size: Entries of a hashed level, a power of two.
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

    def coarser_than(self, cell_m: float) -> "HashLevels":
        """The levels whose cells are at least so large, metres; the coarsest in any case."""
        kept = max(int((1.0 / self.cells_per_m >= cell_m).sum()), 1)
        return replace(
            self,
            cells_per_m=self.cells_per_m[:kept],
            vertex_counts=self.vertex_counts[:kept],
            is_dense=self.is_dense[:kept],
            offsets=self.offsets[: kept + 1],
        )

    @property
    def entries(self) -> int:
        """Length of the table."""
        return int(self.offsets[-1])

    @property
    def feature_width(self) -> int:
        """Features of one point, all levels together."""
        return len(self.cells_per_m) * FEATURES_PER_LEVEL
