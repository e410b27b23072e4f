"""Traps that once cost decibels.

Cached densities are the highest that a cell has shown: they rise before the surface. What ends a
ray by them must continue it by metres, not samples.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from avatar.config import TrainConfig
from avatar.evaluation.held_out import score_frame
from avatar.evaluation.image_metrics import soft_iou
from avatar.kernels import operations
from avatar.kernels.numba_rendering import OPAQUE_DEPTH
from avatar.kernels.operands import CorrespondenceTables, DensityGrid, MarchSettings, RayBatch
from avatar.render import render
from avatar.rig import Rig
from avatar.training.trainer import cosine_decay
from instant_avatar.studio.actor import Actor
from instant_avatar.studio.staging import static_camera
from tests.avatar_fixtures import film_turning, untaught

# --- a plane that is grazed -------------------------------------------------------------------

CELL_M, CANONICAL_M = 0.03, 0.015
SIDE = 40
"""Warp cells along the flat world's edge; what they carry nowhere is its own canonical space."""


def flat_world() -> CorrespondenceTables:
    """Cells in which every point is its own root."""
    places = np.stack(np.meshgrid(*[np.arange(SIDE)] * 2, np.arange(8), indexing="ij"), axis=-1)
    centers = ((places.reshape(-1, 3) + 0.5) * CELL_M).astype(np.float32)
    roots = np.zeros((1, len(centers) + 1, 12), dtype=np.float32)
    roots[0, 1:, :3] = centers
    roots[0, :, [3, 7, 11]] = 1.0
    index = (np.arange(1, len(centers) + 1, dtype=np.int32) * 8 + 1)[None]
    shape = torch.tensor([[SIDE, SIDE, 8]], dtype=torch.int32)
    return CorrespondenceTables(
        torch.from_numpy(index), torch.from_numpy(roots), torch.zeros(1, 3), shape, CELL_M
    )


def ground(density: float) -> DensityGrid:
    """Everything occupied; the lower half as dense as that, by what the cells have seen."""
    shape = (2 * SIDE, 2 * SIDE, 16)
    cached = torch.zeros(shape)
    cached[:, :, :8] = density
    per_m = torch.full((3,), 1.0 / CANONICAL_M)
    return DensityGrid(torch.ones(shape, dtype=torch.uint8), cached, torch.zeros(3), per_m)


def descending(slope: float) -> RayBatch:
    """A ray that sinks by `slope` metres per metre."""
    direction = torch.tensor([[1.0, 0.0, -slope]])
    return RayBatch(
        torch.tensor([[-0.5, 0.6, 8 * CANONICAL_M + slope * 0.9]]),
        direction / direction.norm(),
        torch.zeros(1, dtype=torch.int32),
        torch.full((1,), 0.5),
    )


def lowest(slope: float, step_m: float, grace_m: float) -> float:
    """How deep below the dense cells' upper wall the last sample of the ray lies, metres."""
    how = MarchSettings(step_m, grace_m, 4096)
    points = operations.march(descending(slope), flat_world(), ground(2000.0), how).points
    return 8 * CANONICAL_M - float(points[-1, 2])


@pytest.mark.parametrize("step_m", [0.015, 0.01, 0.005, 0.0025])
@pytest.mark.parametrize("slope", [0.3, 0.6])
def test_a_grazing_ray_reaches_the_bottom_of_the_surfaces_cell_whatever_the_step(slope, step_m):
    """A surface may lie anywhere in the first cell that has shown its density."""
    grace_m = TrainConfig().opaque_margin_m
    depth = lowest(slope, step_m, grace_m)
    assert depth >= CANONICAL_M
    # it goes on for the grace, after what makes it opaque, and ends on the lattice
    sine = slope / math.hypot(1.0, slope)
    expected = (OPAQUE_DEPTH / 2000.0 + grace_m) * sine
    assert depth == pytest.approx(expected, abs=2.5 * step_m * sine)


# --- a person ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("size", "steps", "overlap"), [(256, 250, 0.97), (540, 600, 0.98)])
def test_silhouettes_are_the_persons_and_no_frame_falls_back_between_marks(size, steps, overlap):
    """Of frames that it has not seen."""
    actor = Actor.of(1, 0)
    rig, camera = Rig.from_shaped_body(actor.shaped), static_camera(actor, size)
    clip = film_turning(actor, camera, frames=20)
    pelvis = np.append(rig.rest_joints[0] + clip.observations[0].pose.root_translation, 1.0)
    footprint_m = float((camera.camera_from_world @ pelvis)[2]) / camera.focal_px[0]
    config = TrainConfig.for_budget(30.0, footprint_m=footprint_m)
    config = dataclasses.replace(config, refine_poses=False)
    trainer, held = untaught(rig, clip, config, stride=7)
    marks = []
    for step in range(steps):
        share = step / steps
        trainer.step(rate=cosine_decay(2.0 * share - 1.0), hard_surface_share=min(1.0, 4.0 * share))
        if trainer.steps % (steps // 5) == 0:
            marks.append([score_frame(trainer.avatar, frame).psnr for frame in held])
    for seen in (frame.observation for frame in held):
        alpha = render(trainer.avatar, seen.pose, seen.camera)[..., 3]
        assert soft_iou(alpha > 0.5, seen.alpha > 0.5) >= overlap
    scores = np.array(marks)
    assert len(scores) == 5
    assert (np.maximum.accumulate(scores, axis=0) - scores).max() < 1.0
