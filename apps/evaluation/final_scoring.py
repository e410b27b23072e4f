"""Final scores of the held-out frames: whole images, in given and in fitted poses."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from apps.cli.console import Console
from avatar.evaluation.held_out import HeldOutFrame, coarse_to_fine_order, score_rendering
from avatar.evaluation.image_metrics import composite_on_white
from avatar.evaluation.pixel_sample import PixelSample
from avatar.events import HeldOutScore
from avatar.field.avatar_model import Avatar
from avatar.render import render
from avatar.training.held_out_pose_fitting import score_with_fitted_poses
from avatar.training.trainer import Trainer

SCORING_LIMIT_S = 20.0
"""Wall time that final scoring and pose fitting aim for."""
GIVEN_POSES_SHARE = 0.35
"""Share of that time for the scores in given poses; fitting and scoring again take the rest."""
MIN_SCORED_FRAMES = 6
"""Frames that are scored whatever it takes."""
KEPT_RENDERINGS = 6
"""Renderings that are kept for the report's page."""

WhiteImage = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class FinalScores:
    """Scores after the last step, in the order of the video.

    Attributes:
        given: Scores of whole images in the given poses.
        sampled: Scores of the same frames by the pixels of the learning curve.
        fitted: Scores of the same frames in poses fitted to them; empty if poses are not refined.
        renderings: A few of the frames as rendered on white, by their index.
    """

    given: tuple[HeldOutScore, ...] = ()
    sampled: tuple[HeldOutScore, ...] = ()
    fitted: tuple[HeldOutScore, ...] = ()
    renderings: dict[int, WhiteImage] = field(default_factory=dict)


class _ScoredFrame(NamedTuple):
    frame: HeldOutFrame
    given: HeldOutScore
    sampled: HeldOutScore
    rendering: WhiteImage | None


def score_finally(
    trainer: Trainer, held_out: list[HeldOutFrame], console: Console, *, fit_poses: bool
) -> FinalScores:
    """Scores the held-out frames, or as many, spread over the video, as time allows.

    A run of a given number of steps scores all, as its results do not depend on the machine.

    Args:
        trainer: After its last step.
        held_out: Frames that were never trained on.
        console: Shows the progress.
        fit_poses: Whether to score in fitted poses, too.
    """
    if not held_out:
        return FinalScores()
    limit_s = None if trainer.config.steps else GIVEN_POSES_SHARE * SCORING_LIMIT_S
    with console.progress(f"scoring {len(held_out)} held-out frames", float(len(held_out))) as bar:
        scored = list[_ScoredFrame]()
        for one in _score_in_given_poses(trainer.avatar, held_out, limit_s):
            scored.append(one)
            bar.set_count(len(scored))
    scored.sort(key=lambda one: one.frame.observation.frame.index)
    if len(scored) < len(held_out):
        console.info(f"{len(scored)} of {len(held_out)} held-out frames were scored in the time.")
    given, fitted = tuple(one.given for one in scored), ()
    if fit_poses:
        with console.progress("fitting poses to the held-out frames", 1.0) as bar:
            fitted = score_with_fitted_poses(
                trainer, [one.frame for one in scored], given=given, progress=bar.set_share
            )
    return FinalScores(
        given=given,
        sampled=tuple(one.sampled for one in scored),
        fitted=fitted,
        renderings={one.given.frame: one.rendering for one in scored if one.rendering is not None},
    )


def _score_in_given_poses(
    avatar: Avatar, held_out: list[HeldOutFrame], limit_s: float | None
) -> Iterator[_ScoredFrame]:
    """Renders and scores frames in an order of which every prefix is spread over the video."""
    began = time.perf_counter()
    for count, frame in enumerate(coarse_to_fine_order(held_out)):
        spent_s = time.perf_counter() - began
        if limit_s is not None and count >= MIN_SCORED_FRAMES and spent_s > limit_s:
            return
        seen = frame.observation
        picture = render(avatar, seen.pose, seen.camera, cells=frame.correspondences)
        shown = None
        if count < KEPT_RENDERINGS:
            white = np.clip(composite_on_white(picture), 0.0, 1.0)
            shown = (white * 255.0 + 0.5).astype(np.uint8)
        sampled = PixelSample.of(frame).score_rendering(picture)
        yield _ScoredFrame(frame, score_rendering(picture, frame), sampled, shown)
