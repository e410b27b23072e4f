"""A small body of random vertices on the real tree, and a motion."""

import numpy as np
import pytest

from preprocess.pose import Motion
from preprocess.skeleton import PARENTS


@pytest.fixture
def smpl_arrays(rng) -> dict[str, np.ndarray]:
    """What an SMPL file holds, with 40 vertices."""
    regressor = rng.random((24, 40))
    weights = rng.random((40, 24))
    return {
        "v_template": rng.normal(size=(40, 3)),
        "shapedirs": 0.01 * rng.normal(size=(40, 3, 10)),
        "posedirs": 0.001 * rng.normal(size=(40, 3, 207)),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.array([PARENTS, range(24)]).astype(np.uint32),
        "f": rng.integers(0, 40, (70, 3)).astype(np.uint32),
    }


@pytest.fixture
def motion(rng) -> Motion:
    """Six small poses."""
    return Motion(
        root_rotations=0.3 * rng.normal(size=(6, 3)),
        root_translations=rng.normal(size=(6, 3)),
        joint_rotations=0.3 * rng.normal(size=(6, 23, 3)),
        valid=np.ones(6, dtype=bool),
        betas=rng.normal(size=10),
        body_model="body24",
    )
