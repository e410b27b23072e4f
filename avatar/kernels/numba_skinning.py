"""Linear blend skinning at one point and its root by Broyden's method, compiled for the CPU."""

import math

import numpy as np

from avatar.kernels.kernel_compiler import INLINED, NO_ALLOCATION, compile_kernel

F32, U32 = np.float32, np.uint32
MATRIX_LANES = 16
"""Floats that a 3×4 matrix takes in a volume of transforms: as many as a register and a cache line
hold. The last four are nothing."""
MAX_PROBE_CORRECTION_M = 0.03
"""Largest motion of a probe, metres; one that would move farther lies beyond a fold and stays."""


@compile_kernel(**INLINED)
def interpolate_at(volume, low, nodes_per_m, x, y, z, channels, out):
    """Trilinear values of a volume (x, y, z, channels) at a point; the border's outside."""
    a = min(max((x - low[0]) * nodes_per_m[0], F32(0)), F32(volume.shape[0] - 1.001))
    b = min(max((y - low[1]) * nodes_per_m[1], F32(0)), F32(volume.shape[1] - 1.001))
    c = min(max((z - low[2]) * nodes_per_m[2], F32(0)), F32(volume.shape[2] - 1.001))
    i, j, k = U32(a), U32(b), U32(c)  # unsigned: spares the check for negative indices
    i1, j1, k1 = i + U32(1), j + U32(1), k + U32(1)
    a, b, c = a - F32(i), b - F32(j), c - F32(k)
    u, v, w = F32(1) - a, F32(1) - b, F32(1) - c
    w0, w1, w2, w3 = u * v * w, u * v * c, u * b * w, u * b * c
    w4, w5, w6, w7 = a * v * w, a * v * c, a * b * w, a * b * c
    for q in range(channels):
        out[q] = (
            w0 * volume[i, j, k, q] + w1 * volume[i, j, k1, q]
            + w2 * volume[i, j1, k, q] + w3 * volume[i, j1, k1, q]
            + w4 * volume[i1, j, k, q] + w5 * volume[i1, j, k1, q]
            + w6 * volume[i1, j1, k, q] + w7 * volume[i1, j1, k1, q]
        )  # fmt: skip


@compile_kernel(**INLINED)
def transform_point(m, x, y, z):
    """A point moved by a row-major 3×4 matrix."""
    return (
        m[0] * x + m[1] * y + m[2] * z + m[3],
        m[4] * x + m[5] * y + m[6] * z + m[7],
        m[8] * x + m[9] * y + m[10] * z + m[11],
    )


@compile_kernel(**NO_ALLOCATION)
def blend_nodes(nodes, first, joints, shares, bones, transforms):
    """Blends the bones' matrices at some nodes of a volume (flat, `MATRIX_LANES`), in place.

    The bones that move `nodes[n]`, and their shares, stand from `first[n]` to `first[n + 1]`.
    `bones` is (24, `MATRIX_LANES`).
    """
    for n in range(nodes.shape[0]):
        node = nodes[n]
        for q in range(MATRIX_LANES):
            transforms[node, q] = shares[first[n]] * bones[joints[first[n]], q]
        for e in range(first[n] + 1, first[n + 1]):
            joint, share = joints[e], shares[e]
            for q in range(MATRIX_LANES):
                transforms[node, q] += share * bones[joint, q]


TOLERANCE_M = 1e-4
ITERATIONS = 12
LONGEST_STEP_M = 0.3


@compile_kernel(**INLINED)
def invert_rotation(m, out):
    """Inverse of the 3×3 part of a row-major 3×4 matrix."""
    a, b, c, d, e, f, g, h, i = m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]
    # adjugate by determinant, which is kept away from zero
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    det = a * p + b * q + c * r
    s = F32(1) / (det if abs(det) > F32(1e-6) else F32(1e-6))
    out[0], out[1], out[2] = p * s, (c * h - b * i) * s, (b * f - c * e) * s
    out[3], out[4], out[5] = q * s, (a * i - c * g) * s, (c * d - a * f) * s
    out[6], out[7], out[8] = r * s, (b * g - a * h) * s, (a * e - b * d) * s


@compile_kernel(**INLINED)
def rotate_vector(m, x, y, z):
    """A vector turned by a row-major 3×3 matrix."""
    return (
        m[0] * x + m[1] * y + m[2] * z,
        m[3] * x + m[4] * y + m[5] * z,
        m[6] * x + m[7] * y + m[8] * z,
    )


