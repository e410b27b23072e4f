"""Cells of the baked volume, holes in it, and the proxy surface."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy import ndimage

from baselines.reference_geometry import SurfelFootprints, fill_holes, z_buffer
from export.bake import voxel_cells
from export.bake.compositor import SirtUpdate, VoxelCodes
from export.bake.proxy_surface import (
    OPAQUE_OPTICAL_DEPTH,
    THICKNESS_MARGIN_M,
    FieldGrid,
    dilate_colors,
    extract_proxy_surface,
)
from export.bake.voxel_cells import (
    brick_chunks,
    choose_cells,
    prune_octrees,
    share_codes,
    share_codes_within_budget,
)
from export.bake.voxel_grid import blur_grid, resample_grid
from export.package.player_tables import DEPTH_CODES, SURFEL_BITS, RenderSettings

VOXELS = 8**3
"""Voxels of a brick."""


def cost_of(codes, weights, cells, price) -> float:
    """Squared error of the cells' weighted means, and their price."""
    total = 0.0
    for cell in np.unique(cells):
        inside = cells == cell
        mean = (codes[inside] * weights[inside, None]).sum(axis=0) / weights[inside].sum()
        total += (weights[inside, None] * (codes[inside] - mean) ** 2).sum() + price
    return float(total)


def cubes(size):
    """Cells of one size everywhere in a brick."""
    place = np.argwhere(np.ones((8, 8, 8), dtype=bool)) // size * size
    return place @ np.array([64, 8, 1])


@pytest.fixture(scope="module")
def brick():
    """A brick of noise, flat in one half, in which weights fall with depth."""
    generator = np.random.default_rng(0)
    codes = generator.uniform(0.0, 255.0, (8, 8, 8, 3))
    codes[4:] = 100.0
    weights = 10.0 ** -np.arange(8.0)[None, :, None] * np.ones((8, 8, 8))
    return codes.reshape(-1, 3), weights.ravel()


def test_no_cells_of_one_size_are_cheaper(brick):
    codes, weights = brick
    for price in (1e-3, 1.0, 1e3):
        cost = cost_of(codes, weights, prune_octrees(codes, weights, price), price)
        for size in (1, 2, 4, 8):
            assert cost <= cost_of(codes, weights, cubes(size), price) * (1.0 + 1e-6)


def test_cells_are_cubes_that_begin_at_their_first_voxel(brick):
    cells = prune_octrees(*brick, 1.0)
    for cell in np.unique(cells):
        place = np.argwhere((cells == cell).reshape(8, 8, 8))
        edge = round(len(place) ** (1 / 3))
        assert edge in (1, 2, 4, 8)
        assert len(place) == edge**3
        assert np.ptp(place, axis=0).tolist() == [edge - 1] * 3
        assert (place[0] % edge == 0).all()
        assert place[0] @ [64, 8, 1] == cell


def test_what_shows_keeps_its_own_voxels_and_what_is_flat_or_hidden_does_not(brick):
    cells = prune_octrees(*brick, 1.0).reshape(8, 8, 8)
    assert len(np.unique(cells[:4, :2])) == 4 * 2 * 8
    assert len(np.unique(cells[4:])) == 4
    assert len(np.unique(cells[:4, 4:])) < 8


def test_voxels_without_weight_share_one_code_per_brick():
    codes = np.random.default_rng(1).uniform(0.0, 255.0, (2 * VOXELS, 3))
    cells = prune_octrees(codes, np.zeros(2 * VOXELS), 1.0)
    assert np.unique(cells).tolist() == [0, VOXELS]


