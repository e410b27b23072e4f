"""Exposure of each training frame: gains of the color channels, as a camera's automatics set them.

A phone adapts exposure and white balance while it films. A field that knows nothing of it learns
the mean, and poses are bent to hide the difference. The gains of a frame are the ratio of its
pixels to the rendering of the same rays, from running sums, so that they cost no gradient; training
targets are divided by them. Their geometric mean over the frames is 1: the avatar stays neutral.
"""

import math
from collections.abc import Mapping
from typing import final

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.kernels.kernel_compiler import FAST_MATH, compile_kernel
from avatar.kernels.operands import PremultipliedPixels
from avatar.training.replay_buffer import TrainingBatch

ChannelGains = Float32[np.ndarray, "3"]
"""Factor of each color channel of a frame against the neutral avatar."""
MIN_PERSON_ALPHA = 0.5
"""Alpha, in the frame and in the rendering, above which a ray counts."""
MEMORY_RAYS = 1000.0
"""Rays of a frame after which an earlier one weighs 1/e, because the field has changed since."""
MAX_FRAME_GAP = 30
"""Distance in frames from which a neighbor's gains are no guess."""


@final
class FrameExposures:
    """Gains of the replay buffer's frames against the neutral avatar, slot by slot."""

    def __init__(self, capacity: int, *, avatar_frozen: bool = False) -> None:
        """Starts without frames.

        The brightness of a frozen avatar is known: gains are neither centered nor shrunk.
        """
        self.gains: Float32[Tensor, "slots 3"] = torch.ones(capacity, 3)
        self._avatar_frozen = avatar_frozen
        self._frames: list[int] = []
        self._restored: dict[int, ChannelGains] = {}
        self._pixels, self._rendered = np.zeros((2, capacity, 3))

    @property
    def by_frame(self) -> dict[int, ChannelGains]:
        """Known gains, by the frames' indices in their source."""
        gains = self.gains[: len(self._frames)].numpy().copy()
        return {**self._restored, **dict(zip(self._frames, gains, strict=True))}

    def restore(self, gains: Mapping[int, ChannelGains]) -> None:
        """Takes gains of frames that may be read again, instead of those known so far."""
        self._restored = dict(gains)

    def expected_gain(self, frame: int) -> ChannelGains:
        """Gains of the nearest known frame; 1 if none is near."""
        known = self.by_frame
        nearest = min(known, key=lambda other: abs(other - frame), default=None)
        if nearest is None or abs(nearest - frame) > MAX_FRAME_GAP:
            return np.ones(3, dtype=np.float32)
        return known[nearest]

    def set_frame(self, slot: int, frame: int, gain: ChannelGains | None = None) -> None:
        """Gives the next slot, or one whose frame is replaced, to a frame of the source.

        Its gains start from `gain`, or from those of the nearest known frame.
        """
        gain = self.expected_gain(frame) if gain is None else gain
        self._frames[slot : slot + 1] = [frame]
        self.gains[slot] = torch.from_numpy(gain)
        self._rendered[slot] = 50.0 * 0.4  # initial gains are worth 50 rays of this color
        self._pixels[slot] = self._rendered[slot] * gain

    def neutralize(self, batch: TrainingBatch) -> TrainingBatch:
        """The batch as the neutral avatar should look; unchanged while no exposure differs."""
        target = np.empty(batch.target.shape, dtype=np.float32)
        _divide_by_gains(batch.rays.slots.numpy(), batch.target.numpy(), self.gains.numpy(), target)
        return batch._replace(target=torch.from_numpy(target))

    def observe(self, batch: TrainingBatch, rendered: PremultipliedPixels) -> None:
        """Updates the gains by rays with their pixels as filmed, and their neutral rendering."""
        _update_gains(
            batch.rays.slots.numpy(), batch.target.numpy(), rendered.numpy(),
            self._avatar_frozen, self._pixels, self._rendered,
            self.gains.numpy()[: len(self._frames)],
        )  # fmt: skip


@compile_kernel(**FAST_MATH)
def _divide_by_gains(slots, target, gains, neutral):
    for ray in range(slots.shape[0]):
        for q in range(3):
            neutral[ray, q] = target[ray, q] / gains[slots[ray], q]
        neutral[ray, 3] = target[ray, 3]


@compile_kernel(**FAST_MATH)
def _update_gains(slots, target, rendered, avatar_frozen, pixels, renderings, gains):
    """Adds the colors of a batch's rays to the running sums of their slots, and finds the gains.

    The sums (slots, 3) fade with each new ray. `gains` (held, 3) are of the slots that hold a
    frame; those of a frozen avatar are neither centered nor shrunk.
    """
    held = gains.shape[0]
    sums, log_gains = np.zeros((held, 7)), np.empty(held)
    for ray in range(slots.shape[0]):
        slot = slots[ray]
        if slot < held and min(target[ray, 3], rendered[ray, 3]) > MIN_PERSON_ALPHA:
            sums[slot, 0] += 1.0
            for q in range(3):
                sums[slot, 1 + q] += target[ray, q]
                sums[slot, 4 + q] += rendered[ray, q]
    for q in range(3):
        for slot in range(held):
            kept = math.exp(-sums[slot, 0] / MEMORY_RAYS)
            pixels[slot, q] = kept * pixels[slot, q] + sums[slot, 1 + q]
            renderings[slot, q] = kept * renderings[slot, q] + sums[slot, 4 + q]
            log_gains[slot] = math.log(pixels[slot, q] / renderings[slot, q])
        mean, power, kept = 0.0, 1e-12, 1.0
        if not avatar_frozen:
            for slot in range(held):
                mean += log_gains[slot] / held
            for slot in range(held):
                power += (log_gains[slot] - mean) ** 2 / held
            # James and Stein's shrinkage: differences no larger than their error are not believed
            # their error: the deviation of log gains where exposure is constant
            kept = max(1.0 - 0.015**2 / power, 0.0)
        for slot in range(held):
            gains[slot, q] = math.exp(kept * (log_gains[slot] - mean))
