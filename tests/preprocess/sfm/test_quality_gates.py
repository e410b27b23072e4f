"""Tests for what a solution must pass: exact ones do, and each way of being wrong is named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preprocess.sfm.camera_solution import evaluate_gates, find_outlier_cameras
from tests.preprocess.sfm.conftest import exact_model, walked


def failed(gates) -> list[str]:
    return [gate.name for gate in gates if not gate.passed]


def transformed(model, *, scale=0.37, turn=(0.3, -0.8, 0.2), shift=(1.0, 2.0, -3.0)):
    """The same solution in a world of another size, turned and shifted."""
    rotation, shift = Rotation.from_rotvec(turn).as_matrix(), np.array(shift)
    centers = scale * model.camera_centers() @ rotation.T + shift
    cameras = model.camera_from_world.copy()
    cameras[:, :3, :3] = cameras[:, :3, :3] @ rotation.T
    cameras[:, :3, 3] = -np.einsum("cab,cb->ca", cameras[:, :3, :3], centers)
    points = scale * model.points @ rotation.T + shift
    return replace(model, camera_from_world=cameras, points=points)


def turned(model, row: int, degrees: float):
    """The same with one camera turned about its own centre."""
    cameras = model.camera_from_world.copy()
    turn = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    cameras[row, :3] = turn @ cameras[row, :3]
    return replace(model, camera_from_world=cameras)


def test_an_exact_solution_passes_whatever_its_world(model):
    for one in (model, transformed(model)):
        gates = evaluate_gates(one, len(one.frames))
        assert failed(gates) == []
        assert next(g.value for g in gates if g.name == "reprojection_px") < 1e-9
        assert not find_outlier_cameras(one).any()


def test_noise_of_pixels_is_measured(cameras, room_points):
    noisy = exact_model(cameras, room_points, noise_px=1.0)
    gates = evaluate_gates(noisy, len(cameras))
    assert failed(gates) == ["reprojection_px"]
    # the length of a vector of two normal numbers is sqrt(pi / 2) on average
    assert next(g.value for g in gates if g.name == "reprojection_px") == pytest.approx(
        np.sqrt(np.pi / 2), rel=0.02
    )


def test_key_frames_that_are_missing_are_counted(model):
    assert failed(evaluate_gates(model, round(len(model.frames) / 0.89))) == ["registered"]


@pytest.mark.parametrize(("share", "bound"), [(0.3, "0.5"), (2.6, "2")])
def test_an_impossible_focal_length_is_refused(cameras, room_points, share, bound):
    focal = share * 640
    lenses = [replace(camera, focal_px=(focal, focal)) for camera in cameras]
    gates = evaluate_gates(exact_model(lenses, room_points), len(cameras))
    assert "focal" in failed(gates)
    (focal_gate,) = (gate for gate in gates if gate.name == "focal")
    assert focal_gate.describe_failure().endswith(f"the bound is {bound})")


def test_a_camera_that_hardly_moves_is_refused(room_points):
    still = walked(24, degrees=0.2, size_px=(640, 480), focal_px=520.0)
    eye = still[0].camera_from_world[:3, 3]
    close = []
    for camera in still:
        near = camera.camera_from_world.copy()
        near[:3, 3] = eye + 0.02 * (near[:3, 3] - eye)
        close.append(replace(camera, camera_from_world=near))
    assert "angle_deg" in failed(evaluate_gates(exact_model(close, room_points), len(close)))


@pytest.mark.parametrize("row", [1, 11, 22])
def test_one_camera_that_looks_elsewhere_is_found(model, row):
    found = find_outlier_cameras(turned(model, row, 8.0))
    assert found.nonzero()[0].tolist() == [row]


def test_a_camera_placed_by_a_few_points_is_found(model):
    few = model.observations_of_camera(7)[20:]
    kept = np.setdiff1d(np.arange(len(model.pixels)), few)
    thinned = replace(
        model, observation_camera=model.observation_camera[kept],
        observation_point=model.observation_point[kept], pixels=model.pixels[kept],
    )  # fmt: skip
    assert find_outlier_cameras(thinned).nonzero()[0].tolist() == [7]
    rest = thinned.without_cameras(find_outlier_cameras(thinned))
    assert rest.frames.tolist() == [i for i in range(24) if i != 7]
    assert rest.reprojection_errors_px().max() < 1e-9
