"""Anim-NeRF: its inverse skinning against closed forms, and the frame that all baselines share."""

import numpy as np
import pytest
import torch

from avatar.training.frame_stream import prepare_frame
from baselines.systems.anim_nerf import AnimNerf
from baselines.systems.baseline_training import BaselineSystem
from baselines.systems.method_settings import MethodSettings
from baselines.systems.posed_person import (
    OccupiedCells,
    SkinnedPerson,
    apply_affine,
)
from baselines.systems.ray_rendering import BodyRays, render_rays

TINY = MethodSettings(
    frames=2, rays=256, samples=12, layers=2, width=32,
    octaves=4, pose_rate=1e-3, learning_rate=1e-2,
)  # fmt: skip


@pytest.fixture(scope="module")
def person(rig, shaped):
    return SkinnedPerson(rig, shaped)


def posed(person, joints):
    return person.pose(torch.from_numpy(np.asarray(joints)).float()[None], torch.tensor([-1]))


def test_a_vertex_moves_as_its_own_weights_say(person, bent_pose):
    method = AnimNerf(person, TINY)
    bodies = posed(person, bent_pose)
    method.pose(bodies)
    rigid = (person.weights.amax(dim=1) > 0.999).nonzero()[::20, 0]  # and so are their neighbors
    points = bodies.vertices[0][rigid]
    canonical, _ = method.warp(points, torch.zeros(len(points), dtype=torch.int64))
    error = (canonical - person.vertices[rigid]).norm(dim=1)
    assert float(error.median()) < 1e-4
    bone = person.weights[rigid].argmax(dim=1)
    back = apply_affine(bodies.bones[0, bone, :3], canonical)
    assert float((back - points).norm(dim=1).median()) < 1e-4


class Fog:
    """Density of one value in one box, in red."""

    def __init__(self, density):
        shape = torch.tensor([[10, 10, 10]])
        low, first = torch.tensor([[-0.2, -0.2, -0.2]]), torch.tensor([0])
        self.cells = OccupiedCells(low, shape, first, torch.ones(1000, dtype=torch.bool), 0.04)
        self._log = np.log(density)

    def pose(self, bodies):
        return self.cells

    def radiance(self, points, directions, bodies, *, fine):
        raw = torch.tensor([20.0, -20.0, -20.0, self._log], dtype=torch.float32)
        return raw.expand(len(points), 4)

    def prior_loss(self):
        return torch.zeros(())

    def parameter_groups(self):
        return []


@pytest.mark.parametrize("fine_samples", [0, 64])
def test_fog_has_the_opacity_of_its_closed_form(fine_samples):
    origins = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [1.0, 1.0, -1.0]])
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    rays = BodyRays(origins, directions, torch.zeros(3, dtype=torch.int64))
    fog = Fog(3.0)
    rgba = render_rays(fog, fog.cells, rays, samples=256, fine_samples=fine_samples, jitters=False)[
        -1
    ]
    opacity = 1.0 - np.exp(-3.0 * 0.4)
    np.testing.assert_allclose(rgba[0], [opacity, 0.0, 0.0, opacity], atol=3e-3)
    np.testing.assert_array_equal(rgba[2], np.zeros(4))


@pytest.fixture
def one_thread():
    """torch on one thread: several add gradients in the order in which they end."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_training_moves_field_and_poses_and_repeats_exactly(person, rig, clip):
    frames = [prepare_frame(seen, rig) for seen in clip.observations[:3]]

    def train():
        torch.manual_seed(0)
        system = BaselineSystem(AnimNerf(person, TINY), person, frames, TINY)
        losses = [system.step(share / 40.0) for share in range(40)]
        return system, losses

    system, losses = train()
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    assert float(system.poses.joints.detach().abs().max()) > 0.0
    assert losses == train()[1]
    picture = system.render(clip.novel)
    assert picture.shape == (*clip.novel.alpha.shape, 4)
    assert 0.0 < picture[..., 3].mean() < 1.0
