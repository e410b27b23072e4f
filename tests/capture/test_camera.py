"""The camera against closed forms and itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from capture.camera import Camera


def camera_at(seed: int, distortion: tuple[float, ...] = ()) -> Camera:
    rng = np.random.default_rng(seed)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    camera_from_world[:3, 3] = rng.normal(size=3)
    return Camera(
        focal_px=(210.0, 190.0), center_px=(101.0, 77.5), size_px=(200, 150),
        camera_from_world=camera_from_world, distortion=distortion,
    )  # fmt: skip


def plain_camera(*distortion: float) -> Camera:
    """A square one, at the origin."""
    return Camera(
        focal_px=(100.0, 100.0), center_px=(50.0, 50.0), size_px=(100, 100),
        camera_from_world=np.eye(4), distortion=distortion,
    )  # fmt: skip


@given(seed=st.integers(0, 1000), depth=st.floats(0.1, 50.0))
@settings(max_examples=25)
@pytest.mark.parametrize("distortion", [(), (0.05, -0.02, 0.001, -0.001)])
def test_a_point_on_a_ray_projects_back_to_its_pixel(seed, depth, distortion):
    camera = camera_at(seed, distortion)
    pixels = np.random.default_rng(seed).uniform((0, 0), (200, 150), size=(20, 2))
    directions = camera.ray_directions(pixels)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0)
    points = camera.center_world + depth * directions
    np.testing.assert_allclose(camera.project(points), pixels, atol=2e-2 if distortion else 1e-8)


def test_the_camera_looks_along_z_with_x_right_and_y_down():
    camera = plain_camera()
    np.testing.assert_allclose(camera.ray_directions(np.array([50.0, 50.0])), [0.0, 0.0, 1.0])
    np.testing.assert_allclose(camera.project(np.array([1.0, 2.0, 4.0])), [75.0, 100.0])


def test_a_resized_camera_sees_the_same_directions():
    camera = camera_at(5)
    half = camera.resize((100, 75))
    pixels = np.array([[0.0, 0.0], [13.0, 99.0], [200.0, 150.0]])
    np.testing.assert_allclose(
        half.ray_directions(pixels / 2), camera.ray_directions(pixels), atol=1e-12
    )
    np.testing.assert_allclose(half.resize((200, 150)).intrinsic, camera.intrinsic)


def test_the_intrinsic_matrix_goes_round():
    camera = camera_at(7, (0.1, 0.0, 0.0, 0.0))
    again = Camera.from_intrinsic(
        camera.intrinsic, camera.size_px, camera.camera_from_world, camera.distortion
    )
    np.testing.assert_array_equal(again.intrinsic, camera.intrinsic)
    assert again.distortion == camera.distortion


def test_barrel_distortion_pulls_points_inwards():
    point = np.array([1.0, 0.0, 1.0])  # r = 1: r (1 + k1 r²) = 0.9
    camera = plain_camera(-0.1, 0.0, 0.0, 0.0)
    np.testing.assert_allclose(camera.project(point), [50.0 + 90.0, 50.0])
