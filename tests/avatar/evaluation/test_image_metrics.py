"""Scores against closed forms."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avatar.evaluation.image_metrics import psnr, soft_iou, ssim

SHADE = st.floats(0.0, 1.0)


def flat(value: float, side: int = 16) -> np.ndarray:
    return np.full((side, side, 3), value)


@pytest.fixture
def picture(rng) -> np.ndarray:
    return rng.random((24, 20, 3))


@given(st.floats(1e-4, 1.0))
def test_psnr_of_a_constant_offset_is_its_size_in_decibels(offset):
    assert psnr(flat(offset), flat(0.0)) == pytest.approx(-20.0 * math.log10(offset))


def test_the_mask_says_which_pixels_count(picture):
    mask = np.zeros(picture.shape[:2], dtype=bool)
    mask[3:9, 5:8] = True
    wrong = picture.copy()
    wrong[mask] += 0.1
    wrong[~mask] += 0.7
    assert psnr(wrong, picture, mask) == pytest.approx(20.0)
    assert psnr(wrong, picture, np.ones_like(mask)) == psnr(wrong, picture)
    assert math.isnan(psnr(picture, picture, np.zeros_like(mask)))


def test_eight_bit_floats_are_compared_in_double_precision():
    error = np.float32(1e-4)
    assert psnr(flat(0.0).astype(np.float32) + error, flat(0.0)) == pytest.approx(80.0, abs=1e-4)


@given(SHADE, SHADE)
def test_ssim_of_two_flat_pictures_compares_their_means_alone(a, b):
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    assert ssim(flat(a), flat(b)) == pytest.approx(expected, abs=1e-9)


def test_ssim_is_symmetric_falls_with_noise_and_is_negative_for_a_negative(picture, rng):
    noise = rng.normal(size=picture.shape)
    little, much = picture + 0.05 * noise, picture + 0.5 * noise
    assert ssim(picture, little) == pytest.approx(ssim(little, picture), abs=1e-12)
    assert 0.0 < ssim(picture, much) < ssim(picture, little) < 1.0
    assert ssim(picture, 1.0 - picture) < 0.0


def test_ssim_sees_structure_where_psnr_is_the_same(picture, rng):
    """An offset and noise of the same energy: the offset leaves the structure alone."""
    offset = np.full_like(picture, 0.1)
    noise = rng.choice([-0.1, 0.1], size=picture.shape)
    assert psnr(picture + offset, picture) == pytest.approx(psnr(picture + noise, picture))
    assert ssim(picture + offset, picture) > ssim(picture + noise, picture)


def test_two_silhouettes_overlap_by_what_they_share_of_what_either_has():
    one, other = np.zeros((4, 5), dtype=bool), np.zeros((4, 5), dtype=bool)
    assert soft_iou(one, other) == 1.0
    one[:, :3], other[:, 2:] = True, True
    assert soft_iou(one, other) == soft_iou(other, one) == 4 / 20
    assert soft_iou(one, one) == 1.0
    assert soft_iou(one, ~one) == 0.0
