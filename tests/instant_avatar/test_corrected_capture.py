"""Poses that are assigned to other frames."""

import numpy as np

from instant_avatar.corrected_capture import renumber_motion
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.body.body_pose import Motion


def test_poses_on_both_sides_of_a_gap_stay_valid_and_those_within_are_not():
    motion = Motion(
        root_rotations=np.zeros((4, 3)),
        root_translations=np.arange(12.0).reshape(4, 3),
        joint_rotations=np.zeros((4, 23, 3)),
        valid=np.ones(4, dtype=bool),
        betas=np.zeros(10),
        body_model="smpl",
    )
    geometry = CaptureGeometry(
        motion=motion,
        row_frames=np.array([0.0, 1.0, 5.0, 6.0]),
        intrinsics=np.eye(3)[None],
        extrinsics=np.eye(4)[None],
        size_px=(64, 64),
    )
    renumbered = renumber_motion(geometry, 7, resampled=True)
    assert np.flatnonzero(renumbered.valid).tolist() == [0, 1, 5, 6]
    np.testing.assert_allclose(
        renumbered.root_translations[renumbered.valid], motion.root_translations
    )