@compile_kernel(**INLINED)
def _broyden_update(inverse, dx, dy, dz, yx, yy, yz):
    """Broyden's good update of an inverse Jacobian: a step d has changed the value by y."""
    # J⁻¹ ← J⁻¹ + (d - J⁻¹ y) (dᵀ J⁻¹) / (dᵀ J⁻¹ y)
    jx, jy, jz = rotate_vector(inverse, yx, yy, yz)
    den = dx * jx + dy * jy + dz * jz
    den = F32(1) / (den if abs(den) > F32(1e-12) else F32(1e-12))
    rx = dx * inverse[0] + dy * inverse[3] + dz * inverse[6]
    ry = dx * inverse[1] + dy * inverse[4] + dz * inverse[7]
    rz = dx * inverse[2] + dy * inverse[5] + dz * inverse[8]
    ux, uy, uz = (dx - jx) * den, (dy - jy) * den, (dz - jz) * den
    inverse[0] += ux * rx
    inverse[1] += ux * ry
    inverse[2] += ux * rz
    inverse[3] += uy * rx
    inverse[4] += uy * ry
    inverse[5] += uy * rz
    inverse[6] += uz * rx
    inverse[7] += uz * ry
    inverse[8] += uz * rz


@compile_kernel(**INLINED)
def _blended_transform(transforms, low, nodes_per_m, x, y, z, out):
    if transforms.shape[3] == MATRIX_LANES:
        interpolate_at(transforms, low, nodes_per_m, x, y, z, MATRIX_LANES, out)
    else:
        interpolate_at(transforms, low, nodes_per_m, x, y, z, 12, out)


@compile_kernel(**NO_ALLOCATION)
def solve_root(transforms, low, nodes_per_m, p, x, blend, inverse, initialize_inverse):
    """Broyden's method (good update) for LBS(x) = p, from x; True if it came to rest.

    Args:
        transforms: Blended 3×4 transforms on the weight volume's nodes (x, y, z, 12 or
            `MATRIX_LANES`).
        x: Initial point, replaced by the root.
        blend: Scratch for `MATRIX_LANES` floats.
        inverse: Initial inverse Jacobian, row by row, replaced by the updated one.
        initialize_inverse: Starts from the blended rotation's inverse instead.
    """
    _blended_transform(transforms, low, nodes_per_m, x[0], x[1], x[2], blend)
    if initialize_inverse:
        invert_rotation(blend, inverse)
    sx, sy, sz = transform_point(blend, x[0], x[1], x[2])
    fx, fy, fz = sx - p[0], sy - p[1], sz - p[2]
    rests = False
    for _ in range(ITERATIONS):
        size = fx * fx + fy * fy + fz * fz
        rests = size <= F32(TOLERANCE_M * TOLERANCE_M)
        if size > F32(1):
            return False
        dx, dy, dz = rotate_vector(inverse, -fx, -fy, -fz)
        if dx * dx + dy * dy + dz * dz > F32(LONGEST_STEP_M * LONGEST_STEP_M):
            return False  # off the volume, or in a fold: nothing that follows would be sound
        if rests and dx * dx + dy * dy + dz * dz > F32(TOLERANCE_M * MAX_PROBE_CORRECTION_M):
            return True
        x[0] += dx
        x[1] += dy
        x[2] += dz
        if rests:  # the residual after the last step is not needed
            return True
        _blended_transform(transforms, low, nodes_per_m, x[0], x[1], x[2], blend)
        sx, sy, sz = transform_point(blend, x[0], x[1], x[2])
        gx, gy, gz = sx - p[0], sy - p[1], sz - p[2]
        _broyden_update(inverse, dx, dy, dz, gx - fx, gy - fy, gz - fz)
        fx, fy, fz = gx, gy, gz
    return fx * fx + fy * fy + fz * fz <= F32(4 * TOLERANCE_M * TOLERANCE_M)


