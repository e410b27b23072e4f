"""Corrections of poses: what their rays pull, the step, and the bones and roots that follow.

Compiled for the CPU. A sample's canonical point is x = warp(p; θ) with LBS(x; θ) = p. Where the
loss pulls x with g_x, it pulls the posed point with g = J⁻ᵀ g_x, and by the implicit function
theorem the pose feels -(∂LBS/∂θ)ᵀ g. A bone of weight w turns its share of the body rigidly, so
that all of it is carried by one wrench a bone: the force Σ w g and the moment Σ w (B x) × g.

A correction is some twenty operations on arrays of 75 numbers, which took three times as long one
by one in numpy, since each waits for memory that the training step has replaced.
"""

import math

import numpy as np

from avatar.kernels.kernel_compiler import (
    FAST_MATH,
    INLINED,
    add4,
    claim,
    compile_kernel,
    load4,
    prefetch,
    scale4,
    store4,
)
from avatar.kernels.numba_skinning import transform_point

F32, I32 = np.float32, np.int32
MAX_ROOT_STEP_M = 0.05
"""A root never moves farther than this at once: where the chord is longer the warp has a fold."""
ROOTS_AHEAD = 8
"""Cells between one whose root moves and the one whose weights are fetched meanwhile."""
PADDED = 80
"""Length of a row of 75 numbers that is a multiple of a register's; the last five are zero."""
JOINTS = 24


@compile_kernel(**INLINED)
def _weights_at(weights, shape, low, nodes_per_m, x, y, z, out):
    """Trilinear weights of a point, four bones at once, in the first row of `out` (rows, 24).

    `weights` is (nodes, 24); `shape`, `low` and `nodes_per_m` say how its nodes lie.
    """
    a = min(max((x - low[0]) * nodes_per_m[0], F32(0)), F32(shape[0]) - F32(1.001))
    b = min(max((y - low[1]) * nodes_per_m[1], F32(0)), F32(shape[1]) - F32(1.001))
    c = min(max((z - low[2]) * nodes_per_m[2], F32(0)), F32(shape[2]) - F32(1.001))
    i, j, k = I32(a), I32(b), I32(c)
    a, b, c = a - F32(i), b - F32(j), c - F32(k)
    u, v, w = F32(1) - a, F32(1) - b, F32(1) - c
    n00 = (i * shape[1] + j) * shape[2] + k
    n01, n10 = n00 + shape[2], n00 + shape[1] * shape[2]
    n11 = n10 + shape[2]
    for q in range(0, 24, 4):
        near = add4(
            scale4(u * v * w, load4(weights, n00, q)), scale4(u * v * c, load4(weights, n00 + 1, q))
        )
        near = add4(near, scale4(u * b * w, load4(weights, n01, q)))
        near = add4(near, scale4(u * b * c, load4(weights, n01 + 1, q)))
        far = add4(
            scale4(a * v * w, load4(weights, n10, q)), scale4(a * v * c, load4(weights, n10 + 1, q))
        )
        far = add4(far, scale4(a * b * w, load4(weights, n11, q)))
        far = add4(far, scale4(a * b * c, load4(weights, n11 + 1, q)))
        store4(out, 0, q, add4(near, far))


