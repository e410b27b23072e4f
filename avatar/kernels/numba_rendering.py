"""Ray marching, volume rendering, its losses and their gradient, compiled for the CPU."""

import math

import numpy as np

from avatar.kernels.kernel_compiler import INLINED, NO_ALLOCATION, claim, compile_kernel, prefetch
from avatar.kernels.operands import MAX_LOG_DENSITY

F32, I32, U32 = np.float32, np.int32, np.uint32
COLOR_HUBER_DELTA = 0.1
"""Color error at which the Huber loss turns from quadratic to linear."""
DARK_GRAY, BRIGHT_GRAY = 0.5 - 0.5 / math.sqrt(3.0), 0.5 + 0.5 / math.sqrt(3.0)
"""Backgrounds: the mean loss over both is that over all grays in [0, 1] (Gauss), if quadratic."""
ALPHA_DEAD_ZONE = 1e-3
"""Error of alpha up to which the L1 loss on alpha is zero."""
OPAQUE_DEPTH = 12.0
"""Optical depth, by cached densities, at which a training ray counts as opaque."""
RAYS_PER_BLOCK = 16
"""Training rays whose cells are fetched before any of them is marched; they fit the first cache."""


@compile_kernel(**INLINED)
def nonzero(x):
    """A ray direction's component, kept away from zero so that it can be divided by."""
    return x if abs(x) > F32(1e-7) else F32(1e-7)


@compile_kernel(**INLINED)
def cell_index_at(g, count):
    """Cell along one axis of a position, in cells, that is inside except for rounding."""
    return U32(min(max(I32(g), I32(0)), count - I32(1)))


@compile_kernel(**INLINED)
def _second_order_term(roots, slot, row, x, y, z):
    """Second-order term Σ c_ij d_i d_j of a bent cell at (x, y, z) from its center."""
    a, b = row + U32(1), row + U32(2)
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return (
        xx * roots[slot, a, U32(0)] + yy * roots[slot, a, U32(3)] + zz * roots[slot, a, U32(6)]
        + xy * roots[slot, a, U32(9)] + xz * roots[slot, b, U32(0)] + yz * roots[slot, b, U32(3)],
        xx * roots[slot, a, U32(1)] + yy * roots[slot, a, U32(4)] + zz * roots[slot, a, U32(7)]
        + xy * roots[slot, a, U32(10)] + xz * roots[slot, b, U32(1)] + yz * roots[slot, b, U32(4)],
        xx * roots[slot, a, U32(2)] + yy * roots[slot, a, U32(5)] + zz * roots[slot, a, U32(8)]
        + xy * roots[slot, a, U32(11)] + xz * roots[slot, b, U32(2)] + yz * roots[slot, b, U32(5)],
    )  # fmt: skip


@compile_kernel(**INLINED)
def canonical_point(roots, slot, row, bent, x, y, z):
    """The canonical point of the offset (x, y, z) from the center of a cell with a root."""
    u = roots[slot, row, U32(0)] + (
        roots[slot, row, U32(3)] * x + roots[slot, row, U32(4)] * y + roots[slot, row, U32(5)] * z
    )
    v = roots[slot, row, U32(1)] + (
        roots[slot, row, U32(6)] * x + roots[slot, row, U32(7)] * y + roots[slot, row, U32(8)] * z
    )
    w = roots[slot, row, U32(2)] + (
        roots[slot, row, U32(9)] * x + roots[slot, row, U32(10)] * y + roots[slot, row, U32(11)] * z
    )
    if bent:
        a, b, c = _second_order_term(roots, slot, row, x, y, z)
        u, v, w = u + a, v + b, w + c
    return u, v, w


@compile_kernel(**INLINED)
def _cached_density(occupied, density, low, cells_per_m, x, y, z, needs_density):
    """Cached density of the canonical cell of a point, 1/m; -1 in empty cells.

    Unless `needs_density`, 0 stands for it: the occupancy alone fits a core's cache.
    """
    a = U32(I32(np.floor((x - low[0]) * cells_per_m[0])))  # negative indices wrap to large ones
    b = U32(I32(np.floor((y - low[1]) * cells_per_m[1])))
    c = U32(I32(np.floor((z - low[2]) * cells_per_m[2])))
    if a >= U32(occupied.shape[0]) or b >= U32(occupied.shape[1]) or c >= U32(occupied.shape[2]):
        return F32(-1)
    if occupied[a, b, c] == 0:
        return F32(-1)
    return density[a, b, c] if needs_density else F32(0)


