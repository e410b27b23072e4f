import dataclasses
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from export.bake.bake_tables import encode_weights
from export.package.player_tables import (
    LOG_DENSITY_RANGE,
    WEIGHT_SCALE,
    BrickTable,
    PlayerTables,
    SkinningGrid,
    SurfelTable,
    encode_density,
)
from export.package.table_codec import (
    TableLayout,
    cumsum_cubes,
    decode_tables,
    encode_tables,
    estimate_brick_bytes,
)


def random_tables(
    seed: int, surfels: int, counts: tuple[int, int, int], share: float
) -> PlayerTables:
    rng = np.random.default_rng(seed)
    nodes = np.array(counts) * 8 + 1
    grid = rng.integers(0, 256, (*nodes, 4), dtype=np.uint8)
    grid[-1] = grid[:, -1] = grid[:, :, -1] = 0  # a grid ends in emptiness
    used = rng.random(counts) < share
    index = np.zeros(counts, np.int32)
    index[used] = np.arange(1, used.sum() + 1)
    for block in np.argwhere(~used):
        grid[tuple(slice(8 * b, 8 * b + 8) for b in block)] = 0
    voxels = np.zeros((used.sum() + 1, 9, 9, 9, 4), np.uint8)
    for number, block in enumerate(np.argwhere(used), start=1):
        voxels[number] = grid[tuple(slice(8 * b, 8 * b + 9) for b in block)]
    return PlayerTables(
        surfels=SurfelTable(
            low=rng.normal(size=3).astype(np.float32),
            extent_m=float(rng.random()),
            spacing_m=0.005,
            position_codes=rng.integers(0, 65536, (surfels, 3), dtype=np.uint16),
            normal_codes=rng.integers(-127, 128, (surfels, 3), dtype=np.int8),
            thickness_codes=rng.integers(0, 256, surfels, dtype=np.uint8),
        ),
        bricks=BrickTable(
            low=rng.normal(size=3).astype(np.float32), voxel_m=0.004, index=index, voxels=voxels
        ),
        skinning=random_skin(rng, counts, share),
        pelvis=rng.normal(size=3).astype(np.float32),
        reach_m=1.5,
    )


def random_skin(rng, counts, share) -> SkinningGrid:
    stored = rng.random(counts) < share
    stored[0, 0, 0] = True
    index = np.zeros(counts, np.int32)
    index[stored] = np.arange(1, stored.sum() + 1)
    codes = rng.integers(0, WEIGHT_SCALE + 1, (24, stored.sum() + 1), dtype=np.uint16)
    codes[:, 0] = 0
    codes[0, 0] = WEIGHT_SCALE
    return SkinningGrid(
        low=rng.normal(size=3).astype(np.float32),
        step_m=rng.uniform(0.01, 0.03, 3).astype(np.float32),
        index=index,
        weight_codes=codes,
    )


def assert_same(a, b):
    for field in dataclasses.fields(a):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if dataclasses.is_dataclass(left):
            assert_same(left, right)
        else:
            np.testing.assert_array_equal(left, right, err_msg=field.name, strict=True)


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    surfels=st.integers(1, 40),
    counts=st.tuples(*[st.integers(1, 3)] * 3),
    share=st.floats(0, 1),
)
def test_tables_come_back_from_their_streams_bit_by_bit(seed, surfels, counts, share):
    tables = random_tables(seed, surfels, counts, share)
    layout, streams = TableLayout.of(tables), encode_tables(tables)
    for name, (dtype, shape) in layout.stream_types().items():
        assert len(streams[name]) == np.dtype(dtype).itemsize * np.prod(shape)
    assert_same(tables, decode_tables(streams, layout))


@pytest.mark.parametrize("stream", ["blocks", "skin_nodes"])
def test_places_that_do_not_match_what_is_there_are_refused(stream):
    tables = random_tables(0, 5, (2, 2, 2), 0.5)
    streams = encode_tables(tables)
    streams[stream] = bytes([255])
    with pytest.raises(ValueError, match="places"):
        decode_tables(streams, TableLayout.of(tables))


@given(st.lists(st.floats(0, 1), min_size=24, max_size=24).filter(lambda w: sum(w) > 1e-3))
def test_weight_codes_sum_to_one_and_stay_close(weights):
    weights = np.array([weights], dtype=np.float32) / np.float32(sum(weights))
    codes = encode_weights(weights).astype(int)
    assert codes.sum() == WEIGHT_SCALE
    assert codes.min() >= 0
    assert np.abs(codes / WEIGHT_SCALE - weights).max() < 24 / WEIGHT_SCALE


def test_density_codes_are_logarithmic_and_zero_is_empty():
    low, high = LOG_DENSITY_RANGE
    density = np.exp(np.linspace(low, high, 1000))
    restored = np.exp(encode_density(density) / 255.0 * (high - low) + low)
    np.testing.assert_allclose(restored, density, rtol=0.5 * (high - low) / 255 * 1.02)
    assert encode_density(np.array([0.0, 0.4, 1e9])).tolist() == [0, 0, 255]


def test_sums_of_cubes_are_cumulative_sums_along_three_axes(rng):
    codes = rng.integers(0, 256, (4, 5, 8, 8, 8), dtype=np.uint8)
    expected = codes
    for axis in (-3, -2, -1):
        expected = np.cumsum(expected, axis=axis, dtype=np.uint8)
    np.testing.assert_array_equal(cumsum_cubes(codes), expected)
    full = np.full((1, 8, 8, 8), 255, dtype=np.uint8)
    np.testing.assert_array_equal(cumsum_cubes(full)[0, 7, 7, 7], np.uint8(255 * 512 % 256))


def test_the_bytes_of_bricks_are_estimated_from_an_eighth_of_them():
    tables = random_tables(5, surfels=10, counts=(6, 6, 6), share=0.8)
    exact = len(zlib.compress(encode_tables(tables)["voxels"]))
    assert estimate_brick_bytes(tables.bricks) == pytest.approx(exact, rel=0.05)
