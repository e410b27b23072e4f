"""Instant-NGP without articulation: its gradient, and that no pose reaches it."""

import torch

from avatar.config import TrainConfig
from avatar.training.frame_stream import prepare_frame
from baselines.systems.baseline_training import BaselineSystem
from baselines.systems.instant_ngp import InstantNgp
from baselines.systems.method_settings import MethodSettings
from baselines.systems.posed_person import PoseTable, SkinnedPerson

TINY = MethodSettings(frames=3, rays=192, samples=24, learning_rate=2.5e-2)
CONFIG = TrainConfig(finest_m=0.04, levels=4, table_size=1 << 12)


def test_it_learns_a_frame_and_shows_the_same_in_every_pose(rig, shaped, clip):
    person = SkinnedPerson(rig, shaped)
    frames = [prepare_frame(seen, rig) for seen in clip.observations[:3]]
    torch.manual_seed(0)
    poses = PoseTable(person, frames)
    with torch.no_grad():
        skins = poses.bodies(torch.arange(3)).vertices
    system = BaselineSystem(InstantNgp(skins, TINY, CONFIG), person, frames, TINY)
    losses = [system.step(share / 40.0) for share in range(40)]
    assert sum(losses[-5:]) < 0.7 * sum(losses[:5])
    method, point = system.field, torch.tensor([[0.0, -0.3, 0.1]])
    shown = []
    for pose in (0, 2):
        method.pose(poses.bodies(torch.tensor([pose])))
        zero = torch.zeros(1, dtype=torch.int64)
        shown.append(method.radiance(point, point, zero, fine=False))
    torch.testing.assert_close(shown[0], shown[1])