@compile_kernel(**FAST_MATH)
def write_wrenches(
    first_ray, last_ray, points, grad_points, rows, first, count, slots, cell_roots, weights,
    shape, low, nodes_per_m, bones, out,
):  # fmt: skip
    """Writes what the samples of some rays exert on the bones that move them.

    Args:
        first_ray, last_ray: The rays, without the last.
        points, grad_points: Canonical samples and what pulls them.
        rows: Root of `cell_roots[slot]` that each sample was warped with.
        first, count, slots: Each ray's samples and its frame's slot.
        cell_roots: Roots and inverse Jacobians (slots, roots, 12).
        bones: Body-from-canonical matrices (slots, 24, 12).
        out: (rays, 24, 6): force then moment about the body frame's origin.
    """
    share = np.empty((1, 24), F32)
    for ray in range(first_ray, last_ray):
        slot, strongest = slots[ray], F32(0)
        for joint in range(24):
            for q in range(6):
                out[ray, joint, q] = F32(0)
        for i in range(first[ray], first[ray] + count[ray]):
            a, b, c = grad_points[i, 0], grad_points[i, 1], grad_points[i, 2]
            strongest = max(strongest, a * a + b * b + c * c)
        for i in range(first[ray], first[ray] + count[ray]):
            a, b, c = grad_points[i, 0], grad_points[i, 1], grad_points[i, 2]
            if a * a + b * b + c * c <= F32(1e-3**2) * strongest:
                continue
            n = rows[i]
            # force at the posed point: f = Aᵀ g, with A = J⁻¹ at the cell's center
            fx = (
                cell_roots[slot, n, 3] * a + cell_roots[slot, n, 6] * b + cell_roots[slot, n, 9] * c
            )
            fy = (
                cell_roots[slot, n, 4] * a + cell_roots[slot, n, 7] * b
                + cell_roots[slot, n, 10] * c
            )  # fmt: skip
            fz = (
                cell_roots[slot, n, 5] * a + cell_roots[slot, n, 8] * b
                + cell_roots[slot, n, 11] * c
            )  # fmt: skip
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            _weights_at(weights, shape, low, nodes_per_m, x, y, z, share)
            for joint in range(24):
                w = share[0, joint]
                if w < F32(1e-3):
                    continue
                px, py, pz = transform_point(bones[slot, joint], x, y, z)
                # wrench on the bone: w f, and w (B x) × f
                out[ray, joint, 0] += w * fx
                out[ray, joint, 1] += w * fy
                out[ray, joint, 2] += w * fz
                out[ray, joint, 3] += w * (py * fz - pz * fy)
                out[ray, joint, 4] += w * (pz * fx - px * fz)
                out[ray, joint, 5] += w * (px * fy - py * fx)


@compile_kernel(**INLINED)
def _prefetch_weights(weights, shape, low, nodes_per_m, roots, row):
    """Has the cache fetch the weights about a root, as `_weights_at` will read them."""
    a = min(max((roots[row, 0] - low[0]) * nodes_per_m[0], F32(0)), F32(shape[0]) - F32(1.001))
    b = min(max((roots[row, 1] - low[1]) * nodes_per_m[1], F32(0)), F32(shape[1]) - F32(1.001))
    c = min(max((roots[row, 2] - low[2]) * nodes_per_m[2], F32(0)), F32(shape[2]) - F32(1.001))
    node = (I32(a) * shape[1] + I32(b)) * shape[2] + I32(c)
    for side in range(4):
        pair = node + (side & 1) * shape[2] + (side >> 1) * shape[1] * shape[2]
        for q in range(0, 48, 16):
            prefetch(weights, pair, q)


@compile_kernel(**FAST_MATH)
def _update_slab(
    i, packed_cells, cells, grid_low, cell_m, roots, weights, shape, low, nodes_per_m, bones,
):  # fmt: skip
    """Moves the roots of one slab of cells."""
    room, last = np.empty((2, 24), F32), cells[0] * cells[1] * cells[2] - 1
    for j in range(cells[1]):
        for k in range(cells[2]):
            cell = (i * cells[1] + j) * cells[2] + k
            packed, later = packed_cells[cell], packed_cells[min(cell + ROOTS_AHEAD, last)]
            if later > 0:
                _prefetch_weights(weights, shape, low, nodes_per_m, roots, later >> 3)
            later = packed_cells[min(cell + 2 * ROOTS_AHEAD, last)]
            if later > 0:
                prefetch(roots, later >> 3, 0)
            if packed <= 0:
                continue
            rows = 3 if packed & 4 else 1
            for candidate in range(packed & 3):
                n = (packed >> 3) + candidate * rows
                x, y, z = roots[n, 0], roots[n, 1], roots[n, 2]
                _weights_at(weights, shape, low, nodes_per_m, x, y, z, room)
                one, two, three = load4(bones, 0, 0), load4(bones, 0, 4), load4(bones, 0, 8)
                w = room[0, 0]
                one, two, three = scale4(w, one), scale4(w, two), scale4(w, three)
                for joint in range(1, 24):
                    w = room[0, joint]
                    if w > F32(0):
                        one = add4(one, scale4(w, load4(bones, joint, 0)))
                        two = add4(two, scale4(w, load4(bones, joint, 4)))
                        three = add4(three, scale4(w, load4(bones, joint, 8)))
                store4(room, 1, 0, one)
                store4(room, 1, 4, two)
                store4(room, 1, 8, three)
                sx, sy, sz = transform_point(room[1], x, y, z)
                # chord step: x ← x + A e, with e = center - LBS(x)
                ex = grid_low[0] + (F32(i) + F32(0.5)) * cell_m - sx
                ey = grid_low[1] + (F32(j) + F32(0.5)) * cell_m - sy
                ez = grid_low[2] + (F32(k) + F32(0.5)) * cell_m - sz
                dx = roots[n, 3] * ex + roots[n, 4] * ey + roots[n, 5] * ez
                dy = roots[n, 6] * ex + roots[n, 7] * ey + roots[n, 8] * ez
                dz = roots[n, 9] * ex + roots[n, 10] * ey + roots[n, 11] * ez
                if dx * dx + dy * dy + dz * dz <= F32(MAX_ROOT_STEP_M**2):
                    roots[n, 0] = x + dx
                    roots[n, 1] = y + dy
                    roots[n, 2] = z + dz


