"""What the benchmark of captures like real ones compares with the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.real import RealJob, ingest_command
from benchmarks.real_scores import pose_error_deg
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose

CAMERA = Camera(
    focal_px=(300.0, 300.0),
    center_px=(54.0, 96.0),
    size_px=(108, 192),
    camera_from_world=np.array(
        [[1.0, 0, 0, 0], [0, -1.0, 0, 0.2], [0, 0, -1.0, 3.5], [0, 0, 0, 1.0]]
    ),
)


def test_the_pose_error_is_the_mean_angle_over_joints():
    rest = BodyPose.rest()
    bent = rest.joint_rotations.copy()
    bent[3] = (np.deg2rad(22.0), 0.0, 0.0)
    bent[22] = (1.0, 0.0, 0.0)  # inside a hand: does not count
    wrong = replace(rest, joint_rotations=bent)
    assert pose_error_deg((wrong, CAMERA), (rest, CAMERA)) == pytest.approx(1.0)


def test_exact_inputs_all_come_from_the_truth():
    job, capture = RealJob(quick=True).effective, Path("c")
    words = ingest_command(job, capture, exact=True)
    for option in ("--poses", "--masks", "--cameras", "--body"):
        assert words[words.index(option) + 1].startswith(str(capture / "truth"))
    assert words[words.index("--steps") + 1] == "300"
    assert "--poses" not in ingest_command(job, capture)
