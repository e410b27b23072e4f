"""The paper's schemes learn."""

import dataclasses

import numpy as np
import pytest

from avatar.config import TrainConfig
from avatar.training.frame_stream import prepare_frame
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
    "name", slow_where(sorted({*SCHEMES, *LOSSES}), lambda name: name != "global")
)
def test_every_variant_learns(rig, clip, name):
    trainer = trainer_of(rig, clip, name)
    color = []
    for _ in range(30):
        result = trainer.step(rate=1.0, hard_surface_share=0.0)
        assert result.sample_count > 200
        color.append(float(result.loss.mean()))
    assert np.mean(color[-5:]) < 0.5 * np.mean(color[:5])
