"""Final scores of the held-out frames, in given and in fitted poses, within a time limit.

Whole images are scored as long as time allows. The scores of the other frames are estimates from
4,096 of their pixels, without SSIM: they cost a tenth, and all frames in part tell more about the
mean than a few of them in whole.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from apps.cli.console import Console
from apps.report.learning_curve import CurvePoint
from apps.report.report_schema import finite_mean
from avatar.evaluation.held_out import (
    HeldOutFrame,
    PixelSample,
    coarse_to_fine_order,
    score_fine_sample,
    score_frame,
    score_rendering,
)
from avatar.evaluation.image_metrics import composite_on_white
from avatar.evaluation.sharpness import better_verdict, overall_verdict
from avatar.events import HeldOutScore
from avatar.field.avatar_model import Avatar
from avatar.render import render
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.trainer import Trainer

SCORING_LIMIT_S = 20.0
"""Wall time that final scoring and pose fitting aim for."""
WHOLE_IMAGES_SHARE = 0.2
"""Share of that time after which frames in given poses are no longer scored as whole images."""
MIN_WHOLE_IMAGES = 3
"""Frames that are scored as whole images, whatever it takes."""
FRAMES_PER_FIT = 6
"""Frames whose poses are fitted together; no more are fitted once the time is up."""
KEPT_RENDERINGS = 6
"""Renderings that are kept for the report's page."""

WhiteImage = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class FinalScores:
    """Scores after the last step, in the order of the video.

    Attributes:
        given: Scores in the given poses; SSIM is NaN where not the whole image was scored.
        sampled: Scores of the same frames by the pixels of the learning curve.
        fitted: Scores in poses fitted to the frames, of as many frames as time allowed.
        renderings: A few of the frames as rendered on white, by their index.
    """

    given: tuple[HeldOutScore, ...] = ()
    sampled: tuple[HeldOutScore, ...] = ()
    fitted: tuple[HeldOutScore, ...] = ()
    renderings: dict[int, WhiteImage] = field(default_factory=dict)

    def summarize(self, last: CurvePoint) -> CurvePoint:
        """The learning curve's last point with these scores, and the report's verdict on them."""
        return replace(
            last,
            psnr=finite_mean([score.psnr for score in self.given]),
            psnr_mask=finite_mean([score.psnr_mask for score in self.given]),
            verdict=better_verdict(overall_verdict(self.given), overall_verdict(self.fitted)),
            frames=tuple((score.frame, score.psnr) for score in self.given),
            pixels=None,
        )


class _ScoredFrame(NamedTuple):
    """A frame in its given pose; without a rendering where a sample of it was scored."""

    frame: HeldOutFrame
    given: HeldOutScore
    sampled: HeldOutScore
    rendering: WhiteImage | None


def score_finally(
    trainer: Trainer, held_out: list[HeldOutFrame], console: Console, *, fit_poses: bool
) -> FinalScores:
    """Scores the held-out frames in about `SCORING_LIMIT_S`.

    After a given number of steps all are scored as whole images, whatever the time: the results
    of such a run do not depend on the machine.

    Args:
        trainer: After its last step.
        held_out: Frames that were never trained on.
        console: Shows the progress.
        fit_poses: Whether to score in fitted poses, too.
    """
    if not held_out:
        return FinalScores()
    limit_s = math.inf if trainer.config.steps else SCORING_LIMIT_S
    began, scored = time.perf_counter(), list[_ScoredFrame]()
    with console.progress(f"scoring {len(held_out)} held-out frames", float(len(held_out))) as bar:
        whole_until = began + WHOLE_IMAGES_SHARE * limit_s
        for one in _score_in_given_poses(trainer.avatar, held_out, whole_until):
            scored.append(one)
            bar.set_count(len(scored))
    fitted = list[HeldOutScore]()
    if fit_poses:
        with console.progress("fitting poses to the held-out frames", 1.0) as bar:
            fitted += _score_in_fitted_poses(trainer, scored, began + limit_s, bar.set_share)
    order = np.argsort([one.given.frame for one in scored])
    shown = [one for one in scored if one.rendering is not None][:KEPT_RENDERINGS]
    return FinalScores(
        given=tuple(scored[i].given for i in order),
        sampled=tuple(scored[i].sampled for i in order),
        fitted=tuple(sorted(fitted, key=lambda score: score.frame)),
        renderings={one.given.frame: one.rendering for one in shown if one.rendering is not None},
    )


def _score_in_given_poses(
    avatar: Avatar, held_out: list[HeldOutFrame], whole_until: float
) -> Iterator[_ScoredFrame]:
    """Scores frames in an order of which every prefix is spread over the video."""
    for count, frame in enumerate(coarse_to_fine_order(held_out)):
        if count >= MIN_WHOLE_IMAGES and time.perf_counter() > whole_until:
            sampled = PixelSample.of(frame).score(avatar)
            yield _ScoredFrame(frame, score_fine_sample(avatar, frame), sampled, None)
            continue
        seen = frame.observation
        picture = render(avatar, seen.pose, seen.camera, cells=frame.correspondences, shaded=True)
        white = np.clip(composite_on_white(picture), 0.0, 1.0)
        sampled = PixelSample.of(frame).score_rendering(picture)
        shown = (white * 255.0 + 0.5).astype(np.uint8)
        yield _ScoredFrame(frame, score_rendering(picture, frame), sampled, shown)


def _score_in_fitted_poses(
    trainer: Trainer,
    scored: list[_ScoredFrame],
    until: float,
    progress: Callable[[float], None],
) -> Iterator[HeldOutScore]:
    """Fits frames, a few at a time, and scores them as they were in the given poses."""
    for first in range(0, len(scored), FRAMES_PER_FIT):
        if first and time.perf_counter() > until:
            return
        some = scored[first : first + FRAMES_PER_FIT]
        fitted = fit_test_poses(trainer, [one.frame for one in some])
        for done, (one, frame) in enumerate(zip(some, fitted, strict=True), start=first + 1):
            score = score_fine_sample if one.rendering is None else score_frame
            after = score(trainer.avatar, frame)
            yield after if after.psnr >= one.given.psnr else one.given
            progress(done / len(scored))
