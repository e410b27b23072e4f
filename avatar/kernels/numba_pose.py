"""Corrections of poses: sums over rays, the step that they ask for, and forward kinematics.

Compiled for the CPU: a correction is some twenty operations on arrays of 75 numbers, which took
four times as long one by one, since each waits for memory that the training step has replaced.
"""

import math

import numpy as np

from avatar.kernels.kernel_compiler import FAST_MATH, compile_kernel

F32 = np.float32
PADDED = 80
"""Length of a row of 75 numbers that is a multiple of a register's; the last five are zero."""
JOINTS = 24


@compile_kernel(**FAST_MATH)
def add_rays(
    slots, wrenches, loss, min_loss, scale, room, parents, turns, places, root_turns,
    counts, gradients, curvatures, moments, powers,
):  # fmt: skip
    """Adds rays to the normal equations of their slots' poses, in units of the prior's sigmas.

    By virtual work: a joint at c that rotates by ω moves every bone below it, so that
    dL/dω = -Σ (M - c × F) over these bones' wrenches (F, M), in body-frame axes. It is expressed
    in the axes of the joint, in which the corrections are. The root's shift is in the given body
    frame, the forces are in the corrected one. Each ray's loss ℓ is half of a square, ℓ = ρ²/2, so
    that its curvature is ∇ℓ ∇ℓᵀ / 2ℓ.

    Args:
        slots, wrenches, loss: Slot, wrenches (24, 6) and loss of each ray.
        min_loss: Added to the loss in the curvature.
        scale: Sigma of a rotation, radians, and of the root's shift, metres.
        room: Most rays of each slot; rays beyond are left out.
        parents: Parent of each joint, before its children.
        turns, places: Rotation and place of each slot's joints in the body frame.
        root_turns: Correction of each slot's root rotation.
        counts: Rays of each slot so far; these and the following are updated.
        gradients: Sums of gradients (slots, `PADDED`).
        curvatures: Sums of curvatures (slots, 75, `PADDED`).
        moments: Sums of ∇ℓ ∇ℓᵀ, alike; of zero slots if they are not asked for.
        powers: Sums of |∇ℓ|² and of |∇ℓ|² / 2ℓ (slots, 2).
    """
    total, g = np.empty((JOINTS, 6), F32), np.zeros(PADDED, F32)
    for ray in range(slots.shape[0]):
        slot = slots[ray]
        if counts[slot] >= room[slot]:
            continue
        counts[slot] += 1
        total[:] = wrenches[ray]
        for joint in range(JOINTS - 1, 0, -1):
            for q in range(6):
                total[parents[joint], q] += total[joint, q]
        for joint in range(JOINTS):
            x, y, z = places[slot, joint, 0], places[slot, joint, 1], places[slot, joint, 2]
            fx, fy, fz = total[joint, 0], total[joint, 1], total[joint, 2]
            ux = y * fz - z * fy - total[joint, 3]
            uy = z * fx - x * fz - total[joint, 4]
            uz = x * fy - y * fx - total[joint, 5]
            for a in range(3):
                g[3 * joint + a] = F32(scale[0]) * (
                    turns[slot, joint, 0, a] * ux
                    + turns[slot, joint, 1, a] * uy
                    + turns[slot, joint, 2, a] * uz
                )
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
def solve_with_prior(curvature, gradient, stiffness, back, factor, found):
    """Solves (curvature + stiffness) found = gradient + stiffness back by Cholesky's method.

    Args:
        curvature: Positive semidefinite (n, n or more).
        gradient: (n).
        stiffness: Of the prior in each direction; positive.
        back: Distance to the prior's mean (n).
        factor: Scratch (n, n).
        found: (n), written.
    """
    n = found.shape[0]
    for i in range(n):
        for j in range(i + 1):
            s = np.float64(curvature[i, j])
            if i == j:
                s += stiffness
            for k in range(j):
                s -= factor[i, k] * factor[j, k]
            factor[i, j] = math.sqrt(s) if i == j else s / factor[j, j]
        s = gradient[i] + stiffness * back[i]
        for k in range(i):
            s -= factor[i, k] * found[k]
        found[i] = s / factor[i, i]
    for i in range(n - 1, -1, -1):
        found[i] /= factor[i, i]
        for k in range(i):
            found[k] -= factor[i, k] * found[i]


@compile_kernel(**FAST_MATH)
def neighbor_correlation(frames, estimates, known, max_gap, min_pairs):
    """Correlation of the estimates of successive known frames; 0 for fewer pairs than asked for.

    Args:
        frames: Indices of the frames, in any order.
        estimates: Of each frame (frames, 25, 3).
        known: Which frames have an estimate.
        max_gap: Distance in frames up to which two make a pair.
        min_pairs: Fewest pairs.
    """
    order = np.argsort(frames)
    pairs, product, power, before = 0, 0.0, 0.0, -1
    for row in range(order.shape[0]):
        here = order[row]
        if not known[here]:
            continue
        if before >= 0 and 0 < frames[here] - frames[before] <= max_gap:
            pairs += 1
            for j in range(25):
                for a in range(3):
                    one, other = estimates[before, j, a], estimates[here, j, a]
                    product += one * other
                    power += 0.5 * (one * one + other * other)
        before = here
    return product / max(power, 1e-12) if pairs >= min_pairs else 0.0


@compile_kernel(**FAST_MATH)
def neighbor_mean(frame, frames, corrections, held, max_gap, mean):
    """Adds up the neighbors' mean correction, weighted by nearness; whether there is a neighbor.

    Args:
        frame: Index of the frame.
        frames, corrections: Indices and corrections (25, 3) of all frames; its own is ignored.
        held: Which of these count.
        max_gap: Distance in frames up to which one is a neighbor.
        mean: (25, 3), zero before.
    """
    total = 0.0
    for row in range(frames.shape[0]):
        apart = abs(frames[row] - frame)
        if held[row] and 0 < apart <= max_gap:
            total += 1.0 / apart
            for j in range(25):
                for a in range(3):
                    mean[j, a] += corrections[row, j, a] / apart
    if total > 0.0:
        mean /= total
    return total > 0.0


@compile_kernel(**FAST_MATH)
def _rotation(vector, out):
    """Rotation matrix of an axis-angle vector (Rodrigues' formula)."""
    x, y, z = vector[0], vector[1], vector[2]
    square = x * x + y * y + z * z
    angle = math.sqrt(square)
    sine = math.sin(angle) / angle if angle > 1e-6 else 1.0
    half = math.sin(0.5 * angle)
    cosine = 2.0 * half * half / square if angle > 1e-6 else 0.5
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
        rest_from_canonical: (24, 4, 4).
        turns, places, bones, root_turn: Rotations (24, 3, 3) and places (24, 3) of the joints,
            body-from-canonical matrices (24, 12), rotation of the root's correction; written.
    """
    own, turn = np.empty((3, 3)), np.zeros((JOINTS, 3, 3))
    place, away = np.empty((JOINTS, 3)), np.empty(3)
    _rotation(correction[0], root_turn)
    place[0] = rest[0]
    for a in range(3):
        turn[0, a, a] = 1.0
    for joint in range(1, JOINTS):
        parent = parents[joint]
        _rotation(correction[joint], own)
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