@compile_kernel(**INLINED)
def _probe_root(transforms, low, nodes_per_m, p, dx, dy, dz, x, inverse, blend):
    """Offset from the root x of p to the root of p + d: linear, and one chord step."""
    ux, uy, uz = rotate_vector(inverse, dx, dy, dz)
    interpolate_at(
        transforms, low, nodes_per_m, x[0] + ux, x[1] + uy, x[2] + uz, MATRIX_LANES, blend
    )
    sx, sy, sz = transform_point(blend, x[0] + ux, x[1] + uy, x[2] + uz)
    ex, ey, ez = rotate_vector(inverse, p[0] + dx - sx, p[1] + dy - sy, p[2] + dz - sz)
    beyond = ex * ex + ey * ey + ez * ez > F32(MAX_PROBE_CORRECTION_M * MAX_PROBE_CORRECTION_M)
    share = F32(0) if beyond else F32(1)
    return ux + share * ex, uy + share * ey, uz + share * ez


@compile_kernel(**NO_ALLOCATION)
def probe_faces(transforms, low, nodes_per_m, p, t, x, inverse, blend, warp):
    """Derivatives of the warp at the root x of a cell's center p, by probes t towards the faces.

    A root of p + d is x + A d + Σ c_ij d_i d_j; A and the c_ii are found. `inverse` is about the
    inverse Jacobian at x. `warp` (30) is the root, A row by row, c_xx c_yy c_zz c_xy c_xz c_yz, of
    which the first 21 are written. Returns the norm of all c_ii: how bent the warp is, 1/m.
    """
    bend, half, over = F32(0), F32(0.5) / t, F32(0.5) / (t * t)
    for axis in range(3):
        dx = t if axis == 0 else F32(0)
        dy = t if axis == 1 else F32(0)
        dz = t if axis == 2 else F32(0)
        ax, ay, az = _probe_root(transforms, low, nodes_per_m, p, dx, dy, dz, x, inverse, blend)
        bx, by, bz = _probe_root(transforms, low, nodes_per_m, p, -dx, -dy, -dz, x, inverse, blend)
        # central differences: A e = (a - b) / 2t and c_ii = (a + b) / 2t²
        warp[axis] = x[axis]
        warp[3 + axis], warp[6 + axis], warp[9 + axis] = (
            (ax - bx) * half, (ay - by) * half, (az - bz) * half,
        )  # fmt: skip
        cx, cy, cz = (ax + bx) * over, (ay + by) * over, (az + bz) * over
        warp[12 + 3 * axis], warp[13 + 3 * axis], warp[14 + 3 * axis] = cx, cy, cz
        bend += cx * cx + cy * cy + cz * cz
    return math.sqrt(bend)


@compile_kernel(**NO_ALLOCATION)
def probe_corners(transforms, low, nodes_per_m, p, t, x, inverse, blend, warp):
    """Improves the result of `probe_faces` by probes towards the eight corners; adds the c_ij."""
    for c in range(3, 12):
        warp[c] *= F32(0.5)  # the mean of what faces say and of what corners say
    for c in range(21, 30):
        warp[c] = F32(0)
    mean_x, mean_y, mean_z = F32(0), F32(0), F32(0)
    for corner in range(8):
        i = F32(1) if corner & 4 else F32(-1)
        j = F32(1) if corner & 2 else F32(-1)
        k = F32(1) if corner & 1 else F32(-1)
        ux, uy, uz = _probe_root(
            transforms, low, nodes_per_m, p, i * t, j * t, k * t, x, inverse, blend
        )
        ux, uy, uz = ux / (F32(8) * t * t), uy / (F32(8) * t * t), uz / (F32(8) * t * t)
        mean_x, mean_y, mean_z = mean_x + ux, mean_y + uy, mean_z + uz
        # least squares over the corners d = t (±1, ±1, ±1): A by Σ u d_i, c_ij by Σ u d_i d_j
        for c, u in enumerate((ux, uy, uz)):
            warp[3 + 3 * c] += F32(0.5) * t * u * i
            warp[4 + 3 * c] += F32(0.5) * t * u * j
            warp[5 + 3 * c] += F32(0.5) * t * u * k
            warp[21 + c] += u * i * j
            warp[24 + c] += u * i * k
            warp[27 + c] += u * j * k
    for c, mean in enumerate((mean_x, mean_y, mean_z)):
        # corners measure c_xx + c_yy + c_zz: half of the difference, spread over the three
        more = (mean - warp[12 + c] - warp[15 + c] - warp[18 + c]) / F32(6)
        warp[12 + c] += more
        warp[15 + c] += more
        warp[18 + c] += more
