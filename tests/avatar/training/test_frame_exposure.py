"""Frame exposures: found from rays and renderings, neutral on average, kept over a checkpoint."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.config import TrainConfig
from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.kernels.operands import RayBatch
from avatar.training import checkpoint
from avatar.training.frame_exposure import MAX_FRAME_GAP, FrameExposures
from avatar.training.frame_stream import prepare_frame
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.replay_buffer import TrainingBatch
from avatar.training.trainer import Trainer

CONFIG = TrainConfig(
    rays=256, sample_step_m=0.03, finest_m=0.03, levels=4, table_size=1 << 13,
    empty_space_points=32, refine_poses=False, seed=7,
)  # fmt: skip
BRIGHT, DARK = np.array([1.25, 1.2, 1.1]), np.array([0.8, 0.85, 0.9])


def rays_of(gains, generator, *, rays=4000):
    """Rays of frames with these gains, and their neutral rendering."""
    gains = torch.tensor(np.array(gains), dtype=torch.float32)
    slots = torch.randint(len(gains), (rays,), generator=generator)
    rendered = torch.rand(rays, 4, generator=generator) * 0.5 + 0.2
    rendered[:, 3] = (torch.rand(rays, generator=generator) > 0.3).float()
    filmed = torch.cat([rendered[:, :3] * gains[slots], rendered[:, 3:]], dim=1)
    empty = torch.zeros(rays, 3)
    turns = torch.eye(3).expand(rays, 3, 3)
    batch = TrainingBatch(RayBatch(empty, empty, slots.int(), empty[:, 0]), filmed, turns)
    return batch, rendered


def exposures_of(*frames: int, **more) -> FrameExposures:
    exposures = FrameExposures(len(frames), **more)
    for slot, frame in enumerate(frames):
        exposures.set_frame(slot, frame)
    return exposures


def test_gains_are_found_and_average_to_one(generator):
    exposures = exposures_of(0, 1, 2)
    true = np.array([BRIGHT, DARK, np.ones(3)])
    for _ in range(5):
        batch, rendered = rays_of(true, generator)
        exposures.observe(batch, rendered)
    found = exposures.gains.log().numpy()
    expected = np.log(true) - np.log(true).mean(axis=0)
    assert np.abs(found - expected).max() < 0.02
    assert np.abs(found.mean(axis=0)).max() < 1e-6
    neutral = exposures.neutralize(batch).target
    assert torch.equal(neutral[:, 3], batch.target[:, 3])
    ratio = (neutral[:, :3] / rendered[:, :3]).log().numpy()
    assert np.abs(ratio - np.log(true).mean(axis=0)).max() < 0.02


def test_a_frozen_avatar_gives_absolute_gains(generator):
    exposures = exposures_of(0, 1, avatar_frozen=True)
    for _ in range(5):
        exposures.observe(*rays_of([BRIGHT, 1.01 * BRIGHT], generator))
    found = exposures.gains.numpy()
    assert np.abs(found / BRIGHT - [[1.0], [1.01]]).max() < 0.005


def test_under_constant_exposure_nothing_changes(generator):
    exposures = exposures_of(0, 1, 2)
    for _ in range(5):
        batch, rendered = rays_of(np.ones((3, 3)), generator)
        noisy = rendered + torch.tensor([[0.003], [-0.003], [0.0]])[batch.rays.slots.long()]
        exposures.observe(batch, noisy)
        assert torch.equal(exposures.neutralize(batch).target, batch.target)


def test_rays_without_person_say_nothing(generator):
    exposures = exposures_of(0, 1)
    batch, rendered = rays_of([BRIGHT, DARK], generator)
    rendered[:, 3] = 0.0
    exposures.observe(batch, rendered)
    assert torch.equal(exposures.gains, torch.ones(2, 3))


def test_a_new_frame_starts_from_its_nearest_neighbor(generator):
    exposures = FrameExposures(4)
    exposures.set_frame(0, 10, BRIGHT.astype(np.float32))
    exposures.restore({30: DARK.astype(np.float32)})
    for slot, frame in enumerate((12, 28), start=1):
        exposures.set_frame(slot, frame)
    assert np.allclose(exposures.gains[:3], [BRIGHT, BRIGHT, DARK])
    exposures.set_frame(3, 31 + MAX_FRAME_GAP)
    assert torch.equal(exposures.gains[3], torch.ones(3))
    exposures.set_frame(3, 29)  # a slot's frame is replaced
    assert set(exposures.by_frame) == {10, 12, 28, 29, 30}
    batch, rendered = rays_of([BRIGHT, BRIGHT, DARK, DARK], generator, rays=4)
    exposures.observe(batch, rendered)
    assert float(exposures.gains[3, 0]) < 0.9


def exposed(observation, gain):
    rgb = np.rint(np.minimum(observation.frame.rgb * gain, 255.0)).astype(np.uint8)
    return replace(observation, frame=replace(observation.frame, rgb=rgb))


@pytest.fixture(scope="module")
def trainers(rig, clip):
    """After a video in which every second frame is darker: with and without estimation."""
    trained = []
    for estimates in (True, False):
        trainer = Trainer(rig, replace(CONFIG, estimate_exposures=estimates))
        for observation in clip.observations[:6]:
            filmed = exposed(observation, DARK if observation.frame.index % 2 else np.ones(3))
            trainer.add_frame(prepare_frame(filmed, rig))
        for step in range(80):
            trainer.step(rate=1.0 - step / 80, hard_surface_share=0.5)
        trained.append(trainer)
    return trained


@pytest.mark.slow
def test_training_finds_the_exposure_of_each_frame(trainers):
    found = trainers[0].exposures.by_frame
    dark = np.mean([found[i] for i in (1, 3, 5)], axis=0)
    light = np.mean([found[i] for i in (0, 2, 4)], axis=0)
    assert np.abs(dark / light / DARK - 1.0).max() < 0.03
    assert torch.equal(trainers[1].exposures.gains, torch.ones_like(trainers[1].exposures.gains))


def test_the_exposure_of_a_held_out_frame_is_fitted_in_the_fitted_score_only(trainers, clip):
    held = [HeldOutFrame(observation=exposed(clip.observations[4], DARK))]
    with_gain, without = (
        score_frame(trainer.avatar, *fit_test_poses(trainer, held)) for trainer in trainers
    )
    given = score_frame(trainers[0].avatar, held[0])
    assert with_gain.psnr > given.psnr + 0.5
    assert with_gain.psnr > without.psnr + 0.5


def test_gains_survive_a_checkpoint(trainers, tmp_path, rig, clip):
    trainer = trainers[0]
    checkpoint.save(trainer, tmp_path)
    restored, _ = checkpoint.load(tmp_path)
    restored.add_frame(prepare_frame(clip.observations[3], rig))
    assert np.array_equal(restored.exposures.gains[0], trainer.exposures.by_frame[3])
