"""The fixtures of the paper's schemes."""

import numpy as np
import pytest
import torch

from avatar.occupancy_grid import SOLID_DENSITY
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


@pytest.fixture(scope="session")
def solid_in(bones_of):
    """Where skinning carries the centres of dense canonical cells, body frame."""

    def solid(avatar, pose):
        grid = avatar.occupancy.density_grid
        cells = (grid.density > SOLID_DENSITY).nonzero()
        points = ((cells + 0.5) / grid.cells_per_m + grid.low).numpy()
        matrix = (avatar.rig.weights_at(points) @ bones_of(avatar.rig, pose).numpy()).reshape(
            -1, 3, 4
        )
        carried = (matrix[..., :3] @ points[..., None])[..., 0] + matrix[..., 3]
        return torch.from_numpy(carried.astype(np.float32))

    return solid
