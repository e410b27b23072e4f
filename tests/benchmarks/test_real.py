"""What the benchmark of captures like real ones compares with the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from baselines.systems.compared_capture import place_in_true_view
from benchmarks.real import RealJob, ingest_command, table_lines
from benchmarks.real_scores import pose_error_deg, rest_joint_distance_cm
from capture.camera import Camera
from capture.source import Frame
from preprocess.body.body_pose import BodyPose
from preprocess.observation import Observation
from studio.outfit import BodyProportions

CAMERA = Camera(
    focal_px=(300.0, 300.0),
    center_px=(54.0, 96.0),
    size_px=(108, 192),
    camera_from_world=np.array(
        [[1.0, 0, 0, 0], [0, -1.0, 0, 0.2], [0, 0, -1.0, 3.5], [0, 0, 0, 1.0]]
    ),
)


def a_pose(rng):
    return BodyPose(
        root_rotation=np.array([0.0, 0.7, 0.0]),
        root_translation=np.array([0.1, 0.2, -0.1]),
        joint_rotations=0.2 * rng.standard_normal((23, 3)),
    )


def test_a_person_of_other_proportions_is_placed_where_the_truth_is_seen(shaped, rng):
    own = BodyProportions(height=1.1, legs=1.05)
    tall = replace(
        shaped,
        joints=own.move_joints(shaped.joints),
        vertices=own.move_vertices(shaped.vertices, shaped.body.weights, shaped.joints),
    )
    seen = Observation(
        frame=Frame(index=0, time_s=0.0, rgb=np.zeros((192, 108, 3), dtype=np.uint8)),
        alpha=np.zeros((192, 108), dtype=np.float32),
        pose=a_pose(rng),
        camera=CAMERA,
    )
    moved = place_in_true_view(seen, tall, shaped)
    at = CAMERA.project(shaped.with_pose(seen.pose).joints())
    before = CAMERA.project(tall.with_pose(seen.pose).joints())
    after = CAMERA.project(tall.with_pose(moved.pose).joints())
    assert np.abs(after - at).max() < 3.0
    assert np.abs(before - at).max() > 2.0 * np.abs(after - at).max()
    np.testing.assert_array_equal(moved.pose.joint_rotations, seen.pose.joint_rotations)


def test_pose_errors_do_not_depend_on_the_world(rng):
    pose = a_pose(rng)
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix()
    other_world = replace(CAMERA, camera_from_world=CAMERA.camera_from_world @ turned.T)
    root = Rotation.from_matrix(turned[:3, :3]) * Rotation.from_rotvec(pose.root_rotation)
    same = replace(pose, root_rotation=root.as_rotvec())
    assert pose_error_deg((pose, CAMERA), (same, other_world)) < 1e-5


def test_the_pose_error_is_the_mean_angle_over_joints():
    rest = BodyPose.rest()
    bent = rest.joint_rotations.copy()
    bent[3] = (np.deg2rad(22.0), 0.0, 0.0)
    bent[22] = (1.0, 0.0, 0.0)  # inside a hand: does not count
    wrong = replace(rest, joint_rotations=bent)
    assert pose_error_deg((wrong, CAMERA), (rest, CAMERA)) == pytest.approx(1.0)


def test_rest_joints_are_compared_pelvis_on_pelvis(shaped):
    assert rest_joint_distance_cm(shaped.joints + 1.0, shaped.joints) == pytest.approx(0.0)
    grown = shaped.joints * 1.05
    assert 1.0 < rest_joint_distance_cm(grown, shaped.joints) < 5.0


def test_exact_inputs_all_come_from_the_truth():
    job, capture = RealJob(quick=True).effective, Path("c")
    words = ingest_command(job, capture, exact=True)
    for option in ("--poses", "--masks", "--cameras", "--body"):
        assert words[words.index(option) + 1].startswith(str(capture / "truth"))
    assert words[words.index("--steps") + 1] == "300"
    assert "--poses" not in ingest_command(job, capture)


def test_the_table_has_a_column_for_each_capture_and_their_mean():
    lines = table_lines({"one": {"dB": 20.0, "cm": None}, "two": {"dB": 30.0}})
    assert [cell.strip() for cell in lines[0].split("|")[1:-1]] == ["figure", "one", "two", "mean"]
    assert [cell.strip() for cell in lines[2].split("|")[1:-1]] == ["dB", "20.0", "30.0", "25.0"]
    assert [cell.strip() for cell in lines[3].split("|")[1:-1]] == ["cm", "-", "-", "-"]