@compile_kernel(**FAST_MATH)
def update_roots(
    claimed, slots, packed_cells, cells, grid_low, cell_m, roots, weights, shape, low,
    nodes_per_m, bones,
):  # fmt: skip
    """Moves roots to follow their frames' poses, by one chord step towards the cell's center.

    The cells of each of `slots` are flat; their grid has the shape `cells`. Roots are updated in
    place, inverse Jacobians and second-order terms stay. `bones` are the new poses' matrices
    (slots, 24, 12).
    """
    passed, slab = 0, claim(claimed)
    for slot in slots:
        while slab < passed + cells[slot, 0]:
            _update_slab(
                slab - passed, packed_cells[slot], cells[slot], grid_low[slot], cell_m, roots[slot],
                weights, shape, low, nodes_per_m, bones[slot],
            )  # fmt: skip
            slab = claim(claimed)
        passed += cells[slot, 0]


@compile_kernel(**FAST_MATH)
def add_rays(
    thread, threads, slots, wrenches, loss, min_loss, scale, room, parents, turns, places,
    root_turns, counts, gradients, curvatures, moments, powers,
):  # fmt: skip
    """Adds rays to the normal equations of their slots' poses, in units of the prior's sigmas.

    By virtual work: a joint at c that rotates by ω moves every bone below it, so that
    dL/dω = -Σ (M - c × F) over these bones' wrenches (F, M), in body-frame axes. It is expressed in
    the axes of the joint, in which the corrections are. The root's shift is in the given body
    frame, the forces are in the corrected one. Each ray's loss ℓ is half of a square, ℓ = ρ²/2, so
    that its curvature is ∇ℓ ∇ℓᵀ / 2ℓ. Each thread adds to slots of its own.

    Args:
        wrenches: Of each ray's bones (rays, 24, 6).
        min_loss: Added to the loss in the curvature.
        scale: Sigma of a rotation, radians, and of the root's shift, metres.
        room: Most rays of each slot; rays beyond are left out.
        parents: Parent of each joint, before its children.
        turns, places: Rotation and place of each slot's joints in the body frame.
        root_turns: Correction of each slot's root rotation.
        counts: Rays of each slot so far; these and the following are updated.
        gradients: Sums of gradients (slots, `PADDED`).
        curvatures: Sums of curvatures (slots, 75, `PADDED`).
        moments: Sums of ∇ℓ ∇ℓᵀ, alike; of zero slots if they are not needed.
        powers: Sums of |∇ℓ|² and of |∇ℓ|² / 2ℓ (slots, 2).
    """
    total, g = np.empty((JOINTS, 6), F32), np.zeros(PADDED, F32)
    for ray in range(slots.shape[0]):
        slot = slots[ray]
        if slot % threads != thread or counts[slot] >= room[slot]:
            continue
        counts[slot] += 1
        for joint in range(JOINTS):
            for q in range(6):
                total[joint, q] = wrenches[ray, joint, q]
        # the wrench of the whole branch below each joint
        for joint in range(JOINTS - 1, 0, -1):
            for q in range(6):
                total[parents[joint], q] += total[joint, q]
        for joint in range(JOINTS):
            x, y, z = places[slot, joint, 0], places[slot, joint, 1], places[slot, joint, 2]
            fx, fy, fz = total[joint, 0], total[joint, 1], total[joint, 2]
            # u = c × F - M, and its derivative by the correction, σ Rᵀ u
            ux = y * fz - z * fy - total[joint, 3]
            uy = z * fx - x * fz - total[joint, 4]
            uz = x * fy - y * fx - total[joint, 5]
            for a in range(3):
                g[3 * joint + a] = F32(scale[0]) * (
                    turns[slot, joint, 0, a] * ux
                    + turns[slot, joint, 1, a] * uy
                    + turns[slot, joint, 2, a] * uz
                )
        # the shift moves the whole body: -σ R F, with R the root's correction
        for a in range(3):
            g[72 + a] = -F32(scale[1]) * (
                root_turns[slot, a, 0] * total[0, 0]
                + root_turns[slot, a, 1] * total[0, 1]
                + root_turns[slot, a, 2] * total[0, 2]
            )
        weight, power = F32(0.5) / (max(loss[ray], F32(0)) + F32(min_loss)), F32(0)
        for i in range(75):
            power += g[i] * g[i]
            gradients[slot, i] += g[i]
            weighted = weight * g[i]
            for k in range(PADDED):
                curvatures[slot, i, k] += weighted * g[k]
            if moments.shape[0] > 0:
                for k in range(PADDED):
                    moments[slot, i, k] += g[i] * g[k]
        powers[slot, 0] += power
        powers[slot, 1] += weight * power


