"""Held-out frames: which they are, what they are compared with, and how they are scored."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from avatar.config import TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.evaluation.held_out import (
    PIXELS_PER_FRAME,
    HeldOutFrame,
    PixelSample,
    add_held_out,
    coarse_to_fine_order,
    score_frame,
    score_rendering,
    subsample_evenly,
)
from avatar.evaluation.image_metrics import composite_on_white, ground_truth_on_white, psnr, ssim
from avatar.render import render
from avatar.training.frame_stream import (
    TrainingFrame,
    is_held_out,
    prepare_items,
    prepare_stream,
    separate_held_out,
)
from avatar.training.trainer import Trainer
from capture.camera import Camera
from capture.source import Frame
from preprocess.body.body_pose import BodyPose
from preprocess.masks.matting import person_colors
from preprocess.observation import DroppedFrame, Observation


def held_of(total, every=10):
    return [p for p in range(total) if is_held_out(p, stride=every, total=total)]


@pytest.fixture(scope="module")
def held(rig, clip) -> HeldOutFrame:
    observation = clip.observations[3]
    cells = CorrespondenceGrid.solve(rig, observation.pose.joint_rotations)
    return HeldOutFrame(observation=observation, correspondences=cells)


@given(st.integers(20, 500))
def test_every_tenth_frame_is_held_out_from_the_ninth_on(total):
    """Also of a stream of unknown length; with a stride of zero none is."""
    assert held_of(total) == list(range(9, total, 10))
    unknown = [p for p in range(total) if is_held_out(p, stride=10, total=None)]
    assert unknown == held_of(total)
    assert held_of(total, every=0) == []


@pytest.mark.parametrize("total", range(20))
def test_of_a_short_clip_it_is_the_last_quarter_and_at_least_one_but_of_a_single_frame(total):
    quarter = max(1, total // 4) if total > 1 else 0
    assert held_of(total) == list(range(total - quarter, total))


def test_frames_are_prepared_in_order_and_those_left_out_pass_through(rig, clip):
    dropped = DroppedFrame(index=5, reason="empty mask")
    items = [*clip.observations[:5], dropped, clip.observations[6]]
    ready = list(prepare_stream(iter(items), rig, stride=3, total=None))
    assert [type(item) for item in ready] == [
        TrainingFrame, TrainingFrame, HeldOutFrame, TrainingFrame, TrainingFrame, DroppedFrame,
        TrainingFrame,
    ]  # fmt: skip
    assert ready[5] is items[5]
    assert ready[2].observation.frame is items[2].frame
    indices = [item.index for item in ready if isinstance(item, TrainingFrame)]
    assert indices == [0, 1, 3, 4, 6]


def test_an_item_that_is_dropped_in_between_moves_no_held_out_frame(rig, clip):
    split = separate_held_out(clip.observations[:6], stride=3, total=None)
    items = list(prepare_items((item for k, item in enumerate(split) if k != 1), rig))
    held = [item.observation.frame.index for item in items if isinstance(item, HeldOutFrame)]
    assert held == [2, 5]
    assert [item.index for item in items if isinstance(item, TrainingFrame)] == [0, 3, 4]


def observed(rgb, alpha) -> Observation:
    camera = Camera.at(np.zeros(3), np.eye(3), 9.0, alpha.shape[::-1])
    frame = Frame(index=0, time_s=0.0, rgb=rgb)
    return Observation(frame=frame, alpha=alpha, pose=BodyPose.rest(), camera=camera)


def test_the_truth_is_the_picture_where_the_person_is_and_white_elsewhere():
    rgb = np.array([[[255, 51, 0], [10, 20, 30], [0, 102, 204]]], dtype=np.uint8)
    alpha = np.array([[1.0, 0.0, 1.0]], dtype=np.float32)
    expected = [[[1.0, 0.2, 0.0], [1.0, 1.0, 1.0], [0.0, 0.4, 0.8]]]
    np.testing.assert_allclose(ground_truth_on_white(observed(rgb, alpha)), expected, atol=1e-6)


def test_the_truth_holds_little_background_at_the_persons_border():
    alpha = np.tile(np.array([0, 0, 0, 0.3, 1, 1, 1, 0.6, 0, 0], np.float32), (9, 1))
    person, green = np.array([200.0, 40.0, 90.0]), np.array([0.0, 255.0, 0.0])
    rgb = np.rint(alpha[..., None] * person + (1.0 - alpha[..., None]) * green).astype(np.uint8)
    expected = alpha[..., None] * (person / 255.0) + 1.0 - alpha[..., None]
    as_shown = alpha[..., None] * (rgb / 255.0) + 1.0 - alpha[..., None]
    error = np.abs(ground_truth_on_white(observed(rgb, alpha)) - expected).max()
    assert error < 0.3 * np.abs(as_shown - expected).max()


def test_an_image_that_is_cut_out_shows_the_person_alone(rng):
    rgb = rng.integers(0, 256, (7, 5, 3), dtype=np.uint8)
    alpha = rng.random((7, 5), dtype=np.float32)
    seen = observed(rgb, alpha)
    seen = replace(seen, frame=replace(seen.frame, alpha=np.rint(255 * alpha).astype(np.uint8)))
    expected = alpha[..., None] * (rgb / np.float32(255.0)) + 1.0 - alpha[..., None]
    np.testing.assert_allclose(ground_truth_on_white(seen), expected, atol=1e-6)


def test_a_perfect_rendering_on_white_is_the_truth(rng):
    rgb = rng.integers(0, 256, (7, 5, 3), dtype=np.uint8)
    alpha = rng.random((7, 5), dtype=np.float32)
    color = person_colors(rgb, alpha) / np.float32(255.0) * alpha[..., None]
    perfect = np.concatenate([color, alpha[..., None]], axis=-1)
    np.testing.assert_allclose(
        composite_on_white(perfect), ground_truth_on_white(observed(rgb, alpha)), atol=1e-6
    )


def test_an_avatar_that_shows_nothing_scores_like_a_white_sheet(rig, held):
    trainer = Trainer(rig, TrainConfig(levels=2, table_size=1 << 10))
    trainer.avatar.occupancy.density_grid.occupied.zero_()
    truth, mask = ground_truth_on_white(held.observation), held.observation.alpha > 0.5
    white = np.ones_like(truth)
    got = score_frame(trainer.avatar, held)
    assert got.frame == held.observation.frame.index
    assert got.psnr == pytest.approx(psnr(white, truth))
    assert got.psnr_mask == pytest.approx(psnr(white, truth, mask))
    assert got.ssim == pytest.approx(ssim(white, truth))
    assert got.psnr_mask < got.psnr < math.inf


@given(count=st.integers(0, 60), most=st.integers(2, 20))
def test_scored_frames_are_limited_and_evenly_spread(held, count, most):
    frames = [replace(held) for _ in range(count)]
    chosen = [frames.index(frame) for frame in subsample_evenly(frames, most)]
    assert len(chosen) == min(count, most)
    if count > most:
        gaps = np.diff(chosen)
        assert (chosen[0], chosen[-1]) == (0, count - 1)
        assert gaps.min() >= 1
        assert gaps.max() - gaps.min() <= 1
    else:
        assert chosen == list(range(count))


def test_every_beginning_of_the_interleaved_order_is_spread_over_the_stream():
    order = coarse_to_fine_order(list(range(12)))
    assert sorted(order) == list(range(12))
    assert order[:2] == [0, 8]
    assert max(np.diff(sorted([*order[:3], 12]))) <= 4


@given(count=st.integers(1, 700), most=st.integers(3, 40))
@settings(max_examples=15, deadline=None)
def test_of_a_long_stream_a_bounded_spread_of_held_out_frames_stays(held, count, most):
    kept, places = [], range(9, 10 * count, 10)
    for place in places:
        frame = replace(held.observation.frame, index=place)
        one = HeldOutFrame(observation=replace(held.observation, frame=frame))
        add_held_out(kept, one, max_frames=most)
    indices = [frame.observation.frame.index for frame in kept]
    assert min(len(places), most // 2) <= len(indices) <= most
    assert indices[0] == places[0]
    if len(places) > 1:
        (gap,) = set(np.diff(indices))
        assert places[-1] - indices[-1] < gap
    if len(places) <= most:
        assert indices == list(places)


def test_held_out_frames_that_come_later_from_before_are_put_between_the_others(held):
    kept = []
    for index in (40, 90, 140, 10, 65, 100, 120):
        frame = replace(held.observation.frame, index=index)
        add_held_out(kept, HeldOutFrame(observation=replace(held.observation, frame=frame)))
    assert [each.observation.frame.index for each in kept] == [10, 40, 65, 90, 100, 120, 140]


@pytest.fixture(scope="module")
def picture(learnt, held):
    """The whole rendering of its view."""
    return render(learnt.trainer.avatar, held.observation.pose, held.observation.camera)


def test_a_sample_is_small_always_the_same_and_stands_for_the_whole_image(held):
    sample = PixelSample.of(held)
    assert len(sample.places) <= PIXELS_PER_FRAME < held.observation.alpha.size
    assert sample.areas.sum() == pytest.approx(held.observation.alpha.size)
    np.testing.assert_array_equal(PixelSample.of(held).places, sample.places)


def test_pixels_alone_are_scored_like_those_of_the_whole_rendering(rig, held, learnt, picture):
    sample = PixelSample.of(held)
    whole = sample.score_rendering(picture)
    alone = sample.with_correspondences(rig).score(learnt.trainer.avatar)
    assert alone.psnr == pytest.approx(whole.psnr, abs=1e-3)
    assert alone.psnr_mask == pytest.approx(whole.psnr_mask, abs=1e-3)
    assert alone.overlap == pytest.approx(whole.overlap, abs=1e-3)


def test_the_sample_estimates_the_score_of_the_whole_image(held, learnt, picture):
    """The mean of many independent samples; a single one is less exact."""
    whole, seen, scores = score_frame(learnt.trainer.avatar, held), held.observation, []
    for index in range(40):
        other = replace(seen, frame=replace(seen.frame, index=index))
        sample = PixelSample.of(HeldOutFrame(observation=other))
        scores.append(sample.score_rendering(picture))

    def mean_psnr(name: str) -> float:
        errors = [10.0 ** (-0.1 * getattr(score, name)) for score in scores]
        return float(-10.0 * np.log10(np.mean(errors)))

    assert mean_psnr("psnr") == pytest.approx(whole.psnr, abs=0.3)
    assert mean_psnr("psnr_mask") == pytest.approx(whole.psnr_mask, abs=0.3)
    assert np.mean([score.overlap for score in scores]) == pytest.approx(whole.overlap, abs=0.02)


def test_a_stratum_that_is_sampled_whole_is_exact(held, picture):
    seen = held.observation
    alpha = np.zeros_like(seen.alpha)
    alpha[20:30, 20:30] = 1.0  # fewer pixels than are sampled
    few = HeldOutFrame(observation=replace(seen, alpha=alpha))
    sampled = PixelSample.of(few).score_rendering(picture)
    assert sampled.psnr_mask == pytest.approx(score_rendering(picture, few).psnr_mask, abs=1e-4)
    assert np.isnan(sampled.ssim)
