"""Views that no film shows: four sides of poses that are not the filmed one."""

import numpy as np
import pytest

from avatar.evaluation.unfilmed_views import VIEW_PX, half_transparent_share, unfilmed_views


def picture(*alphas):
    out = np.zeros((2, len(alphas), 4), dtype=np.float32)
    out[..., 3] = alphas
    return out


def test_pixels_are_half_transparent_between_empty_and_opaque():
    assert half_transparent_share([picture(0.0, 0.05, 1.0, 0.95)]) == 0.0
    assert half_transparent_share([picture(0.5, 1.0)]) == pytest.approx(0.5)
    assert half_transparent_share([picture(0.0, 0.5), picture(1.0, 1.0)]) == pytest.approx(1 / 3)


def test_an_avatar_of_which_nothing_is_seen_is_wholly_transparent():
    assert half_transparent_share([picture(0.0, 0.02)]) == 1.0


def test_the_person_is_whole_and_upright_in_every_view(rig, shaped):
    width, height = VIEW_PX
    views = list(unfilmed_views(rig))
    for pose, camera in views:
        place = camera.project(shaped.with_pose(pose).vertices())
        assert (place >= 0.0).all()
        assert (place <= [width, height]).all()
        head, pelvis = camera.project(shaped.with_pose(pose).joints())[[15, 0]]
        assert pelvis[1] - head[1] > 0.25 * height
    facing = [camera.center_world[2] > 0.0 for _, camera in views]
    assert 1 < sum(facing) < len(views)