@compile_kernel(**INLINED)
def _enter_grid(origins, directions, ray, low, shape, slot, cell_m):
    """A ray in the cells of its slot's grid: `g = o + t d` is in cells, t in metres.

    Returns o; d; dt / dg along each axis; t where the ray enters the grid, and where it leaves.
    """
    cells_a_m = F32(1) / cell_m
    ox = (origins[ray, 0] - low[slot, 0]) * cells_a_m
    oy = (origins[ray, 1] - low[slot, 1]) * cells_a_m
    oz = (origins[ray, 2] - low[slot, 2]) * cells_a_m
    dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
    ix, iy, iz = cell_m / nonzero(dx), cell_m / nonzero(dy), cell_m / nonzero(dz)
    ax, ay, az = -ox * ix, -oy * iy, -oz * iz
    bx, by, bz = (
        (F32(shape[slot, 0]) - ox) * ix,
        (F32(shape[slot, 1]) - oy) * iy,
        (F32(shape[slot, 2]) - oz) * iz,
    )
    enter = max(max(min(ax, bx), min(ay, by)), max(min(az, bz), F32(0)))
    leave = min(min(max(ax, bx), max(ay, by)), max(az, bz))
    return (
        ox, oy, oz, dx * cells_a_m, dy * cells_a_m, dz * cells_a_m, ix, iy, iz, enter, leave
    )  # fmt: skip


@compile_kernel(**INLINED)
def _fetch_cells(
    origins, directions, ray, slots, low, shape, cell_m, cell_index, cell_roots, roots
):
    """Fetches the cells along a ray, a cell's edge apart; with `roots`, the roots of these cells.

    Marching waits for memory otherwise: rays of many frames share no cells, and which root is read
    depends on the cell.
    """
    slot = U32(slots[ray])
    ox, oy, oz, dx, dy, dz, _, _, _, t, leave = _enter_grid(
        origins, directions, ray, low, shape, slot, cell_m
    )
    nx, ny, nz = shape[slot, 0], shape[slot, 1], shape[slot, 2]
    slot_roots = cell_roots[slot]
    while t < leave:
        i, j = cell_index_at(ox + t * dx, nx), cell_index_at(oy + t * dy, ny)
        flat = (i * U32(ny) + j) * U32(nz) + cell_index_at(oz + t * dz, nz)
        if not roots:
            prefetch(cell_index, slot, flat)
        else:
            packed = cell_index[slot, flat]
            if packed > 0:
                row, rows = packed >> 3, (packed & 3) * (3 if packed & 4 else 1)
                prefetch(slot_roots, row, 0)
                prefetch(slot_roots, row + rows - 1, 11)
        t += cell_m