@compile_kernel(**FAST_MATH)
def gauss_newton(
    curvature, gradient, stiffness, correction, mean, precision, sigmas, share, max_step, change
):  # fmt: skip
    """Step of a pose correction.

        (C + s p) Δ = -(g + s p (correction - mean)), in prior sigmas

    Args:
        curvature, gradient: C (75, 75 or more) and g of the rays, in prior sigmas.
        stiffness: s, the curvature of a mean ray.
        correction, mean: Correction and the prior's mean, radians, and metres in the last row
            (25, 3).
        precision: p, relative to that of a tracker's pose.
        sigmas: Prior standard deviation of each row (25).
        share: Factor of the step.
        max_step: Largest change of a number.
        change: The step; written.
    """
    back, factor = np.empty(75), np.empty((75, 75))
    found, largest = np.empty(75), max_step
    for i in range(75):
        back[i] = (correction[i // 3, i % 3] - mean[i // 3, i % 3]) / sigmas[i // 3]
    solve_with_prior(curvature, gradient, precision * stiffness, back, factor, found)
    for i in range(75):
        change[i // 3, i % 3] = -share * sigmas[i // 3] * found[i]
        largest = max(largest, abs(change[i // 3, i % 3]))
    change *= max_step / largest


@compile_kernel(**FAST_MATH)
def fade(curvature, gradient, moments, moved, sigmas, decay):
    """Weighs the sums of earlier rays, linearized where the correction has moved to by `moved`.

    g ← decay (g + C moved), C ← decay C, in prior sigmas
    """
    for i in range(75):
        total = F32(0)
        for k in range(75):
            total += curvature[i, k] * F32(moved[k // 3, k % 3] / sigmas[k // 3])
        gradient[i] = decay * (gradient[i] + total)
        for k in range(PADDED):
            curvature[i, k] *= decay
        if moments.shape[0] > 0:
            for k in range(PADDED):
                moments[i, k] *= decay


@compile_kernel(**FAST_MATH)
def largest_distance(one, other):
    """Largest distance between points of two lists (points, 3)."""
    largest = 0.0
    for i in range(one.shape[0]):
        square = 0.0
        for a in range(3):
            square += (one[i, a] - other[i, a]) ** 2
        largest = max(largest, square)
    return math.sqrt(largest)


@compile_kernel(**FAST_MATH)
def solve_with_prior(curvature, gradient, stiffness, back, factor, found):
    """Solves (curvature + stiffness) found = gradient + stiffness back by Cholesky's method.

    The curvature (n, n or more) is positive semidefinite but for rounding; the prior's stiffness is
    positive, and alike in all directions. `back` is the distance to the prior's mean, `factor`
    scratch (n, n); `found` is written.
    """
    n, ridge = found.shape[0], stiffness
    for i in range(n):
        # below, where one ray outweighs all others, float32 sums are not positive definite
        ridge = max(ridge, 1e-6 * curvature[i, i])
    # L Lᵀ = curvature + ridge, and L y = gradient + stiffness back
    for i in range(n):
        for j in range(i + 1):
            s = np.float64(curvature[i, j])
            if i == j:
                s += ridge
            for k in range(j):
                s -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(s) if i == j else s / factor[j, j]
        s = gradient[i] + stiffness * back[i]
        for k in range(i):
            s -= factor[i, k] * found[k]
        found[i] = s / factor[i, i]
    # Lᵀ found = y
    for i in range(n - 1, -1, -1):
        found[i] /= factor[i, i]
        for k in range(i):
            found[k] -= factor[i, k] * found[i]


@compile_kernel(**FAST_MATH)
def _rotation(vector, out):
    """Rotation matrix of an axis-angle vector (Rodrigues' formula)."""
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    sine = math.sin(angle) / angle if angle > 1e-6 else 1.0
    half = math.sin(0.5 * angle)
    cosine = 2.0 * half * half / square if angle > 1e-6 else 0.5
    # I + sin θ / θ [v]× + (1 - cos θ) / θ² (v vᵀ - θ² I), with 1 - cos θ = 2 sin² (θ / 2)
    diagonal = 1.0 - cosine * square
    out[0, 0], out[1, 1], out[2, 2] = (
        diagonal + cosine * x * x,
        diagonal + cosine * y * y,
        diagonal + cosine * z * z,
    )
    out[0, 1], out[1, 0] = cosine * x * y - sine * z, cosine * x * y + sine * z
    out[0, 2], out[2, 0] = cosine * x * z + sine * y, cosine * x * z - sine * y
    out[1, 2], out[2, 1] = cosine * y * z - sine * x, cosine * y * z + sine * x


@compile_kernel(**FAST_MATH)
def pose_joints(
    given, correction, rest, parents, rest_from_canonical, turns, places, bones, root_turn
):
    """Forward kinematics of a corrected pose in its body frame.

    Args:
        given: Given rotation of each joint but the root (23, 3, 3).
        correction: Axis-angle correction of each joint's rotation, the root's first (25, 3).
        rest: Joints of the rest pose, metres.
        parents: Parent of each joint, before its children.
        turns, places, bones, root_turn: Rotations (24, 3, 3) and places (24, 3) of the joints,
            body-from-canonical matrices (24, 12), rotation of the root's correction; written.
    """
    own, turn = np.empty((3, 3)), np.zeros((JOINTS, 3, 3))
    place, away = np.empty((JOINTS, 3)), np.empty(3)
    _rotation(correction[0], root_turn)
    for a in range(3):
        place[0, a], turn[0, a, a] = rest[0, a], 1.0
    for joint in range(1, JOINTS):
        parent = parents[joint]
        _rotation(correction[joint], own)
        # c = c_parent + R_parent (rest - rest_parent), R = R_parent · given · correction
        for a in range(3):
            place[joint, a] = place[parent, a]
            for b in range(3):
                place[joint, a] += turn[parent, a, b] * (rest[joint, b] - rest[parent, b])
                whole = 0.0
                for c in range(3):
                    whole += given[joint - 1, a, c] * own[c, b]
                for c in range(3):
                    turn[joint, c, b] += turn[parent, c, a] * whole
    for joint in range(JOINTS):
        # B = [R | c - R rest] · rest_from_canonical
        for a in range(3):
            away[a] = place[joint, a]
            for b in range(3):
                away[a] -= turn[joint, a, b] * rest[joint, b]
                turns[joint, a, b] = turn[joint, a, b]
            places[joint, a] = place[joint, a]
            for b in range(4):
                moved = away[a] if b == 3 else 0.0
                for c in range(3):
                    moved += turn[joint, a, c] * rest_from_canonical[joint, c, b]
                bones[joint, 4 * a + b] = moved


@compile_kernel(**FAST_MATH)
def move_pose(
    correction, change, most, most_m, given, rest, parents, rest_from_canonical, turns, places,
    bones, root_turn,
):  # fmt: skip
    """Moves a pose by a change of its correction, or by the part that the frame's roots can follow.

    Args:
        correction: Axis-angle corrections and the root's shift (25, 3), in [-most, most]; written.
        change: What it is to change by; written: what it has changed by.
        most_m: Largest motion of a joint, metres.
        given, rest, parents, rest_from_canonical, turns, places, bones, root_turn: As in
            `pose_joints`; `places` are those before.
    """
    before, joints = correction.copy(), places.copy()
    for joint in range(25):
        for a in range(3):
            moved = before[joint, a] + change[joint, a]
            correction[joint, a] = min(max(moved, -most), most)
    pose_joints(
        given, correction, rest, parents, rest_from_canonical, turns, places, bones, root_turn
    )
    distance = largest_distance(places, joints)
    if distance > most_m:
        for joint in range(25):
            for a in range(3):
                moved = correction[joint, a] - before[joint, a]
                correction[joint, a] = before[joint, a] + most_m / distance * moved
        pose_joints(
            given, correction, rest, parents, rest_from_canonical, turns, places, bones, root_turn
        )
    for joint in range(25):
        for a in range(3):
            change[joint, a] = correction[joint, a] - before[joint, a]
