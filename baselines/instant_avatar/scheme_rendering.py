"""Renders an avatar with a baseline's scheme of skipping and root finding."""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from avatar.avatar_model import Avatar
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.kernels import operations
from avatar.kernels.operands import (
    MAX_LOG_DENSITY,
    CorrespondenceTables,
    RayBatch,
    RaySamples,
)
from avatar.radiance_field import RadianceField
from avatar.render import (
    EMPTY_LOG_DENSITY,
    MAX_SAMPLES_PER_PASS,
    MIN_TRANSMITTANCE,
    body_frame_rays,
    correspondence_tables,
    pixel_chunks,
)
from baselines.instant_avatar.posed_field import PosedField
from baselines.instant_avatar.posed_occupancy import (
    CorrespondenceBand,
    NoSkipping,
    PerFrameGrids,
    PosedEmptySpace,
)
from baselines.instant_avatar.samplers import BaselineScheme, PosedSampler
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

PROBES_PER_RENDERED_POSE = 5
"""Probes of each cell of a rendered pose's grid, as in the released code."""

RayFunction = Callable[[RayBatch, CorrespondenceTables], RaySamples]
"""Samples rays, as `RaySampler.sample_rays` does."""


def render_sampler(
    avatar: Avatar, pose: BodyPose, cells: CorrespondenceGrid, scheme: BaselineScheme
) -> RayFunction:
    """Prepares a scheme's sampler for one pose, for `render_samples`.

    Args:
        avatar: Avatar to render.
        pose: Pose whose grid is filled, if the scheme has one.
        cells: Correspondence grid of the pose.
        scheme: Scheme of skipping and root finding. "frame" is the paper's (§3.3, inference).

    Raises:
        ValueError: If the scheme needs a sequence, or is our renderer's own.
    """
    if scheme.skipping == "union":
        raise ValueError(
            "A new pose belongs to no sequence, so there is no union over it: render with "
            "skipping='frame', as the paper does, or with skipping='none'."
        )
    if scheme.skipping == "canonical" and scheme.roots == "cells":
        raise ValueError("skipping='canonical' with roots='cells' is what avatar.render does.")
    grid = avatar.rendering_grid() if scheme.skipping == "canonical" else None
    warp = scheme.warp(avatar, 1, kept_in=grid)
    bones = avatar.rig.body_from_canonical(pose.joint_rotations)[:, :3].reshape(24, 12)
    warp.set_pose(0, torch.from_numpy(bones).float())
    emptiness: PosedEmptySpace = NoSkipping()
    if scheme.skipping == "frame":
        emptiness = PerFrameGrids(PosedField(avatar.field, warp), 1)
        _fill_grid(emptiness, correspondence_tables(cells))
    elif scheme.skipping == "canonical":
        emptiness = CorrespondenceBand(avatar.occupancy)
    return PosedSampler(emptiness, warp, avatar.sample_step_m).sample_rays


def _fill_grid(grids: PerFrameGrids, tables: CorrespondenceTables) -> None:
    generator = torch.Generator().manual_seed(0)
    grids.add_frame(0, tables)
    for _ in range(PROBES_PER_RENDERED_POSE):
        grids.probe(0, tables, generator)


@torch.no_grad()
def render_samples(
    avatar: Avatar,
    pose: BodyPose,
    camera: Camera,
    *,
    cells: CorrespondenceGrid,
    sample_rays: RayFunction,
) -> Float32[np.ndarray, "height width 4"]:
    """Renders a premultiplied RGBA image in [0, 1] from the samples of any sampler.

    Args:
        avatar: Avatar to render.
        pose: Pose in the camera's world frame.
        camera: Camera and size of the image.
        cells: Correspondence grid of the pose.
        sample_rays: Chooses the samples along rays.
    """
    tables = correspondence_tables(cells)
    world_from_body = avatar.rig.world_from_body(pose)
    width, height = camera.size_px
    picture = np.zeros((height, width, 4), dtype=np.float32)
    for part, pixels in pixel_chunks(picture, 0, 0):
        rays = body_frame_rays(pixels, camera, world_from_body)
        samples = sample_rays(rays, tables)
        colors = _composite_samples(avatar.field, samples, sample_step_m=avatar.sample_step_m)
        part[:] = colors.numpy().reshape(part.shape)
    return picture


def _composite_samples(
    field: RadianceField, samples: RaySamples, *, sample_step_m: float
) -> Float32[Tensor, "rays 4"]:
    """Premultiplied color and alpha of rays whose samples are given.

    The field is queried front to back, and not behind the depth that `MIN_TRANSMITTANCE` hides.
    """
    points, first, count, _ = samples
    ray = torch.repeat_interleave(torch.arange(len(count)), count)
    rank = torch.arange(len(points)) - first[ray]
    raw = points.new_zeros(len(points), 4)
    raw[:, 3] = EMPTY_LOG_DENSITY
    optical = points.new_zeros(len(count))
    for start in range(0, int(count.max()) if len(count) else 0, MAX_SAMPLES_PER_PASS):
        lit = (
            (rank >= start)
            & (rank < start + MAX_SAMPLES_PER_PASS)
            & (optical[ray] < -math.log(MIN_TRANSMITTANCE))
        )
        seen = lit.nonzero()[:, 0]
        values = field.raw_outputs_at(points[seen])
        raw[seen] = values
        density = torch.exp(values[:, 3].clamp(max=MAX_LOG_DENSITY))
        optical.index_add_(0, ray[seen], density * sample_step_m)
    return operations.composite(raw, samples, sample_step_m)