@compile_kernel(**NO_ALLOCATION)
def _march_block(
    block, origins, directions, slots, jitter, sample_step_m,
    cell_index, cell_roots, cell_low, cell_shape, cell_m,
    occupied, density, low, cells_per_m, opaque_margin_steps, most_samples, points, rows, counts,
    next_steps,
):  # fmt: skip
    """Marches the rays of a block, whose samples lie one after the other from its place on."""
    place = np.int64(block) * RAYS_PER_BLOCK * most_samples
    most = U32(most_samples)
    ends = opaque_margin_steps < 10**9  # else exact rendering
    steps_a_m = F32(1) / sample_step_m
    first = block * RAYS_PER_BLOCK
    last = min(first + RAYS_PER_BLOCK, origins.shape[0])
    for fetch in range(2 if ends else 0):
        for ray in range(first, last):
            _fetch_cells(
                origins, directions, ray, slots, cell_low, cell_shape, cell_m,
                cell_index, cell_roots, fetch == 1,
            )  # fmt: skip
    for ray in range(first, last):
        slot = U32(slots[ray])
        nx, ny, nz = cell_shape[slot, 0], cell_shape[slot, 1], cell_shape[slot, 2]
        ox, oy, oz, dx, dy, dz, ix, iy, iz, enter, leave = _enter_grid(
            origins, directions, ray, cell_low, cell_shape, slot, cell_m
        )
        wx = F32(1) if ix > 0 else F32(0)  # the far wall of a cell
        wy = F32(1) if iy > 0 else F32(0)
        wz = F32(1) if iz > 0 else F32(0)
        a_step = sample_step_m * cell_m  # of a ray's direction in cells, in metres
        optical, left, kept, step = F32(0), opaque_margin_steps, U32(0), F32(0)
        while kept < most and left >= 0:
            t = enter + (step + jitter[ray]) * sample_step_m
            if t >= leave:
                break
            gx, gy, gz = ox + t * dx, oy + t * dy, oz + t * dz
            i, j, k = cell_index_at(gx, nx), cell_index_at(gy, ny), cell_index_at(gz, nz)
            packed = cell_index[slot, (i * U32(ny) + j) * U32(nz) + k]
            way_x, way_y = (F32(i) + wx - gx) * ix, (F32(j) + wy - gy) * iy
            way = min(min(way_x, way_y), (F32(k) + wz - gz) * iz)
            if packed <= 0:
                if packed < -1:  # empty within -packed - 1 more cells in every direction
                    more = F32(-packed - 1)
                    way = min(way_x + more * abs(ix), way_y + more * abs(iy))
                    way = min(way, (F32(k) + wz - gz) * iz + more * abs(iz))
                step += max(F32(1), np.ceil(way * steps_a_m))
                continue
            ex = (gx - (F32(i) + F32(0.5))) * cell_m
            ey = (gy - (F32(j) + F32(0.5))) * cell_m
            ez = (gz - (F32(k) + F32(0.5))) * cell_m
            chosen, bent = U32(packed >> 3), packed & 4 != 0
            px, py, pz = canonical_point(cell_roots, slot, chosen, False, ex, ey, ez)
            fx, fy, fz = ex + dx * a_step, ey + dy * a_step, ez + dz * a_step
            ux, uy, uz = canonical_point(cell_roots, slot, chosen, False, fx, fy, fz)
            ux, uy, uz = ux - px, uy - py, uz - pz
            straight = packed & 7 == 1  # nine in ten cells: a line through canonical space
            samples = max(I32(np.ceil(way * steps_a_m)), I32(1)) if straight else I32(1)
            for _ in range(samples):
                best, row = F32(-1), chosen
                if straight:
                    best = _cached_density(occupied, density, low, cells_per_m, px, py, pz, ends)
                for _ in range(0 if straight else packed & 3):
                    x, y, z = canonical_point(cell_roots, slot, row, bent, ex, ey, ez)
                    asked = ends or packed & 3 > 1
                    here = _cached_density(occupied, density, low, cells_per_m, x, y, z, asked)
                    if here > best:
                        best, chosen, px, py, pz = here, row, x, y, z
                    row = U32(row + (U32(3) if bent else U32(1)))
                if best >= F32(0):
                    points[place, 0] = px
                    points[place, 1] = py
                    points[place, 2] = pz
                    rows[place] = chosen
                    place += 1
                    kept += U32(1)
                    optical += best * sample_step_m
                    left -= optical > F32(OPAQUE_DEPTH)
                step += F32(1)
                if kept == most or left < 0:
                    break
                px, py, pz = px + ux, py + uy, pz + uz
        counts[ray] = kept
        next_steps[ray] = I32(step)


@compile_kernel(**NO_ALLOCATION)
def march(
    claimed, origins, directions, slots, jitter, sample_step_m,
    cell_index, cell_roots, cell_low, cell_shape, cell_m,
    occupied, density, low, cells_per_m, opaque_margin_steps, most_samples, points, rows, counts,
    next_steps,
):  # fmt: skip
    """Canonical samples along body-frame rays, and the root row that each was warped with.

    Samples lie on the lattice `t = entry + (k + jitter) sample_step_m`. A sample is kept if its
    cell has a root whose canonical cell is occupied; of several roots the one of highest cached
    density is used. A ray ends `opaque_margin_steps` samples after its cached optical depth passes
    `OPAQUE_DEPTH`, or after `most_samples` samples; `next_steps` is the lattice step that
    continues it. `points` and `rows` have room for as many samples of each ray; those of a block of
    rays lie together.
    """
    blocks = (origins.shape[0] + RAYS_PER_BLOCK - 1) // RAYS_PER_BLOCK
    block = claim(claimed)
    while block < blocks:
        _march_block(
            block, origins, directions, slots, jitter, sample_step_m,
            cell_index, cell_roots, cell_low, cell_shape, cell_m,
            occupied, density, low, cells_per_m, opaque_margin_steps, most_samples,
            points, rows, counts, next_steps,
        )  # fmt: skip
        block = claim(claimed)


