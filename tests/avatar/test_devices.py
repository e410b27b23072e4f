"""The whole program asks nothing of its device but what torch offers on any."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar.config import TrainConfig
from avatar.evaluation.held_out import HeldOutFrame, score_frame
from avatar.events import Evaluated, Finished
from avatar.training import checkpoint, held_out_pose_fitting, pose_correction
from avatar.training import train as train_module
from avatar.training.frame_stream import prepare_stream
from avatar.training.pose_optimizer import FIRST_CORRECTION_STEPS
from avatar.training.train import train
from avatar.training.trainer import Trainer
from baselines.instant_avatar.samplers import BaselineScheme, BaselineTrainer
from capture.inbox import Inbox
from preprocess.observation import Observation

sys.path.insert(0, str(Path(__file__).parent))
from fake_device import FAKE_DEVICE, DeviceMixUpError, FakeDeviceTensor, fake_device

CONFIG = TrainConfig(
    rays=128, sample_step_m=0.03, finest_m=0.05, levels=3, table_size=1 << 10,
    empty_space_points=16, replay_capacity=3, max_samples=64, occupancy_interval=4,
)  # fmt: skip


@pytest.fixture(scope="module")
def device():
    with fake_device() as place:
        yield place


def test_a_mix_up_of_devices_shows(device):
    """Of the stand-in itself: it refuses what a GPU refuses."""
    there = torch.rand(3, device=device, generator=torch.Generator(device=device))
    with pytest.raises(DeviceMixUpError):
        there + torch.ones(3)
    with pytest.raises(DeviceMixUpError):
        there.numpy()
    with pytest.raises(DeviceMixUpError):
        torch.rand(3, device=device, generator=torch.Generator())
    assert isinstance(there + 1.0, FakeDeviceTensor)
    assert np.isfinite((there + 1.0).cpu().numpy()).all()


@pytest.fixture(scope="module")
def trainer(device, rig, clip):
    """Trained until poses are refined and the occupancy has been updated."""
    trainer = Trainer(rig, CONFIG, device)
    for item in prepare_stream(iter(clip.observations[:4]), rig, stride=0, total=None):
        trainer.add_frame(item)
    trainer.steps = FIRST_CORRECTION_STEPS - 3
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            pose_correction, "MIN_EVIDENCE", -1.0
        )  # these poses are exact, and would not move
        patch.setattr(pose_correction, "FULL_EVIDENCE", 0.0)
        for _ in range(12):
            trainer.step(rate=1.0, hard_surface_share=1.0)
    return trainer


def small(observation: Observation) -> Observation:
    """A third of its size: plain torch takes long for each pixel."""
    frame = replace(observation.frame, rgb=np.ascontiguousarray(observation.frame.rgb[::3, ::3]))
    return replace(
        observation, frame=frame, alpha=np.ascontiguousarray(observation.alpha[::3, ::3]),
        camera=observation.camera.resize((24, 24)),
    )  # fmt: skip


def held_out(clip, rig) -> list[HeldOutFrame]:
    return [next(prepare_stream(iter([small(clip.novel)]), rig, stride=1, total=None))]


def test_training_rendering_and_fitting_stay_on_their_device(trainer, clip, rig, monkeypatch):
    assert trainer.backend.name == "torch"
    assert all(parameter.device == FAKE_DEVICE for parameter in trainer.avatar.field.parameters())
    assert trainer.pose_corrections  # poses were refined, too
    held = held_out(clip, rig)
    assert np.isfinite(score_frame(trainer.avatar, held[0]).psnr)
    monkeypatch.setattr(held_out_pose_fitting, "CORRECTIONS_PER_FRAME", 4)
    (fitted,) = held_out_pose_fitting.fit_test_poses(trainer, held[:1])
    assert np.isfinite(score_frame(trainer.avatar, fitted).psnr)


@pytest.mark.parametrize(
    "scheme",
    [
        {"skipping": "union", "roots": "broyden"}, {"skipping": "frame"},
        {"skipping": "none", "empty_term": "global"},
    ],
    ids=["union", "frame", "none"],
)  # fmt: skip
def test_the_papers_schemes_stay_on_their_device(device, scheme, rig, clip):
    config = replace(CONFIG, rays=8, refine_poses=False)
    trainer = BaselineTrainer(rig, config, device, BaselineScheme(**scheme))
    trainer.add_frame(next(prepare_stream(iter(clip.observations[:1]), rig, stride=0, total=None)))
    for _ in range(2):
        result = trainer.step(rate=1.0, hard_surface_share=1.0)
    assert result.loss.device == FAKE_DEVICE
    assert torch.isfinite(trainer.trainer.avatar.field.table.cpu()).all()


def test_a_checkpoint_goes_from_one_device_to_another(trainer, tmp_path):
    checkpoint.save(trainer, tmp_path)
    for device in (FAKE_DEVICE, torch.device("cpu")):
        loaded, _ = checkpoint.load(tmp_path, device)
        tables = [one.avatar.field.table.detach().cpu() for one in (trainer, loaded)]
        assert torch.equal(*tables)
        assert loaded.avatar.field.table.device == device
        moments = [state["exp_avg"] for state in loaded.optimizer.state.values()]
        assert {moment.device for moment in moments} == {device}


def test_the_stream_of_training_runs_on_a_device(device, clip, rig, monkeypatch):
    monkeypatch.setattr(train_module, "EVALUATION_TIMES_S", (3 / 50, 60.0))  # after 3 steps
    trainer = Trainer(rig, replace(CONFIG, steps=5, refine_poses=False), device)
    held: list[HeldOutFrame] = []
    frames = prepare_stream(map(small, clip.observations[:4]), rig, stride=3, total=None)
    events = list(train(trainer, Inbox(frames), held))
    assert isinstance(events[-1], Finished)
    assert [len(event.scores) for event in events if isinstance(event, Evaluated)] == [1]


def test_a_field_is_read_out_on_its_device(trainer):
    points = torch.from_numpy(trainer.avatar.rig.seeds[:50]).to(FAKE_DEVICE)
    color, density = trainer.avatar.color_and_density_at(points)
    assert color.device == density.device == FAKE_DEVICE
