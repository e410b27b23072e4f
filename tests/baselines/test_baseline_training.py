"""The paper's schemes learn."""

import dataclasses

import numpy as np
import pytest
import torch

from avatar.config import TrainConfig
from avatar.training.frame_stream import prepare_frame
from avatar.training.pose_optimizer import PoseOptimizer
from avatar.training.replay_buffer import ReplayBuffer
from avatar.training.training_step import OccupancySampler, compute_gradients
from baselines.instant_avatar.samplers import BaselineScheme, BaselineTrainer

SMALL = TrainConfig(
    rays=200, sample_step_m=0.02, finest_m=0.03, table_size=1 << 12, levels=4,
    empty_space_points=64, occupancy_interval=8, refine_poses=False, replay_capacity=4,
)  # fmt: skip
SCHEMES = {
    "union": {"skipping": "union"},
    "frame": {"skipping": "frame"},
    "none": {"skipping": "none"},
    "broyden": {"roots": "broyden"},
    "union, broyden": {"skipping": "union", "roots": "broyden"},
    "global": {"empty_term": "global"},
}
LOSSES = {
    "none": {"empty_space_weight": 0.0},
    "no alpha": {"alpha_weight": 0.0},
    "no hard surface": {"hard_surface_weight": 0.0},
}


def slow_where(names, is_slow):
    """Names to parametrize by, of which some are slow."""
    return [pytest.param(n, marks=pytest.mark.slow) if is_slow(n) else n for n in names]


def trainer_of(rig, clip, name, **changes):
    """A trainer of a named scheme or loss variant that has taken in four frames."""
    config = dataclasses.replace(SMALL, **LOSSES.get(name, {}), **changes)
    trainer = BaselineTrainer(rig, config, BaselineScheme(**SCHEMES.get(name, {})))
    for observation in clip.observations[:8:2]:
        trainer.add_frame(prepare_frame(observation, rig))
    return trainer


@pytest.mark.parametrize(
    ("choices", "changes", "advice"),
    [
        ({"roots": "broyden"}, {"refine_poses": True}, "refine_poses=False"),
        ({"skipping": "none"}, {}, "empty_space_weight=0 or empty_term='global'"),
    ],
)
def test_contradictory_choices_are_refused_with_advice(choices, changes, advice):
    with pytest.raises(ValueError, match=advice):
        BaselineScheme(**choices).check(dataclasses.replace(SMALL, **changes))


@pytest.mark.parametrize(
    ("choices", "changes"),
    [
        ({}, {"refine_poses": True}),
        ({"roots": "broyden"}, {}),
        ({"skipping": "none"}, {"empty_space_weight": 0.0}),
        ({"skipping": "none", "empty_term": "global"}, {}),
        ({"skipping": "frame", "roots": "broyden"}, {}),
    ],
)
def test_compatible_choices_are_accepted(choices, changes):
    BaselineScheme(**choices).check(dataclasses.replace(SMALL, **changes))


@pytest.mark.parametrize(
    "name", slow_where(sorted({*SCHEMES, *LOSSES}), lambda name: "broyden" in name)
)  # whose kernel takes seven seconds to compile
def test_every_variant_learns(rig, clip, name):
    trainer = trainer_of(rig, clip, name)
    color = []
    for _ in range(30):
        result = trainer.step(rate=1.0, hard_surface_share=0.0)
        assert result.sample_count > 200
        color.append(float(result.loss.mean()))
    assert np.mean(color[-5:]) < 0.5 * np.mean(color[:5])


@pytest.mark.parametrize("skipping", ["union", "frame", "none"])
def test_poses_are_pulled_alike_wherever_samples_lie(rig, clip, learnt, skipping):
    """What rays ask of a pose; the samples that ours leaves out carry no light."""
    avatar = learnt.trainer.avatar
    replay = ReplayBuffer(1)
    frame = prepare_frame(clip.observations[3], rig)
    slot = replay.add(frame)
    config = dataclasses.replace(learnt.trainer.config, empty_space_weight=0.0)
    found = []
    ours = OccupancySampler(avatar.occupancy, config)
    theirs = BaselineScheme(skipping=skipping).posed_sampler(avatar, config)
    for sampler in (ours, theirs):
        poses = PoseOptimizer(rig, 1)
        poses.set_pose(slot, frame.pose)
        if sampler is theirs:
            theirs.add_frame(0, replay.correspondences, poses.bones[0])
            theirs.update(0, replay.correspondences, torch.Generator().manual_seed(0))
        batch = replay.sample_rays(2000, torch.Generator().manual_seed(1))
        compute_gradients(
            avatar, sampler, replay.correspondences, batch, config,
            hard_surface_share=0.0, poses=poses, generator=torch.Generator().manual_seed(2),
        )  # fmt: skip
        avatar.field.table_grad.zero_()
        found.append(torch.from_numpy(poses.pose_gradient(slot).ravel()))
    assert float(torch.cosine_similarity(*found, dim=0)) > 0.97


def test_global_sparsity_samples_the_whole_box(rig, clip):
    trainer = trainer_of(rig, clip, "global")
    points = trainer.trainer.sampler.sample_empty(4000, torch.Generator().manual_seed(2))
    low, high = torch.from_numpy(rig.box_low), torch.from_numpy(rig.box_high)
    assert (points >= low).all()
    assert (points <= high).all()
    torch.testing.assert_close(points.mean(dim=0), (low + high) / 2, atol=0.05, rtol=0)
    # uniform on each axis: its spread is that of a uniform distribution
    torch.testing.assert_close(points.std(dim=0), (high - low) / 12**0.5, atol=0.02, rtol=0)


def test_global_sparsity_pulls_as_the_opacity_of_its_points_does(rig, clip):
    """Its gradient for the network's last bias, against central differences in double."""
    trainer = trainer_of(rig, clip, "global")
    for _ in range(10):
        trainer.step(rate=1.0, hard_surface_share=0.0)
    trainer = trainer.trainer
    field, config = trainer.field, trainer.config
    batch = trainer.replay.sample_rays(config.rays, torch.Generator().manual_seed(1))
    pulls = []
    for weight in (
        1e-12,
        config.empty_space_weight,
    ):  # not 0: the points must be drawn all the same
        field.table_grad.zero_()
        compute_gradients(
            trainer.learner, trainer.sampler, trainer.replay.correspondences, batch,
            dataclasses.replace(
                config, empty_space_weight=weight, faint_gradient_share=0.0
            ),
            hard_surface_share=0.0, generator=torch.Generator().manual_seed(2),
        )  # fmt: skip
        pulls.append(float(field.layers[3].grad[3]))
    points = trainer.sampler.sample_empty(
        config.empty_space_points, torch.Generator().manual_seed(2)
    )
    raw = field.raw_outputs_at(points)[:, 3].double()

    def mean_opacity(shift):
        return float((1.0 - torch.exp(-torch.exp(raw + shift) * 0.01)).mean())

    measured = (mean_opacity(1e-4) - mean_opacity(-1e-4)) / 2e-4
    assert pulls[1] - pulls[0] == pytest.approx(config.empty_space_weight * measured, rel=1e-3)