@compile_kernel(**NO_ALLOCATION)
def prefix_sum(counts, first):
    """Writes the index of each ray's first sample in a list without gaps; returns its length."""
    total = 0
    for ray in range(counts.shape[0]):
        first[ray] = total
        total += counts[ray]
    return total


@compile_kernel(**NO_ALLOCATION)
def pack_samples(padded, padded_rows, most_samples, counts, points, rows):
    """Copies the samples of each block of rays, as `march` wrote them, to one list without gaps."""
    place, packed = 0, 0
    for ray in range(counts.shape[0]):
        if ray % RAYS_PER_BLOCK == 0:
            place = ray * most_samples
        for _ in range(counts[ray]):
            rows[packed] = padded_rows[place]
            for axis in range(3):
                points[packed, axis] = padded[place, axis]
            place += 1
            packed += 1


@compile_kernel(nogil=True, fastmath=True)
def scatter_max_density(points, log_density, low, cells_per_m, density):
    """Raises the cached density of each sample's cell to the sample's own density."""
    nx, ny, nz = density.shape
    for i in range(points.shape[0]):
        a = I32((points[i, 0] - low[0]) * cells_per_m[0])
        b = I32((points[i, 1] - low[1]) * cells_per_m[1])
        c = I32((points[i, 2] - low[2]) * cells_per_m[2])
        if 0 <= a < nx and 0 <= b < ny and 0 <= c < nz:
            here = np.exp(min(log_density[i], F32(MAX_LOG_DENSITY)))
            if here > density[a, b, c]:
                density[a, b, c] = here


@compile_kernel(**INLINED)
def sigmoid(x):
    """1 / (1 + exp(-x))."""
    return F32(1) / (F32(1) + np.exp(-x))


@compile_kernel(**INLINED)
def _composite_ray(ray, raw, offsets, counts, sample_step_m, rendered):
    """One ray's color and alpha."""
    through = F32(1)
    red, green, blue = F32(0), F32(0), F32(0)
    # 1 - α = exp(-σ Δ); a sample weighs T α, and leaves T (1 - α)
    for i in range(offsets[ray], offsets[ray] + counts[ray]):
        kept = np.exp(-np.exp(min(raw[i, 3], F32(MAX_LOG_DENSITY))) * sample_step_m)
        weight = through * (F32(1) - kept)
        through *= kept
        red += weight * sigmoid(raw[i, 0])
        green += weight * sigmoid(raw[i, 1])
        blue += weight * sigmoid(raw[i, 2])
    rendered[ray, 0] = red
    rendered[ray, 1] = green
    rendered[ray, 2] = blue
    rendered[ray, 3] = F32(1) - through


