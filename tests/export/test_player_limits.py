from dataclasses import replace

import numpy as np
import pytest

from export.player import PictureDifference, Player, premultiply
from export.player_inputs import ResolutionLimit, downscale_camera, upscale_picture


@pytest.fixture(scope="module")
def player(exported):
    return Player.load(exported.path)


@pytest.fixture(scope="module")
def close_ups(exported, player, tables):
    return ResolutionLimit(tables, player.manifest.tiers["hq"].settings)


def nearer(view, times):
    """Enlarge the picture about the same pixel of the chest."""
    (fx, fy), (x, y) = view.focal_px, view.center_px
    return replace(
        view, focal_px=(fx * times, fy * times), center_px=(x, 45.0 + (y - 45.0) * times)
    )


@pytest.mark.parametrize("zoom", [25.0, 60.0, 400.0])
def test_what_surfels_cannot_cover_is_drawn_coarser_and_without_gaps(
    player, close_ups, stand_in, camera, zoom
):
    view = nearer(camera(160, 160, distance_m=0.75), zoom)
    assert close_ups.downscale_factor(player.bones(stand_in.canonical, view), view) > 1.0
    picture = player.render(stand_in.canonical, view)
    assert picture.shape == (160, 160, 4)
    assert picture[..., 3].min() > 245


def test_a_usual_picture_is_drawn_as_it_is(player, close_ups, stand_in, bent, camera):
    for pose in (stand_in.canonical, bent):
        for view in (camera(160, 200), camera(1080, 1080), camera(160, 160, distance_m=0.75)):
            assert close_ups.downscale_factor(player.bones(pose, view), view) == 1.0


def test_what_lies_behind_the_camera_makes_no_close_up(player, close_ups, stand_in, camera):
    view = nearer(camera(160, 160), 60.0)
    behind = replace(stand_in.canonical, root_translation=np.array([0.0, 0.0, 9.0]))
    assert close_ups.downscale_factor(player.bones(behind, view), view) == 1.0


def test_a_coarser_picture_enlarged_shows_what_the_finer_one_shows(player, stand_in, camera):
    view = nearer(camera(160, 160, distance_m=0.75), 12.0)
    fine = player.render(stand_in.canonical, view)
    rough = upscale_picture(
        player.render(stand_in.canonical, downscale_camera(view, 1.7)), (160, 160), 1.7
    )
    difference = PictureDifference.of(premultiply(fine), premultiply(rough))
    assert np.abs(premultiply(fine) - premultiply(rough)).mean() < 1.0 / 255.0
    assert difference.close_fraction > 0.9


def test_enlarging_keeps_ramps_where_they_are():
    """Pixel centers of the coarse picture lie at (i + 0.5) · times of the fine one."""
    times, (width, height) = 2.5, (50, 20)
    ramp = np.full((8, 20, 4), 255, dtype=np.uint8)
    ramp[..., 0] = 5 + 10 * np.arange(20)
    fine = upscale_picture(ramp, (width, height), times)
    expected = 5 + 10 * ((np.arange(width) + 0.5) / times - 0.5)
    inside = slice(2, -2)  # outside the outer pixels' centers there is nothing to interpolate
    assert fine.shape == (height, width, 4)
    assert np.abs(fine[:, inside, 0] - expected[inside]).max() <= 0.5
    assert (fine[..., 1:] == 255).all()


def test_colors_do_not_fade_towards_what_is_transparent():
    picture = np.zeros((4, 6, 4), dtype=np.uint8)
    picture[:, :3] = [200, 100, 50, 255]
    fine = upscale_picture(picture, (24, 16), 4.0)
    seen = fine[..., 3] > 8
    assert seen.any()
    assert not seen.all()
    assert np.abs(fine[seen][:, :3].astype(int) - [200, 100, 50]).max() <= 1
    assert not fine[fine[..., 3] == 0].any()


def test_the_coarse_camera_sees_the_same_field_of_view(camera):
    view = camera(333, 200)
    rough = downscale_camera(view, 3.3)
    point = view.ray_directions(np.array([[100.0, 50.0]]))
    assert np.allclose(point, rough.ray_directions(np.array([[100.0, 50.0]]) / 3.3))
    assert rough.size_px == (101, 61)
