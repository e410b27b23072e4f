"""Tests for masks around given poses: the real network on the studio's actors."""

from dataclasses import replace

import numpy as np
import pytest

from capture.input_error import InputError
from capture.source import Frame
from preprocess.body.body_surface import soft_iou
from preprocess.tracking.blazepose import MAX_CLOTHING_M, BlazePoseSegmenter, _limit_to_body
from preprocess.tracking.keypoints import CroppedMask
from tests.preprocess.tracking.conftest import room

SIZE = (270, 480)


def shown(*placed) -> Frame:
    """Actors in a room as wide as they need it, each at its left."""
    picture = room(SIZE[0] + max(left for _, left in placed))
    for shot, left in placed:
        shot.paste(picture, left)
    return Frame(index=0, time_s=0.0, rgb=picture)


def iou(alpha: np.ndarray, true: np.ndarray) -> float:
    return soft_iou(true > 0.5, alpha)


def test_an_actor_is_cut_out(shots):
    shot = shots[1]
    segment = BlazePoseSegmenter(shot.actor.shaped)
    alpha = segment(shown((shot, 0)), shot.pose, shot.camera)
    assert iou(alpha, shot.alpha) > 0.95
    assert segment.mask_count == 1
    assert 0.7 < segment.agreement < 0.95  # clothes and hair are wider than the body
    off_by_a_hand = shot.pose.root_translation + np.array([0.08, 0.0, 0.0])
    moved = replace(shot.pose, root_translation=off_by_a_hand)
    assert iou(segment(shown((shot, 0)), moved, shot.camera), shot.alpha) > 0.95


@pytest.mark.parametrize("wanted", [0, 1])
def test_of_two_persons_it_is_the_posed_one(shots, wanted):
    shot, shift = shots[wanted], 170
    frame = shown((shots[0], 0), (shots[1], shift))
    x, y = shot.camera.center_px
    camera = replace(shot.camera, center_px=(x + wanted * shift, y), size_px=(440, SIZE[1]))
    alpha = BlazePoseSegmenter(shot.actor.shaped)(frame, shot.pose, camera)
    assert iou(alpha[:, wanted * shift :][:, : SIZE[0]], shot.alpha) > 0.85


def test_the_person_is_found_in_a_twentieth_of_the_light(shots, rng):
    shot = shots[1]
    frame = shown((shot, 0))
    dark = frame.rgb / 20.0 + rng.normal(0.0, 1.0, frame.rgb.shape)
    frame = replace(frame, rgb=np.clip(dark, 0, 255).astype(np.uint8))
    alpha = BlazePoseSegmenter(shot.actor.shaped)(frame, shot.pose, shot.camera)
    assert iou(alpha, shot.alpha) > 0.9


@pytest.mark.parametrize(
    ("shift_m", "words"), [([9.0, 0, 0], "not in the image"), ([0.9, 0, 0], "agrees by")]
)
def test_where_the_pose_shows_no_person_there_is_no_mask(shots, shift_m, words):
    shot = shots[1]
    aside = replace(shot.pose, root_translation=shot.pose.root_translation + shift_m)
    with pytest.raises(InputError, match=words):
        BlazePoseSegmenter(shot.actor.shaped)(shown((shot, 0)), aside, shot.camera)


def test_what_is_far_from_the_posed_body_is_cleared():
    everything = CroppedMask(
        values=np.full((64, 64), 255, np.uint8),
        image_from_crop=np.array([[2.0, 0, 10], [0, 2, 20]]),
    )
    body = np.stack(np.meshgrid(np.arange(60.0, 80.0), np.arange(70.0, 90.0)), axis=-1)
    px_per_m = 100.0
    mask, agreed = _limit_to_body(everything, body.reshape(-1, 2), px_per_m)
    rows, columns = np.nonzero(mask.values)
    reach = MAX_CLOTHING_M * px_per_m / 2.0
    assert columns.min() == pytest.approx(25 - reach, abs=1.5)
    assert columns.max() == pytest.approx(34 + reach, abs=1.5)
    assert rows.min() == pytest.approx(25 - reach, abs=1.5)
    assert 0.0 < agreed < 0.3