@compile_kernel(**NO_ALLOCATION)
def composite(thread, threads, raw, offsets, counts, sample_step_m, rendered):
    """Premultiplied color and alpha of each ray from its samples, front to back."""
    rays = offsets.shape[0]
    for ray in range(rays * thread // threads, rays * (thread + 1) // threads):
        _composite_ray(ray, raw, offsets, counts, sample_step_m, rendered)


@compile_kernel(**INLINED)
def _half_huber_slope(error):
    return max(F32(-0.5), min(F32(0.5), error * F32(0.5 / COLOR_HUBER_DELTA)))


@compile_kernel(**INLINED)
def _mean_huber(error, excess_alpha):
    """Mean loss of a channel over both backgrounds; its derivatives by color and by alpha."""
    dark, bright = F32(DARK_GRAY), F32(BRIGHT_GRAY)
    on_dark, on_bright = error - excess_alpha * dark, error - excess_alpha * bright
    p, q = _half_huber_slope(on_dark), _half_huber_slope(on_bright)
    # half of Huber's loss of e is p e - δ p², with p its slope, so that their sum is the mean
    loss = p * on_dark + q * on_bright - F32(COLOR_HUBER_DELTA) * (p * p + q * q)
    return loss, p + q, -(p * dark + q * bright)


@compile_kernel(**NO_ALLOCATION)
def composite_ray_loss(
    ray, raw, offsets, counts, sample_step_m, target, alpha_weight, hard_surface_weight, rendered,
    loss, grad_raw,
):  # fmt: skip
    """One ray's composite and loss, and the gradient of the mean loss with respect to `raw`.

    A density's gradient needs the sum over the samples behind it, so a second pass runs from back
    to front. (Totals less the sum of what is in front would need no such order, but behind an
    opaque sample nothing would be left of them but rounding, times an optical depth of up to 81.)
    In between, `grad_raw` holds each sample's color and the transmittance behind it.
    """
    share = F32(1) / F32(offsets.shape[0])
    start, stop = offsets[ray], offsets[ray] + counts[ray]
    through = F32(1)
    red, green, blue = F32(0), F32(0), F32(0)
    for i in range(start, stop):
        kept = np.exp(-np.exp(min(raw[i, 3], F32(MAX_LOG_DENSITY))) * sample_step_m)
        weight = through * (F32(1) - kept)
        through *= kept
        q0, q1, q2 = sigmoid(raw[i, 0]), sigmoid(raw[i, 1]), sigmoid(raw[i, 2])
        grad_raw[i, 0] = q0
        grad_raw[i, 1] = q1
        grad_raw[i, 2] = q2
        grad_raw[i, 3] = through
        red += weight * q0
        green += weight * q1
        blue += weight * q2
    alpha = F32(1) - through
    rendered[ray, 0] = red
    rendered[ray, 1] = green
    rendered[ray, 2] = blue
    rendered[ray, 3] = alpha

    off = alpha - target[ray, 3]
    e0, g0, a0 = _mean_huber(red - target[ray, 0], off)
    e1, g1, a1 = _mean_huber(green - target[ray, 1], off)
    e2, g2, a2 = _mean_huber(blue - target[ray, 2], off)
    g0, g1, g2, g_alpha = share * g0, share * g1, share * g2, share * (a0 + a1 + a2)
    if abs(off) > F32(ALPHA_DEAD_ZONE):
        g_alpha += alpha_weight * share * (F32(1) if off > F32(0) else F32(-1))
    # hard surface: -log(exp(-α) + exp(α - 1)), of slope tanh(1/2 - α)
    solid, empty = np.exp(-alpha), np.exp(alpha - F32(1))
    g_alpha += hard_surface_weight * share * (solid - empty) / (solid + empty)
    loss[ray] = (
        e0 + e1 + e2
        + alpha_weight * max(F32(0), abs(off) - F32(ALPHA_DEAD_ZONE))
        - hard_surface_weight * np.log(solid + empty)
    )  # fmt: skip

    behind = F32(0)
    for i in range(stop - 1, start - 1, -1):
        q0, q1, q2, through = grad_raw[i, 0], grad_raw[i, 1], grad_raw[i, 2], grad_raw[i, 3]
        weight = (grad_raw[i - 1, 3] if i > start else F32(1)) - through
        value = q0 * g0 + q1 * g1 + q2 * g2 + g_alpha
        grad_raw[i, 0] = weight * g0 * q0 * (F32(1) - q0)
        grad_raw[i, 1] = weight * g1 * q1 * (F32(1) - q1)
        grad_raw[i, 2] = weight * g2 * q2 * (F32(1) - q2)
        # dL / d log σ = σ Δ (T behind · value - Σ weight · value of all samples behind)
        optical = np.exp(min(raw[i, 3], F32(MAX_LOG_DENSITY))) * sample_step_m
        inside = raw[i, 3] < F32(MAX_LOG_DENSITY)
        grad_raw[i, 3] = optical * (through * value - behind) if inside else F32(0)
        behind += weight * value
