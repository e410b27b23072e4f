"""Fast-SNARF's own way, compiled for the CPU: BroydenLookup's method for every sample.

Nine starts a sample, one for each of InstantAvatar's bones; each ends as soon as it is within
1e-4 m, after twelve iterations, or when it has left the body (the solver that builds warp cells).
"""

import numpy as np
from jaxtyping import Float, Float32

from avatar.kernels.backend import DensityGrid
from avatar.kernels.cpu_broyden import solve_root
from avatar.kernels.cpu_skin import MATRIX_LANES, transform_point
from avatar.kernels.jit import FAST_MATH, compile_kernel
from avatar.kernels.roots import START_BONES
from avatar.rig import Rig

F32, I32 = np.float32, np.int32


@compile_kernel(cache=False, **FAST_MATH)  # what it calls lies in another folder
def _nearest_density_roots(
    points, transforms, low, nodes_per_m, inverse_bones, occupied, density, cells_per_m, out
):
    blend, inverse = np.empty(MATRIX_LANES, np.float32), np.empty(9, np.float32)
    x = np.empty(3, np.float32)
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        best = F32(-1)
        out[i, 0] = out[i, 1] = out[i, 2] = F32(1e3)
        for bone in range(inverse_bones.shape[0]):
            x[0], x[1], x[2] = transform_point(inverse_bones[bone], px, py, pz)
            if not solve_root(transforms, low, nodes_per_m, points[i], x, blend, inverse, True):
                continue
            a = I32(np.floor((x[0] - low[0]) * cells_per_m[0]))
            b = I32(np.floor((x[1] - low[1]) * cells_per_m[1]))
            c = I32(np.floor((x[2] - low[2]) * cells_per_m[2]))
            if a < 0 or b < 0 or c < 0:
                continue
            if a >= occupied.shape[0] or b >= occupied.shape[1] or c >= occupied.shape[2]:
                continue
            if occupied[a, b, c] != 0 and density[a, b, c] > best:
                best = density[a, b, c]
                out[i, 0], out[i, 1], out[i, 2] = x[0], x[1], x[2]


class BroydenLookup:
    """Root finding in one pose; of several roots the one of highest cached density counts."""

    def __init__(self, rig: Rig, joint_rotations: Float[np.ndarray, "23 3"], grid: DensityGrid) -> None:
        bones = rig.body_from_canonical(joint_rotations)
        flat = np.zeros((24, MATRIX_LANES), dtype=np.float32)
        flat[:, :12] = bones[:, :3].reshape(24, 12)
        inverses = np.linalg.inv(bones[list(START_BONES)])[:, :3].reshape(-1, 12)
        nodes = np.array(rig.weights.shape[:3], dtype=np.float32) - 1
        self._given = (
            np.ascontiguousarray(rig.weights @ flat),
            rig.box_low,
            nodes / (rig.box_high - rig.box_low),
            np.ascontiguousarray(inverses, dtype=np.float32),
            grid.occupied.cpu().numpy(),
            grid.density.cpu().numpy(),
            grid.cells_per_m.cpu().numpy(),
        )

    def __call__(self, points: Float32[np.ndarray, "points 3"]) -> Float32[np.ndarray, "points 3"]:
        """Canonical points; far outside the box where nothing was found."""
        out = np.empty_like(points)
        _nearest_density_roots(points, *self._given, out)
        return out
