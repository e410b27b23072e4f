"""The fixtures of the paper's schemes."""

import numpy as np
import pytest
import torch

from avatar.render import render


@pytest.fixture(scope="module")
def avatar(learnt):
    return learnt.trainer.avatar


@pytest.fixture(scope="module")
def novel(learnt):
    """The novel pose's picture by the exact renderer, and what it is a picture of."""
    seen = learnt.novel.observation
    picture = render(
        learnt.trainer.avatar, seen.pose, seen.camera, cells=learnt.novel.correspondences
    )
    return picture, seen, learnt.novel.correspondences


@pytest.fixture(scope="session")
def bones_of():
    """The bones of a pose, body frame from canonical, as the kernels take them."""

    def bones(rig, pose):
        bones = rig.body_from_canonical(pose.joint_rotations)[:, :3].reshape(24, 12)
        return torch.from_numpy(bones.astype(np.float32))

    return bones