def test_empty_voxels_do_not_share_codes_with_visible_ones():
    density = np.zeros(VOXELS, dtype=np.float32)
    density[: VOXELS // 2 + 8] = 160.0
    codes = VoxelCodes(density, np.full((VOXELS, 3), 80.0, dtype=np.float32))
    nothing = SirtUpdate.zeros(VOXELS)  # no ray has seen anything
    cells = choose_cells(codes, nothing, density, price=1.0)
    shared = share_codes(codes, nothing, density, cells)
    assert np.array_equal(shared.density > 0, density > 0)
    assert shared.density[density > 0] == pytest.approx(160.0, abs=1e-3)


def test_shared_codes_are_means_weighted_by_what_shows():
    codes = VoxelCodes(
        np.full(VOXELS, 100.0, dtype=np.float32),
        np.repeat(np.float32([[10.0], [50.0]]), VOXELS // 2, axis=0) * np.ones(3, np.float32),
    )
    update = SirtUpdate.zeros(VOXELS)
    update.color_normalizer[: VOXELS // 2] = 3.0
    update.color_normalizer[VOXELS // 2 :] = 1.0
    one = choose_cells(codes, update, codes.density, price=1e9)
    assert not one.color.any()
    shared = share_codes(codes, update, codes.density, one)
    assert shared.color == pytest.approx(np.full((VOXELS, 3), 20.0), rel=1e-3)
    summed = one.sum_update(update)
    assert summed.color_normalizer == pytest.approx(np.full(VOXELS, 2.0 * VOXELS))


@pytest.mark.slow
def test_chunks_do_not_change_shared_codes(tables, monkeypatch):
    given = VoxelCodes.of(tables.bricks)
    generator = np.random.default_rng(4)
    update = SirtUpdate.zeros(len(given.density))
    for sums in update:
        sums += generator.random(sums.shape).astype(np.float32)
    results = []
    for bricks in (1, 7, len(tables.bricks.voxels)):
        monkeypatch.setattr(voxel_cells, "CHUNK_BRICKS", bricks)
        codes = VoxelCodes(given.density.copy(), given.color.copy())
        with ThreadPoolExecutor(2) as executor:
            cells = share_codes_within_budget(
                tables.bricks, codes, update, given.density, 3e3, executor=executor
            )
        assert len(cells) == len(brick_chunks(len(given.density)))
        results.append(codes)
    assert not np.array_equal(results[0].color, given.color)
    for other in results[1:]:
        assert np.array_equal(results[0].color, other.color)
        assert np.array_equal(results[0].density, other.density)


SIZE_PX, REACH_M = (24, 20), 1.0


def filled_share(gap_px, *, side, spacing_px):
    """Share of a gap between two sheets, far before what it shows, that is filled."""
    width, height = SIZE_PX
    empty = np.zeros(0, dtype=np.int64)
    splats = SurfelFootprints(spacing_px, side, empty, empty, np.zeros(0, dtype=np.float32))
    keys = z_buffer(SIZE_PX, splats)
    behind = int((RenderSettings().hole_depth_m + 0.02) / 2.0 * DEPTH_CODES)
    keys[:] = 0
    left = splats.margin + width // 2 - gap_px // 2
    keys[:, left : left + gap_px] = behind << SURFEL_BITS
    shown = fill_holes(keys, REACH_M, RenderSettings(), splats)
    assert shown.shape == (height, width)
    start = left - splats.margin
    return float((shown[:, start : start + gap_px] == 0).mean())


@pytest.mark.parametrize(
    ("gap_px", "side", "spacing_px", "share"),
    [
        (4, 5, 4.2, 1.0),
        (8, 5, 4.2, 1.0),
        (12, 5, 4.2, 1.0),
        (14, 2, 1.9, 0.0),
        (2, 2, 0.2, 1.0),
        (5, 2, 0.2, 0.0),  # far away, by what a footprint is rounded up to
    ],
)
def test_holes_of_up_to_three_spacings_are_filled(gap_px, side, spacing_px, share):
    assert filled_share(gap_px, side=side, spacing_px=spacing_px) == share


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
    steps = 401.0 / np.arange(1.0, 1000.0)
    rounded = [step for step in steps if int(np.arange(0.0, 401.0, step)[-1]) == 401]
    assert rounded  # a length over a step that divides it is at times a step too many
    for step in (*rounded, *steps[::50]):
        places = np.arange(0.0, 401.0, step)
        np.testing.assert_allclose(resample_grid(ramp, step)[:, 0, 0], places, rtol=1e-5)


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
