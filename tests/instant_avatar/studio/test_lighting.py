import numpy as np
import pytest

from capture.camera import Camera
from instant_avatar.studio.lighting import NO_FACE, rasterize

SIZE = 40


@pytest.fixture
def camera():
    return Camera(
        focal_px=(50.0, 50.0),
        center_px=(SIZE / 2, SIZE / 2),
        size_px=(SIZE, SIZE),
        camera_from_world=np.eye(4),
    )


def rectangle(left, right, top, bottom, depth):
    """Two triangles at one depth, whose corners project to the given pixels."""
    corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
    points = [((x - SIZE / 2) / 50 * depth, (y - SIZE / 2) / 50 * depth, depth) for x, y in corners]
    return np.array(points), np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)


def test_a_tilted_plane_is_as_deep_as_its_equation_says(camera):
    normal, offset = np.array([0.5, -0.3, 1.0]), 2.0  # normal · x = offset
    points = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 20.0, 0.0]]) * 0.05
    points[:, 2] = offset - points[:, :2] @ normal[:2]
    seen = rasterize(points, np.array([[0, 1, 2]], dtype=np.int32), camera, supersampling=2)
    rows, columns = np.nonzero(seen.face != NO_FACE)
    assert len(rows) > 100
    pixels = np.stack([columns + 0.5, rows + 0.5], axis=1) / 2
    rays = np.concatenate([(pixels - SIZE / 2) / 50, np.ones((len(rows), 1))], axis=1)
    expected = offset / (rays @ normal)
    np.testing.assert_allclose(seen.depth[rows, columns], expected, rtol=1e-4)


def test_the_nearer_of_two_triangles_is_seen_whatever_their_order(camera):
    near, faces = rectangle(10, 30, 10, 30, 1.0)
    far, _ = rectangle(5, 35, 5, 35, 2.0)
    for first, second, nearer in ((near, far, (0, 1)), (far, near, (2, 3))):
        seen = rasterize(
            np.concatenate([first, second]), np.concatenate([faces, faces + 4]), camera
        )
        middle = seen.face[20 * 4 : 21 * 4, 12 * 4 : 28 * 4]
        assert np.isin(middle, nearer).all()
        assert np.isin(seen.face[7 * 4, 6 * 4 : 34 * 4], [2 - nearer[0], 3 - nearer[0]]).all()
