"""All canonical roots of posed samples by Broyden's method (Fast-SNARF), compiled."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int32
from numba import prange
from torch import Tensor

from avatar.kernels.kernel_compiler import FAST_MATH, compile_kernel
from avatar.kernels.numba_skinning import MATRIX_LANES, solve_root, transform_point

F32 = np.float32
START_BONES = (0, 1, 2, 4, 5, 16, 17, 18, 19)
"""Joints of Fast-SNARF: a search starts where each bone's inverse transform puts the sample."""
SAME_ROOT_M = 1e-3
"""Distance below which two roots are the same, metres."""
SAMPLES_PER_CHUNK = 256
"""Samples of a parallel task, which share its buffers."""


class BlendedTransforms(NamedTuple):
    """Blended skinning transforms of several poses, and the bones at which searches start.

    Attributes:
        blended: Σ w_j B_j at the nodes of the canonical box.
        low: Corner of the box, metres.
        nodes_per_m: Nodes per metre along each axis.
        inverses: Transforms from the body to the canonical frame of `START_BONES`.
    """

    blended: Float32[Tensor, "slots x y z 12"]
    low: Float32[Tensor, "3"]
    nodes_per_m: Float32[Tensor, "3"]
    inverses: Float32[Tensor, "slots starts 12"]


def find_all_roots(
    points: Float32[Tensor, "points 3"],
    slots: Int32[Tensor, "points"],
    poses: BlendedTransforms,
) -> tuple[Float32[Tensor, "points starts 3"], Bool[Tensor, "points starts"]]:
    """The point at which each of Fast-SNARF's searches ends, and whether it is a new root."""
    roots = torch.empty(len(points), poses.inverses.shape[1], 3)
    valid = torch.empty(roots.shape[:2], dtype=torch.bool)
    find_all_roots_numba(
        points.numpy(), slots.numpy(), *(part.numpy() for part in poses),
        roots.numpy(), valid.numpy(),
    )  # fmt: skip
    return roots, valid


@compile_kernel(parallel=True, **FAST_MATH)
def find_all_roots_numba(points, slots, blended, low, nodes_per_m, inverses, roots, valid):
    """The point at which each search of each sample ends, and whether it is a new root."""
    count = points.shape[0]
    for chunk in prange((count + SAMPLES_PER_CHUNK - 1) // SAMPLES_PER_CHUNK):
        blend, inverse = np.empty(MATRIX_LANES, np.float32), np.empty(9, np.float32)
        x = np.empty(3, np.float32)
        for i in range(chunk * SAMPLES_PER_CHUNK, min((chunk + 1) * SAMPLES_PER_CHUNK, count)):
            slot = slots[i]
            px, py, pz = points[i, 0], points[i, 1], points[i, 2]
            for start in range(inverses.shape[1]):
                x[0], x[1], x[2] = transform_point(inverses[slot, start], px, py, pz)
                found = solve_root(
                    blended[slot], low, nodes_per_m, points[i], x, blend, inverse, True
                )
                roots[i, start, 0], roots[i, start, 1], roots[i, start, 2] = x[0], x[1], x[2]
                for other in range(start):
                    dx = roots[i, other, 0] - x[0]
                    dy = roots[i, other, 1] - x[1]
                    dz = roots[i, other, 2] - x[2]
                    if valid[i, other] and dx * dx + dy * dy + dz * dz < F32(SAME_ROOT_M**2):
                        found = False
                valid[i, start] = found
