"""Random draws of a training step's rays, compiled for the CPU.

In torch and numpy they are fifty operations on small arrays, 1.5 core-ms a step.
"""

import numpy as np

from avatar.kernels.kernel_compiler import INLINED, compile_kernel

F32, I32 = np.float32, np.int32
SIGHT_SPACING_PX = 8
"""Distance of the pixels whose directions are kept, px; others are interpolated: exact but for
rounding for a lens without distortion, to about 0.02 px for a strongly bent one."""


@compile_kernel(**INLINED)
def _sight(sights, picture, width, flat):
    """Unit direction of a pixel in its camera's axes, between the four kept ones about it."""
    row, column = flat // width, flat % width
    columns = width // SIGHT_SPACING_PX + 2
    i, j = row // SIGHT_SPACING_PX, column // SIGHT_SPACING_PX
    b = F32(row - i * SIGHT_SPACING_PX) * F32(1.0 / SIGHT_SPACING_PX)
    a = F32(column - j * SIGHT_SPACING_PX) * F32(1.0 / SIGHT_SPACING_PX)
    n = i * columns + j
    m = n + columns
    p, q, r, s = (F32(1) - a) * (F32(1) - b), a * (F32(1) - b), (F32(1) - a) * b, a * b
    x = (
        p * sights[picture, n, 0] + q * sights[picture, n + 1, 0]
        + r * sights[picture, m, 0] + s * sights[picture, m + 1, 0]
    )  # fmt: skip
    y = (
        p * sights[picture, n, 1] + q * sights[picture, n + 1, 1]
        + r * sights[picture, m, 1] + s * sights[picture, m + 1, 1]
    )  # fmt: skip
    z = F32(1) / np.sqrt(x * x + y * y + F32(1))
    return x * z, y * z, z


@compile_kernel(**INLINED)
def _find_runs(runs, pixels, pictures, numbers, found):
    """The run that holds each ray's pixel: binary searches, a step of all rays at a time.

    Each step waits for memory; steps of different rays wait together.
    """
    step, most = 1, 1
    for picture in range(pixels.shape[0]):
        most = max(most, pixels[picture, 3])
    while 2 * step < most:
        step *= 2
    for ray in range(pictures.shape[0]):
        found[ray] = 0
    while step > 0:
        for ray in range(pictures.shape[0]):
            picture, run = pictures[ray], found[ray] + step
            if run < pixels[picture, 3] and runs[picture, run - 1, 0] <= numbers[ray]:
                found[ray] = run
        step //= 2


@compile_kernel(nogil=True, error_model="numpy")
def draw_rays(
    chances, frames, shares, pixels, runs, sights, colors, all_origins, turns, world_from_camera,
    slots, origins, directions, targets, world_from_body,
):  # fmt: skip
    """Draws rays uniformly from the frames, in their order; the last five arguments are written.

    A slot has two pictures, 2 * slot: the whole frame, and 2 * slot + 1: the head.

    Args:
        chances: Random numbers in [0, 1) (5, rays): frame, near the person or not, pixel, head or
            not; the last row is not read.
        frames: Number of frames, whose slots are the first.
        shares: Share of the rays near the person, and of these, of those in the head's picture: if
            it has as many pixels as the whole frame's person, and at most.
        pixels: Of each picture: numbers of pixels near the person and of all (0: there is none),
            width, number of runs (pictures, 4).
        runs: `PixelRuns.ends` and `shifts` (pictures, runs, 2).
        sights: Points of the plane at depth 1 seen by every `SIGHT_SPACING_PX`-th pixel (pictures,
            nodes, 2).
        colors: Premultiplied RGBA of the pixels near the person (pictures, pixels, 4).
        all_origins, turns: Origin of the rays and body-from-camera rotation of each slot.
        world_from_camera: Rotation of each slot's camera.
    """
    rays, stop = slots.shape[0], 0
    drawn, numbers, found = np.zeros(frames, I32), np.empty(rays, np.int64), np.empty(rays, I32)
    pictures = np.empty(rays, I32)
    for n in range(rays):
        drawn[min(I32(chances[0, n] * F32(frames)), frames - 1)] += 1
    for slot in range(frames):
        near, count, head = pixels[2 * slot, 0], pixels[2 * slot, 1], pixels[2 * slot + 1, 0]
        start, stop = stop, stop + drawn[slot]
        in_head = min(F32(shares[1]) * np.sqrt(F32(head) / F32(near)), F32(shares[2]))
        for ray in range(start, stop):
            place, far = chances[2, ray], count - near
            picture, number = 2 * slot, near + np.int64(place * F32(far))
            if chances[1, ray] < F32(shares[0]) or far == 0:
                number = np.int64(place * F32(near))
                if chances[3, ray] < in_head:
                    picture, number = picture + 1, np.int64(place * F32(head))
            slots[ray], pictures[ray] = slot, picture
            numbers[ray] = min(number, pixels[picture, 1] - 1)
    _find_runs(runs, pixels[: 2 * frames], pictures, numbers, found)
    for ray in range(rays):
        slot, picture, number = slots[ray], pictures[ray], numbers[ray]
        turn, camera = turns[slot], world_from_camera[slot]
        flat = number + runs[picture, found[ray], 1]
        x, y, z = _sight(sights, picture, pixels[picture, 2], flat)
        for q in range(4):
            color = colors[picture, number, q] if number < pixels[picture, 0] else 0
            targets[ray, q] = F32(color) / F32(255)
        for i in range(3):
            origins[ray, i] = all_origins[slot, i]
            directions[ray, i] = turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z
            for k in range(3):
                world_from_body[ray, i, k] = (
                    camera[i, 0] * turn[k, 0] + camera[i, 1] * turn[k, 1]
                    + camera[i, 2] * turn[k, 2]
                )  # fmt: skip
