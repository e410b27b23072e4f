"""Words for scores: the truth's own blur is the yardstick."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

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
)

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
