"""Scores against closed forms; words for them, by the truth's own blur."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avatar.evaluation.image_metrics import (
    CALIBRATION_BLURS,
    MAX_MEASURABLE_BLUR,
    MAX_SHARP_BLUR,
    MAX_SOFT_BLUR,
    better_verdict,
    calibrate_blur,
    equivalent_blur,
    overall_verdict,
    psnr,
    sharpness_verdict,
    soft_iou,
    ssim,
)

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


def test_two_silhouettes_overlap_by_what_they_share_of_what_either_has():
    one, other = np.zeros((4, 5), dtype=bool), np.zeros((4, 5), dtype=bool)
    assert soft_iou(one, other) == 1.0
    one[:, :3], other[:, 2:] = True, True
    assert soft_iou(one, other) == soft_iou(other, one) == 4 / 20
    assert soft_iou(one, one) == 1.0
    assert soft_iou(one, ~one) == 0.0


PERSON_PX = 160


def dressed(stripe_px: int, contrast: float) -> tuple[np.ndarray, np.ndarray]:
    """A person-sized column in stripes on white, and its silhouette."""
    silhouette = np.zeros((200, 120), dtype=bool)
    silhouette[20 : 20 + PERSON_PX, 40:80] = True
    rows = np.arange(200) // stripe_px % 2
    shade = (0.4 + contrast * rows)[:, None, None] * np.ones((1, 120, 3))
    return np.where(silhouette[..., None], shade, 1.0).astype(np.float32), silhouette


def blur_of(picture, truth, silhouette):
    return equivalent_blur(psnr(picture, truth, silhouette), calibrate_blur(truth, silhouette))


@pytest.mark.parametrize("share", [0.004, 0.007, 0.015, 0.03, 0.06])
@pytest.mark.parametrize(("stripe_px", "contrast"), [(4, 0.4), (20, 0.05)])
def test_a_blurred_truth_has_the_blur_that_it_was_given(share, stripe_px, contrast):
    """In a striped and in a plain shirt alike, though decibels are many apart."""
    truth, silhouette = dressed(stripe_px, contrast)
    picture = cv2.GaussianBlur(truth, (0, 0), share * PERSON_PX)
    assert blur_of(picture, truth, silhouette) == pytest.approx(share, rel=0.25)


def test_the_ends_of_the_scale():
    truth, silhouette = dressed(4, 0.4)
    assert blur_of(truth, truth, silhouette) == CALIBRATION_BLURS[0]
    assert blur_of(1.0 - truth, truth, silhouette) == math.inf
    assert calibrate_blur(truth, np.zeros_like(silhouette)) == ()
    assert math.isnan(equivalent_blur(20.0, ()))
    assert math.isnan(equivalent_blur(math.nan, calibrate_blur(truth, silhouette)))


def test_another_room_in_the_place_of_a_person_is_a_failure(rng):
    """As a run that has learnt the room draws it, whole silhouette or not."""
    truth, silhouette = dressed(20, 0.05)
    room = rng.random(truth.shape).astype(np.float32)
    assert sharpness_verdict(blur_of(room, truth, silhouette), 1.0) == "failed"


@pytest.mark.parametrize(
    ("blur", "overlap", "word"),
    [
        (MAX_SHARP_BLUR, 0.95, "sharp"),
        (MAX_SOFT_BLUR, 0.95, "soft"),
        (0.016, 0.9, "blurred"),  # a real person of eight photographs at 22.8 dB
        (0.06, 0.64, "blurred"),  # poses that are 6 degrees and 4 cm off
        (math.inf, 0.9, "failed"),
        (1.01 * MAX_MEASURABLE_BLUR, 0.9, "failed"),
        (0.01, 0.38, "failed"),  # fog
        (math.nan, 0.2, "failed"),
        (math.nan, math.nan, None),
        (None, None, None),
    ],
)
def test_words_for_what_was_measured(blur, overlap, word):
    assert sharpness_verdict(blur, overlap) == word


def test_of_several_frames_half_are_at_least_as_good_as_the_word():
    def looks(blur, overlap=0.9):
        return SimpleNamespace(blur=blur, overlap=overlap)

    assert overall_verdict([looks(0.01), looks(math.inf)]) == "soft"
    assert overall_verdict([looks(0.01), *[looks(math.inf)] * 2]) == "failed"
    assert overall_verdict([looks(0.01, 0.1), looks(0.01)]) == "soft"
    assert overall_verdict([looks(math.nan, math.nan), looks(0.001)]) == "sharp"
    assert overall_verdict([]) is None


def test_an_avatar_is_as_good_as_in_its_better_poses():
    for one, other in (("failed", "soft"), ("soft", None), (None, "soft")):
        assert better_verdict(one, other) == "soft"
    assert better_verdict(None, None) is None
