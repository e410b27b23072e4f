"""Tests for the appearance model of the person's surface."""

import numpy as np
import pytest

from capture.camera import Camera
from preprocess.body.body_pose import BodyPose
from preprocess.masks.clothing_offset import ClothedBody, ClothingOffset
from preprocess.masks.color_models import MIN_COLOR_SPREAD, AppearanceModel, VertexVisibility

SIZE = (160, 200)
FRONT, BACK = np.float64([200, 60, 30]), np.float64([20, 90, 180])


@pytest.fixture
def camera() -> Camera:
    """2.8 m before a person at rest."""
    upright = np.diag([1.0, -1.0, -1.0, 1.0])
    upright[:3, 3] = [0.0, -0.2, 2.8]
    matrix = np.array([[250.0, 0, 80], [0, 250, 100], [0, 0, 1]])
    return Camera.from_intrinsic(matrix, SIZE, upright)


@pytest.fixture
def turned(shaped, camera):
    shell = ClothingOffset(shaped)

    def turned(yaw: float) -> tuple[ClothedBody, VertexVisibility]:
        pose = BodyPose(
            root_rotation=np.array([0.0, yaw, 0.0]),
            root_translation=np.zeros(3),
            joint_rotations=np.zeros((23, 3)),
        )
        around = shell.clothe(pose, camera)
        assert around is not None
        return around, VertexVisibility.of(around, camera)

    return turned


def test_visible_vertices_face_the_camera_and_are_not_occluded(shaped, turned):
    around, sight = turned(0.0)
    depth = around.skin[:, 2]  # the camera looks down the z axis
    trunk = (np.abs(shaped.vertices[:, 0]) < 0.1) & (np.abs(shaped.vertices[:, 1]) < 0.2)
    np.testing.assert_allclose(sight.facing, around.normals[:, 2], atol=0.4)
    assert sight.visible[trunk & (sight.facing > 0.8)].mean() > 0.98
    assert sight.visible[trunk & (sight.facing < -0.8)].mean() < 0.1
    assert depth[sight.visible].mean() > depth[~sight.visible].mean()


def test_colors_seen_from_the_front_predict_the_outline_after_a_turn(shaped, camera, turned):
    """One half of the body is red, the other blue: of the rim one side is red, then the other."""
    left = shaped.vertices[:, 0] > 0.0
    colors = AppearanceModel(len(left))
    inside = np.full(SIZE[::-1], 9.0, np.float32)
    for yaw in (0.0, np.pi) * 3:
        _, sight = turned(yaw)
        swapped = yaw > 0.0
        columns = np.arange(SIZE[0]) + 0.5 > camera.center_px[0]
        picture = np.where((columns != swapped)[:, None], FRONT, BACK)
        rgb = np.broadcast_to(picture, (*SIZE[::-1], 3)).astype(np.uint8)
        colors.update(sight, rgb, inside)
    for yaw, expected in ((0.5 * np.pi, BACK), (-0.5 * np.pi, FRONT)):
        _, sight = turned(yaw)
        told, spread = colors.predict(sight, SIZE)
        # now the one half is before the other
        rim = sight.visible & (sight.facing > 0.2) & (sight.facing < 0.6) & (left == (yaw < 0))
        column, row = sight.pixels[rim].astype(int).T
        known = spread[row, column] < 1.2 * MIN_COLOR_SPREAD
        assert known.mean() > 0.2
        np.testing.assert_allclose(np.median(told[row, column][known], axis=0), expected, atol=2.0)
        assert np.isinf(spread[0]).all()


def test_no_color_is_learnt_near_the_border(turned, camera):
    _, sight = turned(0.0)
    colors = AppearanceModel(len(sight.visible))
    rgb = np.full((*SIZE[::-1], 3), 99, np.uint8)
    colors.update(sight, rgb, np.full(SIZE[::-1], 1.0, np.float32))
    _, spread = colors.predict(sight, SIZE)
    assert np.isinf(spread).all()
