import numpy as np
import pytest
from scipy import ndimage

from export.bake.proxy_surface import (
    OPAQUE_OPTICAL_DEPTH,
    THICKNESS_MARGIN_M,
    FieldGrid,
    dilate_colors,
    extract_proxy_surface,
)
from export.bake.voxel_grid import blur_grid, resample_grid

VOXEL_M = 0.004
RADIUS_M = 0.08


def ball_grid(density_of_radius, size=65, extra=None) -> FieldGrid:
    axis = (np.arange(size) - size // 2) * VOXEL_M
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    density = density_of_radius(np.linalg.norm(points, axis=-1)).astype(np.float32)
    if extra is not None:
        density = np.maximum(density, extra(points)).astype(np.float32)
    low = np.full(3, axis[0], dtype=np.float32)
    return FieldGrid(
        low=low, voxel_m=VOXEL_M, density=density, rgb=np.zeros((*density.shape, 3), np.uint8)
    )


def soft_ball(radius):
    """The density is 20/m exactly at RADIUS_M, and falls by e every 2 cm."""
    return 20.0 * np.exp((RADIUS_M - radius) / 0.02)


def test_a_ramp_is_read_at_any_step_also_where_the_last_one_is_rounded_to_the_end():
    ramp = np.broadcast_to(np.arange(402.0, dtype=np.float32)[:, None, None], (402, 2, 2))
    ends = 0
    for count in range(1, 1000):
        step = 401.0 / count
        places = np.arange(0.0, 401.0, step)
        ends += int(places[-1]) == 401
        np.testing.assert_allclose(resample_grid(ramp, step)[:, 0, 0], places, rtol=1e-5)
    assert ends  # a length over a step that divides it is at times a step too many


def test_a_grid_is_resampled_trilinearly():
    values = np.random.default_rng(0).random((9, 14, 6), dtype=np.float32)
    places = np.meshgrid(*(np.arange(0.0, size - 1, 1.3) for size in values.shape), indexing="ij")
    expected = ndimage.map_coordinates(values, places, order=1)
    np.testing.assert_allclose(resample_grid(values, 1.3), expected, atol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 7, 30])
@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.4])
def test_halves_of_a_grid_are_blurred_as_the_whole(size, sigma):
    values = np.random.default_rng(0).random((size, 8, 5), dtype=np.float32)
    whole = ndimage.gaussian_filter(values, sigma, truncate=3.0)
    np.testing.assert_array_equal(blur_grid(values, sigma), whole)


def test_the_surface_of_a_ball_is_its_level_set():
    surface = extract_proxy_surface(ball_grid(soft_ball), level=20.0, spacing_m=0.005)
    radius = np.linalg.norm(surface.positions, axis=1)
    np.testing.assert_allclose(radius, RADIUS_M, atol=6e-4)
    cosine = (surface.positions / radius[:, None] * surface.normals).sum(axis=1)
    assert cosine.min() > 0.999
    # as many as marching cubes has vertices: about 3/2 of the area in cells
    area_cells = 4 * np.pi * RADIUS_M**2 / 0.005**2
    assert 1.4 < len(radius) / area_cells < 1.6


def test_thickness_is_the_depth_at_which_everything_has_been_seen():
    constant = 200.0
    grid = ball_grid(lambda r: np.where(r < RADIUS_M, constant, 0.0))
    surface = extract_proxy_surface(grid, level=20.0, spacing_m=0.005)
    np.testing.assert_allclose(
        surface.thickness, OPAQUE_OPTICAL_DEPTH / constant + THICKNESS_MARGIN_M, atol=0.006
    )


def test_a_hollow_ball_has_no_surfels_inside():
    grid = ball_grid(lambda r: np.where((r < RADIUS_M) & (r > 0.04), 300.0, 0.0))
    surface = extract_proxy_surface(grid, level=20.0, spacing_m=0.005)
    assert np.linalg.norm(surface.positions, axis=1).min() > RADIUS_M - 0.006


def test_small_floaters_are_left_out_and_large_parts_are_kept(monkeypatch):
    """A floater of 1 cm beside a ball of 18 cm, and a part as large as a fist."""
    floater, part = np.full(3, 0.14), np.full(3, -0.14)

    def extra(points):
        small = np.linalg.norm(points - floater, axis=-1) < 0.010
        large = np.linalg.norm(points - part, axis=-1) < 0.035
        return np.where(small | large, 300.0, 0.0)

    grid = ball_grid(lambda r: np.where(r < 0.18, 300.0, 0.0), size=113, extra=extra)

    def nearest(place):
        surface = extract_proxy_surface(grid, level=20.0, spacing_m=0.005)
        return np.linalg.norm(surface.positions - place, axis=1).min()

    assert nearest(floater) > 0.05
    assert nearest(part) < 0.04
    monkeypatch.setattr("export.bake.voxel_grid.MIN_PART_FRACTION", 1e-9)
    assert nearest(floater) < 0.02


@pytest.mark.parametrize("color", [(10, 200, 30), (255, 255, 255)])
def test_empty_nodes_beside_visible_ones_take_their_color(color):
    visible, rgb = np.zeros((7, 7, 7), bool), np.zeros((7, 7, 7, 3), np.uint8)
    visible[3, 3, 2:5], rgb[3, 3, 2:5] = True, color
    dilate_colors(visible, rgb)
    assert (rgb[2:5, 2:5, 1:6] == color).all()
    assert not rgb[0].any()
