"""One avatar drawn by each scheme of skipping and warping: what a picture costs, and how good."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from avatar.cells import WarpCells
from avatar.config import Roots, Skipping
from avatar.hold import HeldOut, compared
from avatar.model import Avatar
from avatar.paper.variants import rendering
from avatar.render import render
from benchmarks.in_turns import Quality


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """What pictures by one scheme cost, and how good they are.

    Attributes:
        name: Of the scheme.
        ready_ms: Core milliseconds a new pose takes: warp cells or blended transforms, and the
            pose's grid if there is one. Median.
        draw_ms: Core milliseconds of the picture itself. Median.
        quality: Of the pictures.
    """

    name: str
    ready_ms: float
    draw_ms: float
    quality: Quality


def drawn(
    name: str, avatar: Avatar, pictures: Sequence[HeldOut], *, skipping: Skipping, roots: Roots
) -> Drawn:
    """Draws every picture; the first is drawn once before, so that kernels are compiled."""
    ready, draw, scores = [], [], []
    for picture in [pictures[0], *pictures]:
        seen = picture.observation
        began = time.process_time()
        cells = WarpCells.of(avatar.rig, seen.pose.joint_rotations)
        if roots == "broyden":  # of the cells only their box is used, which costs nothing
            began = time.process_time()
        along = rendering(avatar, seen.pose, cells, skipping=skipping, roots=roots)
        prepared = time.process_time()
        image = render(avatar, seen.pose, seen.camera, cells=cells, samples_along=along)
        ready.append(1000.0 * (prepared - began))
        draw.append(1000.0 * (time.process_time() - prepared))
        scores.append(compared(image, picture))
    return Drawn(
        name=name,
        ready_ms=float(np.median(ready[1:])),
        draw_ms=float(np.median(draw[1:])),
        quality=Quality.of(scores[1:]),
    )
