"""Final scores: all held-out frames, or as many as time allows, spread over the video."""

import numpy as np
import pytest

from apps.cli.console import Console
from apps.evaluation import final_scoring
from apps.evaluation.final_scoring import KEPT_RENDERINGS, MIN_SCORED_FRAMES, score_finally
from avatar.config import TrainConfig
from avatar.evaluation.held_out import HeldOutFrame
from avatar.field.avatar_model import Avatar
from avatar.training.trainer import Trainer
from capture.camera import Camera
from capture.frame import Frame
from preprocess.body.body_pose import BodyPose
from preprocess.observation import Observation

COUNT = 20


@pytest.fixture
def held_out() -> list[HeldOutFrame]:
    camera = Camera(
        focal_px=(20.0, 20.0), center_px=(8.0, 12.0), size_px=(16, 24), camera_from_world=np.eye(4)
    )
    pose = BodyPose(
        root_rotation=np.zeros(3), root_translation=np.zeros(3), joint_rotations=np.zeros((23, 3))
    )
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

    def scored(*, steps: int | None, limit_s: float):
        black = np.zeros((24, 16, 4), dtype=np.float32)
        black[..., 3] = held_out[0].observation.alpha
        monkeypatch.setattr(final_scoring, "render", lambda *_, **__: black)
        monkeypatch.setattr(final_scoring, "SCORING_LIMIT_S", limit_s)
        trainer = Trainer.__new__(Trainer)
        trainer.config, trainer.avatar = TrainConfig(steps=steps), Avatar.__new__(Avatar)
        return score_finally(trainer, held_out, Console(), fit_poses=False)

    return scored


def frames_of(scores) -> list[int]:
    return [score.frame for score in scores]


def test_with_enough_time_all_frames_are_scored(score, held_out):
    scores = score(steps=None, limit_s=1e9)
    expected = [frame.observation.frame.index for frame in held_out]
    assert frames_of(scores.given) == frames_of(scores.sampled) == expected
    assert scores.fitted == ()
    assert len(scores.renderings) == KEPT_RENDERINGS


def test_without_time_a_few_frames_are_that_are_spread_over_the_video(score, held_out):
    frames = frames_of(score(steps=None, limit_s=0.0).given)
    assert len(frames) == MIN_SCORED_FRAMES
    assert frames == sorted(frames)
    assert np.diff(frames).max() <= 10 * (COUNT // 4)


def test_a_run_with_counted_steps_does_not_depend_on_the_machine(score):
    assert len(score(steps=10, limit_s=0.0).given) == COUNT


def test_a_sample_of_all_pixels_scores_like_the_whole_image(score):
    """The frames are small enough to be sampled whole, up to the border."""
    scores = score(steps=10, limit_s=0.0)
    for whole, sampled in zip(scores.given, scores.sampled, strict=True):
        assert sampled.psnr_mask == pytest.approx(whole.psnr_mask, abs=1e-4)
