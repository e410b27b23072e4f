"""Final scores: whole images as long as time allows, then samples of their pixels."""

from dataclasses import replace

import numpy as np
import pytest

from avatar.avatar_model import Avatar
from avatar.config import TrainConfig
from avatar.evaluation.held_out import HeldOutFrame, PixelSample, score_rendering
from avatar.training.trainer import Trainer
from capture.camera import Camera
from capture.source import Frame
from instant_avatar.run import final_scoring
from instant_avatar.run.final_scoring import (
    FRAMES_PER_FIT,
    KEPT_RENDERINGS,
    MAX_WHOLE_IMAGES,
    MIN_WHOLE_IMAGES,
    score_finally,
)
from preprocess.body.body_pose import BodyPose
from preprocess.observation import Observation

COUNT = 20


@pytest.fixture
def held_out() -> list[HeldOutFrame]:
    camera, pose = Camera.at(np.zeros(3), np.eye(3), 20.0, (16, 24)), BodyPose.rest()
    alpha = np.zeros((24, 16), dtype=np.float32)
    alpha[4:20, 4:12] = 1.0
    return [
        HeldOutFrame(
            observation=Observation(
                frame=Frame(index=10 * i + 9, time_s=0.0, rgb=np.full((24, 16, 3), i, np.uint8)),
                alpha=alpha, pose=pose, camera=camera,
            )
        )
        for i in range(COUNT)
    ]  # fmt: skip


@pytest.fixture
def score(held_out, monkeypatch):
    """Scores black renderings, in no time or after all time is spent."""

    def scored(*, steps: int | None, limit_s: float, fit_poses=False, left_out_after=COUNT):
        done = []
        black = np.zeros((24, 16, 4), dtype=np.float32)
        black[..., 3] = held_out[0].observation.alpha
        worse = replace(score_rendering(black, held_out[0]), psnr=0.0)
        monkeypatch.setattr(final_scoring, "render", lambda *_, **__: black)
        monkeypatch.setattr(final_scoring, "render_unfilmed_views", lambda *_, **__: [black])
        monkeypatch.setattr(PixelSample, "score", lambda sample, _: sample.score_rendering(black))
        monkeypatch.setattr(
            final_scoring, "fit_test_poses", lambda trainer, frames, progress: iter(frames)
        )
        monkeypatch.setattr(final_scoring, "score_frame", lambda *_: worse)
        monkeypatch.setattr(final_scoring, "SCORING_LIMIT_S", limit_s)
        trainer = Trainer.__new__(Trainer)
        trainer.config, trainer.avatar = TrainConfig(steps=steps), Avatar.__new__(Avatar)
        return score_finally(
            trainer, held_out, fit_poses=fit_poses,
            report_progress=lambda *_: done.append(1),
            is_left_out=lambda: left_out_after < COUNT and len(done) >= left_out_after,
        )  # fmt: skip

    return scored


def frames_of(scores) -> list[int]:
    return [score.frame for score in scores]


def test_with_enough_time_all_frames_are_scored(score, held_out):
    scores = score(steps=None, limit_s=1e9)
    expected = [frame.observation.frame.index for frame in held_out]
    assert frames_of(scores.given) == frames_of(scores.sampled) == expected
    assert scores.fitted == ()
    assert len(scores.renderings) == KEPT_RENDERINGS


def test_without_time_all_frames_are_scored_but_few_as_whole_images(score, held_out):
    """The frames are so small that a sample holds all pixels that differ."""
    exact, scores = score(steps=None, limit_s=1e9), score(steps=None, limit_s=0.0)
    assert frames_of(scores.given) == frames_of(exact.given)
    whole = [score.frame for score in scores.given if not np.isnan(score.ssim)]
    assert len(whole) == MIN_WHOLE_IMAGES
    assert np.diff(whole).max() <= 10 * COUNT // 2  # spread over the video
    assert list(scores.renderings) == whole
    for one, other in zip(scores.given, exact.given, strict=True):
        assert one.psnr_mask == pytest.approx(other.psnr_mask, abs=1e-4)
        assert one.psnr == pytest.approx(other.psnr, abs=1e-4)


def test_without_time_poses_are_fitted_to_some_frames_that_are_spread_over_the_video(score):
    frames = frames_of(score(steps=None, limit_s=0.0, fit_poses=True).fitted)
    assert len(frames) == FRAMES_PER_FIT
    assert frames == sorted(frames)
    assert np.diff(frames).max() <= 10 * COUNT // 2


def test_what_is_left_out_ends_at_once_and_keeps_what_was_scored(score):
    scores = score(steps=10, limit_s=1e9, fit_poses=True, left_out_after=3)
    assert len(scores.given) == 3
    assert scores.fitted == ()
    assert scores.half_transparent is None


def test_a_frame_that_scores_lower_in_its_fitted_pose_keeps_the_given_one(score):
    scores = score(steps=10, limit_s=0.0, fit_poses=True)
    assert [one.psnr for one in scores.fitted] == [one.psnr for one in scores.given]


def test_a_run_with_counted_steps_does_not_depend_on_the_machine(score):
    whole = ~np.isnan([one.ssim for one in score(steps=10, limit_s=0.0).given])
    assert whole.sum() == MAX_WHOLE_IMAGES
