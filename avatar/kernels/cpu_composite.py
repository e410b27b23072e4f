"""SkinningTensors rendering of packed samples, its losses and their gradient, compiled for the CPU."""

import numpy as np
from numba import prange

from avatar.kernels.jit import FAST_MATH, compile_kernel
from avatar.kernels.reference import ALPHA_DEAD_ZONE, COLOR_HUBER_DELTA, MAX_LOG_DENSITY

F32 = np.float32


@compile_kernel(inline="always")
def _sigmoid(x):
    return F32(1) / (F32(1) + np.exp(-x))


@compile_kernel(parallel=True, **FAST_MATH)
def composite(raw, offsets, counts, sample_step_m, rendered):
    """Premultiplied colour and alpha of each ray from its samples, front to back."""
    for ray in prange(offsets.shape[0]):
        through = F32(1)
        red, green, blue = F32(0), F32(0), F32(0)
        for i in range(offsets[ray], offsets[ray] + counts[ray]):
            kept = np.exp(-np.exp(min(raw[i, 3], F32(MAX_LOG_DENSITY))) * sample_step_m)
            weight = through * (F32(1) - kept)
            through *= kept
            red += weight * _sigmoid(raw[i, 0])
            green += weight * _sigmoid(raw[i, 1])
            blue += weight * _sigmoid(raw[i, 2])
        rendered[ray, 0] = red
        rendered[ray, 1] = green
        rendered[ray, 2] = blue
        rendered[ray, 3] = F32(1) - through


@compile_kernel(inline="always")
def _huber_slope(error, scale):
    return max(F32(-1), min(F32(1), error * F32(1.0 / COLOR_HUBER_DELTA))) * scale


@compile_kernel(inline="always")
def _huber(error):
    size = abs(error)
    if size <= F32(COLOR_HUBER_DELTA):
        return size * size * F32(0.5 / COLOR_HUBER_DELTA)
    return size - F32(0.5 * COLOR_HUBER_DELTA)


@compile_kernel(parallel=True, **FAST_MATH)
def composite_loss(
    raw, offsets, counts, sample_step_m, target, background, alpha_weight, hard_surface_weight,
    rendered, loss, grad_raw,
):  # fmt: skip
    """Composite, loss of every ray, and the gradient of the mean loss with respect to `raw`.

    A density's gradient needs the sum over the samples behind it, so a second pass runs from back
    to front. (Totals less the sum of what is in front would need no such order, but behind an
    opaque sample nothing would be left of them but rounding, times an optical depth of up to 81.)
    Meanwhile `grad_raw` holds each sample's colour and the light that passes it.
    """
    share = F32(1) / F32(offsets.shape[0])
    for ray in prange(offsets.shape[0]):
        start, stop = offsets[ray], offsets[ray] + counts[ray]
        through = F32(1)
        red, green, blue = F32(0), F32(0), F32(0)
        for i in range(start, stop):
            kept = np.exp(-np.exp(min(raw[i, 3], F32(MAX_LOG_DENSITY))) * sample_step_m)
            weight = through * (F32(1) - kept)
            through *= kept
            q0, q1, q2 = _sigmoid(raw[i, 0]), _sigmoid(raw[i, 1]), _sigmoid(raw[i, 2])
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

        b0, b1, b2 = background[ray, 0], background[ray, 1], background[ray, 2]
        clear = F32(1) - target[ray, 3]
        d0 = red + through * b0 - (target[ray, 0] + clear * b0)
        d1 = green + through * b1 - (target[ray, 1] + clear * b1)
        d2 = blue + through * b2 - (target[ray, 2] + clear * b2)
        g0, g1, g2 = _huber_slope(d0, share), _huber_slope(d1, share), _huber_slope(d2, share)
        off = alpha - target[ray, 3]
        g_alpha = F32(0)
        if abs(off) > F32(ALPHA_DEAD_ZONE):
            g_alpha = alpha_weight * share * (F32(1) if off > F32(0) else F32(-1))
        solid, empty = np.exp(-alpha), np.exp(alpha - F32(1))
        g_alpha += hard_surface_weight * share * (solid - empty) / (solid + empty)
        loss[ray] = (
            _huber(d0) + _huber(d1) + _huber(d2)
            + alpha_weight * max(F32(0), abs(off) - F32(ALPHA_DEAD_ZONE))
            - hard_surface_weight * np.log(solid + empty)
        )  # fmt: skip

        behind = F32(0)
        for i in range(stop - 1, start - 1, -1):
            q0, q1, q2, through = grad_raw[i, 0], grad_raw[i, 1], grad_raw[i, 2], grad_raw[i, 3]
            weight = (grad_raw[i - 1, 3] if i > start else F32(1)) - through
            value = (q0 - b0) * g0 + (q1 - b1) * g1 + (q2 - b2) * g2 + g_alpha
            grad_raw[i, 0] = weight * g0 * q0 * (F32(1) - q0)
            grad_raw[i, 1] = weight * g1 * q1 * (F32(1) - q1)
            grad_raw[i, 2] = weight * g2 * q2 * (F32(1) - q2)
            optical = np.exp(min(raw[i, 3], F32(MAX_LOG_DENSITY))) * sample_step_m
            inside = raw[i, 3] < F32(MAX_LOG_DENSITY)
            grad_raw[i, 3] = optical * (through * value - behind) if inside else F32(0)
            behind += weight * value
