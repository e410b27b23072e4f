"""The player page's sample motions."""

import numpy as np
import pytest

from instant_avatar.animation.sample_motions import sample_motions
from preprocess.body.kinematics import rotation_matrices


@pytest.mark.parametrize("name", list(sample_motions()))
def test_a_sample_motion_begins_again_without_a_jump(name):
    motion = sample_motions()[name]
    rotations = np.concatenate([motion.root_rotations[:, None], motion.joint_rotations], axis=1)
    turned = rotation_matrices(rotations.reshape(-1, 3)).reshape(len(motion), 24, 3, 3)
    steps = np.abs(np.diff(turned, axis=0, append=turned[:1])).max(axis=(1, 2, 3))
    assert steps.max() > 0.02  # it moves
    assert steps[-1] <= 1.1 * steps[:-1].max()
