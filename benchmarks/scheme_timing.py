"""One avatar drawn by each scheme of skipping and warping: what a picture costs, and how good."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from avatar.avatar_model import Avatar
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import HeldOutFrame, score_rendering
from avatar.render import render
from baselines.instant_avatar.samplers import BaselineScheme
from baselines.instant_avatar.scheme_rendering import render_sampler, render_samples
from benchmarks.paired_training import VariantQuality


@dataclass(frozen=True, kw_only=True)
class SchemeTiming:
    """What pictures by one scheme cost, and how good they are.

    Attributes:
        name: Of the scheme.
        setup_ms: Core milliseconds a new pose takes: warp cells or blended transforms, and the
            pose's grid if there is one. Median.
        render_ms: Core milliseconds of the picture itself. Median.
        quality: Of the pictures.
    """

    name: str
    setup_ms: float
    render_ms: float
    quality: VariantQuality


def time_scheme(
    name: str,
    avatar: Avatar,
    pictures: Sequence[HeldOutFrame],
    *,
    scheme: BaselineScheme | None,
) -> SchemeTiming:
    """Renders every picture by a scheme, or by our renderer where it is None.

    The first picture is rendered once before, which compiles the kernels.
    """
    setup_ms, render_ms, scores = [], [], []
    for picture in [pictures[0], *pictures]:
        seen = picture.observation
        began = time.process_time()
        cells = CorrespondenceGrid.solve(avatar.rig, seen.pose.joint_rotations)
        if (
            scheme is not None and scheme.roots == "broyden"
        ):  # of the cells only their box is used, which costs nothing
            began = time.process_time()
        draw = render
        if scheme is not None:
            sample_rays = render_sampler(avatar, seen.pose, cells, scheme)
            draw = partial(render_samples, sample_rays=sample_rays)
        prepared = time.process_time()
        image = draw(avatar, seen.pose, seen.camera, cells=cells)
        setup_ms.append(1000.0 * (prepared - began))
        render_ms.append(1000.0 * (time.process_time() - prepared))
        scores.append(score_rendering(image, picture))
    return SchemeTiming(
        name=name,
        setup_ms=float(np.median(setup_ms[1:])),
        render_ms=float(np.median(render_ms[1:])),
        quality=VariantQuality.of(scores[1:]),
    )
