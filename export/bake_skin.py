"""The part of a rig's skinning volume that a package needs: cells in which rays are followed."""

import numpy as np
from jaxtyping import Float32, Int64, UInt16

from avatar.rig import Rig
from export.hull import ProxySurface
from export.tables import WEIGHT_SCALE, SkinningGrid

OUTER_MARGIN_M = 0.012
"""Rays begin at most about so far outside of the hull."""
PROBE_SPACING_M = 0.012
"""Distance between the points along a normal that are looked at: much less than a cell."""


def bake_skinning(rig: Rig, surface: ProxySurface) -> SkinningGrid:
    """The skin under a hull, as deep as one sees.

    Args:
        rig: Whose.
        hull: The hull.
    """
    shape = np.array(rig.weights.shape[:3])
    step_m = (rig.box_high - rig.box_low) / (shape - 1)
    depths = np.arange(-OUTER_MARGIN_M, float(surface.thickness.max()) + PROBE_SPACING_M, PROBE_SPACING_M)
    within = depths <= surface.thickness[:, None] + PROBE_SPACING_M
    points = surface.positions[:, None] - surface.normals[:, None] * depths[:, None].astype(np.float32)
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
    """Weights × `WEIGHT_SCALE`, rounded so that each row sums to it (the largest makes up)."""
    codes: Int64[np.ndarray, "nodes 24"] = np.round(weights * WEIGHT_SCALE).astype(np.int64)
    rows = np.arange(len(codes))
    codes[rows, codes.argmax(axis=1)] += WEIGHT_SCALE - codes.sum(axis=1)
    return codes.astype(np.uint16)
