"""Neural Body: its sparse convolutions against dense ones, and the codes' equivariance."""

import pytest
import torch
from torch import nn

from avatar.training.frame_stream import prepare_frame
from baselines.systems.baseline_training import BaselineSystem
from baselines.systems.method_settings import MethodSettings
from baselines.systems.neural_body import NeuralBody
from baselines.systems.posed_person import SkinnedPerson
from baselines.systems.voxel_convolution import ActiveVoxels, VoxelConvolution

TINY = MethodSettings(
    frames=1, rays=192, samples=12, width=16, octaves=2,
    voxel_m=0.05, channels=4, learning_rate=5e-3,
)  # fmt: skip


@pytest.fixture(scope="module")
def person(rig, shaped):
    return SkinnedPerson(rig, shaped)


def dense_kernel(layer, inputs, outputs):
    """The layer's weights as those of a dense convolution; taps run over x, y, z."""
    kernel = layer.kernel.weight.view(outputs, 3, 3, 3, inputs)
    return kernel.permute(0, 4, 1, 2, 3)


@pytest.mark.parametrize("stride", [1, 2])
def test_a_sparse_convolution_is_the_dense_one_where_it_is_active(stride):
    torch.manual_seed(0)
    occupied = torch.rand(6, 8, 10) < 0.2
    voxels = ActiveVoxels(occupied.nonzero(), (6, 8, 10))
    features, layer = torch.randn(len(voxels.places), 3), VoxelConvolution(3, 5)
    layer.norm = nn.Identity()
    to = voxels if stride == 1 else voxels.halved()
    found = layer(features, voxels.neighbors(to, stride))
    dense = torch.zeros(3, 6, 8, 10)
    dense[:, occupied] = features.T
    weight = dense_kernel(layer, 3, 5)
    wanted = torch.relu(nn.functional.conv3d(dense[None], weight, stride=stride, padding=1))[0]
    torch.testing.assert_close(found, wanted[(slice(None), *to.places.T)].T)
    if stride == 2:  # and nothing is active but what sees an active voxel
        seen = nn.functional.max_pool3d(occupied[None, None].float(), 3, 2, 1)[0, 0] > 0
        assert set(map(tuple, to.places.tolist())) == set(map(tuple, seen.nonzero().tolist()))


@pytest.mark.slow
def test_it_learns(person, rig, clip):
    frames = [prepare_frame(seen, rig) for seen in clip.observations[:2]]
    torch.manual_seed(0)
    system = BaselineSystem(NeuralBody(person, 2, TINY), person, frames, TINY)
    losses = [system.step(share / 40.0) for share in range(40)]
    assert sum(losses[-5:]) < 0.8 * sum(losses[:5])
    assert system.render(clip.novel)[..., 3].max() <= 1.0 + 1e-5
