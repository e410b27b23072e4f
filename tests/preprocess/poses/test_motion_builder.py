"""Poses brought to other bodies, worlds and cameras stay where they were seen."""

from dataclasses import replace

import numpy as np
import pytest

from capture.camera import Camera
from preprocess.body.body_pose import RelativeFocalLength
from preprocess.body.kinematics import rotation_matrices
from preprocess.cameras.camera_file import CameraTrack, assume_static_camera
from preprocess.poses.motion_builder import (
    anchor_at_pelvis,
    place_in_camera_world,
    transform_motion,
)

SIZE = (720, 1280)


def camera(focal: float, transform: np.ndarray | None = None) -> Camera:
    matrix = np.array([[focal, 0.0, 360.0], [0.0, focal, 640.0], [0.0, 0.0, 1.0]])
    return Camera.from_intrinsic(matrix, SIZE, transform)


def rigid(rng) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3] = rotation_matrices(rng.normal(size=3))
    transform[:3, 3] = rng.normal(size=3)
    return transform


def track_of(*cameras: Camera) -> CameraTrack:
    return CameraTrack(cameras=cameras, source="test")


def test_a_world_that_is_turned_and_shifted_takes_the_joints_along(truth, shaped, joints_of, rng):
    a_from_b = np.stack([rigid(rng) for _ in range(len(truth))])
    there = joints_of(transform_motion(truth, a_from_b, shaped.joints[0]))
    expected = np.einsum("nab,njb->nja", a_from_b[:, :3, :3], joints_of(truth))
    np.testing.assert_allclose(there, expected + a_from_b[:, None, :3, 3], atol=1e-9)


@pytest.mark.parametrize("anchor", ["origin", "hips"])
def test_another_anchor_of_the_root_is_the_same_motion(truth, shaped, joints_of, anchor):
    rest = shaped.joints
    point = np.zeros(3) if anchor == "origin" else rest[1:3].mean(axis=0)
    turn = rotation_matrices(truth.root_rotations)
    at = rest[0] + truth.root_translations + turn @ (point - rest[0])
    told = replace(truth, anchor=anchor, root_translations=at)
    np.testing.assert_allclose(joints_of(anchor_at_pelvis(told, rest)), joints_of(truth), atol=1e-9)
    middle = joints_of(truth)[:, 1:3].mean(axis=1)
    if anchor == "hips":
        np.testing.assert_allclose(at, middle, atol=1e-9)


def test_poses_of_a_camera_that_moves_land_in_its_world(truth, shaped, joints_of, rng):
    """Each row by the camera of its frame."""
    cameras = [camera(900.0, rigid(rng)) for _ in range(90)]
    tracked = replace(truth, space="camera", frames=np.arange(40) + 50)
    there = place_in_camera_world(tracked, shaped, track_of(*cameras), cameras_given=True)
    assert there.space == "world"
    for seen, joints, true in zip(cameras[50:], joints_of(there), joints_of(truth), strict=True):
        transform = seen.camera_from_world
        back = joints @ transform[:3, :3].T + transform[:3, 3]
        np.testing.assert_allclose(back, true, atol=1e-9)


def test_a_files_own_cameras_count_unless_others_are_given(truth, shaped, joints_of, rng):
    transforms = np.stack([rigid(rng) for _ in range(len(truth))])
    stated = replace(truth, camera_from_world=transforms)
    cameras = track_of(camera(900.0))
    assert place_in_camera_world(stated, shaped, cameras, cameras_given=True) is stated
    there = joints_of(place_in_camera_world(stated, shaped, cameras, cameras_given=False))
    expected = np.einsum("nab,njb->nja", transforms[:, :3, :3], joints_of(truth))
    np.testing.assert_allclose(there, expected + transforms[:, None, :3, 3], atol=1e-9)


def test_the_same_focal_length_moves_nothing(truth, shaped):
    tracked = replace(truth, space="camera", intrinsic=camera(900.0).intrinsic)
    there = place_in_camera_world(tracked, shaped, track_of(camera(900.0)), cameras_given=True)
    np.testing.assert_array_equal(there.root_translations, truth.root_translations)


@pytest.mark.parametrize("share", [0.6, 1.3, 5000.0 / 256.0])
def test_a_virtual_focal_length_is_solved_for_the_true_one(truth, shaped, joints_of, share):
    """What a tracker with a wrong focal length writes, brought to the true one, is the truth."""
    true, wrong = camera(1100.0), RelativeFocalLength(ratio=share)
    virtual = Camera.from_intrinsic(wrong.intrinsic_matrix(SIZE), SIZE)
    exact = replace(truth, space="camera", intrinsic=true.intrinsic)
    seen = place_in_camera_world(exact, shaped, track_of(virtual), cameras_given=True)
    told = replace(seen, space="camera", intrinsic=None, assumed_focal=wrong)
    back = place_in_camera_world(told, shaped, track_of(true), cameras_given=True)
    off = true.project(joints_of(back)) - true.project(joints_of(truth))
    tall = np.ptp(true.project(joints_of(truth))[..., 1], axis=1).mean()
    assert np.sqrt((off**2).sum(axis=-1).mean()) < 0.02 * tall
    depth = back.root_translations[:, 2] / truth.root_translations[:, 2]
    assert np.abs(depth - 1.0).max() < 0.06
    assert np.median(np.abs(depth - 1.0)) < 0.02


def test_without_a_camera_a_plausible_lens_counts_and_another_does_not(truth):
    def assumed(size=SIZE, **lens):
        told = replace(truth, assumed_focal=RelativeFocalLength(**lens))
        return assume_static_camera(told, size)

    assert assumed(ratio=1.2).cameras[0].focal_px[0] == 1536
    diagonal = assumed((300, 400), ratio=1.0, reference="diagonal")
    assert diagonal.cameras[0].focal_px == (500.0, 500.0)
    phone = assumed(ratio=5000.0 / 256.0)
    assert phone.cameras[0].focal_px[0] == pytest.approx(0.85 * 1280)
    assert "19.5" in phone.note


def test_a_matrix_of_smaller_pictures_is_scaled(truth):
    small = replace(truth, intrinsic=np.array([[450.0, 0, 180], [0, 450, 320], [0, 0, 1]]))
    assert assume_static_camera(small, SIZE).cameras[0].focal_px == (900.0, 900.0)
    near = np.array([[900.0, 0, 350], [0, 900, 650], [0, 0, 1]])
    found = assume_static_camera(replace(truth, intrinsic=near), SIZE)
    assert found.cameras[0].center_px == (350, 650)
