"""Shading by orientation: found where light stays in the room, and nothing where it does not."""

import numpy as np
import pytest
import torch

from avatar.avatar_model import OrientationShading
from avatar.config import TrainConfig
from avatar.kernels import operations
from avatar.kernels.operands import MarchSettings
from avatar.render import render
from avatar.training import checkpoint
from avatar.training.frame_stream import prepare_frame
from avatar.training.trainer import Trainer

CONFIG = TrainConfig(rays=256, sample_step_m=0.03, finest_m=0.03, levels=4, table_size=1 << 13)


@pytest.fixture
def shading(rig):
    return OrientationShading(rig)


def observe(shading, generator, light, *, steps=160):
    for _ in range(steps):
        normals = torch.nn.functional.normalize(torch.randn(1000, 3, generator=generator), dim=1)
        neutral = torch.rand(1000, 4, generator=generator) * 0.4 + 0.2
        neutral[:, 3] = 1.0
        target = neutral * (1.0 + normals @ light)[:, None]
        target += 0.05 * torch.randn(1000, 4, generator=generator)
        target[:, 3] = 1.0
        rendered = neutral * shading.factors(normals)
        shading.observe(normals, target, rendered)


def test_the_light_of_the_room_is_found(shading, generator):
    light = torch.tensor([-0.3, 0.2, 0.1])
    observe(shading, generator, light)
    assert not shading.is_neutral
    assert (shading.coefficients - torch.tensor([1.0, *light])).abs().max() < 0.02
    assert torch.equal(shading.factors(torch.zeros(2, 3)), torch.ones(2, 4))


def test_even_light_leaves_every_factor_at_one(shading, generator):
    observe(shading, generator, torch.tensor([0.01, -0.01, 0.0]))
    assert shading.is_neutral
    normals = torch.eye(3)
    assert torch.equal(shading.factors(normals), torch.ones(3, 4))


@pytest.fixture(scope="module")
def trainer(rig, clip):
    trainer = Trainer(rig, CONFIG)
    trainer.add_frame(prepare_frame(clip.observations[0], rig))
    for _ in range(30):
        trainer.step(rate=1.0, hard_surface_share=0.5)
    trainer.learner.shading.restore(torch.tensor([1.0, 0.0, 0.0, 0.2]))
    return trainer


def test_normals_face_the_camera(trainer):
    batch = trainer.replay.sample_rays(500, trainer.generator)
    cells, field = trainer.replay.correspondences, trainer.field
    how = MarchSettings(CONFIG.sample_step_m, CONFIG.opaque_margin_m, CONFIG.max_samples)
    grid = trainer.avatar.occupancy.density_grid
    samples = operations.march(batch.rays, cells, grid, how)
    raw = field.raw_outputs_at(samples.points)
    volume = trainer.learner.shading.normals
    normals = operations.mean_normals(
        raw, samples, CONFIG.sample_step_m, batch.rays.slots, cells, volume
    )
    seen = normals.norm(dim=1) > 0.7
    assert seen.sum() > 50
    toward_camera = -(normals * batch.rays.directions).sum(dim=1)[seen]
    assert (toward_camera > 0.0).float().mean() > 0.9


def test_light_falls_on_a_rendering_that_asks_for_it(trainer, clip, tmp_path):
    seen = clip.observations[0]
    neutral, lit = (
        render(trainer.avatar, seen.pose, seen.camera, shaded=shaded) for shaded in (False, True)
    )
    assert np.array_equal(neutral[..., 3], lit[..., 3])
    towards = neutral[..., 3] > 0.95  # the camera is on +z, and so is the light
    ratio = lit[towards, 1].sum() / neutral[towards, 1].sum()
    assert 1.05 < ratio < 1.2
    checkpoint.save(trainer, tmp_path)
    restored, _ = checkpoint.load(tmp_path)
    assert np.array_equal(
        render(restored.avatar, seen.pose, seen.camera, shaded=True)[..., :3], lit[..., :3]
    )
