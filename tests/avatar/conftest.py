"""Stand-ins for the avatar's tests: a rig, poses, and small hash levels."""

import numpy as np
import pytest
import torch

from avatar.levels import HashLevels
from avatar.rig import Rig


@pytest.fixture(scope="session")
def rig(shaped) -> Rig:
    return Rig.of(shaped)


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def levels() -> HashLevels:
    """Four levels over a box that is no cube: the first two are dense, the others hashed."""
    low, high = np.array([-1.0, -0.5, 0.0]), np.array([1.0, 0.9, 0.4])
    return HashLevels.over(
        low.astype(np.float32), high.astype(np.float32),
        coarsest_m=0.2, finest_m=0.02, levels=4, table_size=4096,
    )  # fmt: skip


@pytest.fixture
def bent_pose() -> np.ndarray:
    """Arms down, an elbow bent, a knee lifted: folds, but no contact."""
    rotations = np.zeros((23, 3))
    rotations[15] = 0.0, 0.0, -1.0
    rotations[16] = 0.0, 0.3, 0.8
    rotations[17] = 0.0, -0.8, 0.0
    rotations[0] = -0.6, 0.0, 0.1
    rotations[3] = 0.9, 0.0, 0.0
    return rotations
