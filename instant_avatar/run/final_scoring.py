"""Scores after the last step, and the videos that an avatar was trained on before.

A few whole images are scored, as long as time allows. The scores of the other frames are estimates
from 4,096 of their pixels, without SSIM: they cost a sixth, and all frames in part tell more about
the mean than a few of them in whole. Key frames of earlier videos are replayed against forgetting.
"""

import math
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple, final

import numba
import numpy as np
from jaxtyping import UInt8

from avatar.avatar_model import Avatar
from avatar.evaluation.all_round_verdict import AllRoundVerdict
from avatar.evaluation.coverage import Coverage, coverage_advice
from avatar.evaluation.held_out import (
    HeldOutFrame,
    PixelSample,
    coarse_to_fine_order,
    score_fine_sample,
    score_frame,
    score_rendering,
)
from avatar.evaluation.image_metrics import better_verdict, composite_on_white, overall_verdict
from avatar.evaluation.unfilmed_views import half_transparent_share, render_unfilmed_views
from avatar.events import HeldOutScore
from avatar.render import render
from avatar.training.checkpoint import (
    EARLIER_VIDEOS_FILE,
    INDEX_SHIFT_PER_VIDEO,
    LAST_RUN_FILE,
    as_earlier_video,
    load_frames,
    save_frames,
)
from avatar.training.frame_stream import rebuild_frame
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.trainer import Trainer
from capture.input_error import counted
from capture.work_ahead import map_ahead
from export.build import ExportReport
from instant_avatar.cli.console import Console
from instant_avatar.report.report_schema import CurvePoint, EarlierVideoStats, finite_mean
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.stream_meter import StreamMeter

SCORING_LIMIT_S = 8.0
"""Wall time that final scoring and pose fitting aim for."""
MIN_WHOLE_IMAGES = 3
"""Frames that are scored as whole images, whatever it takes."""
MAX_WHOLE_IMAGES = 12
"""Frames that are scored as whole images, at most."""
UNFILMED_REDUCTION = 2
"""Factor by which pictures of views that were not filmed are reduced."""
FRAMES_PER_FIT = 4
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
        half_transparent: Share of half-transparent pixels in views that were not filmed, in [0, 1];
            None if it was not measured.
    """

    given: tuple[HeldOutScore, ...] = ()
    sampled: tuple[HeldOutScore, ...] = ()
    fitted: tuple[HeldOutScore, ...] = ()
    renderings: dict[int, WhiteImage] = field(default_factory=dict)
    half_transparent: float | None = None

    def summarize(self, last: CurvePoint, verdict: str | None) -> CurvePoint:
        """The learning curve's last point with these scores, and the report's verdict."""
        return replace(
            last,
            psnr=finite_mean([score.psnr for score in self.given]),
            psnr_mask=finite_mean([score.psnr_mask for score in self.given]),
            verdict=verdict,
            frames=tuple((score.frame, score.psnr) for score in self.given),
            pixels=None,
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainingResult:
    """A trained avatar and how it was trained.

    Attributes:
        curve: Learning curve, up to the final scores.
        frames_added: Frames of this capture that were trained on.
        exported: Describes the package; None without one, and `refusal` may say why.
        ready_at: When the package could be played, on `time.perf_counter`'s clock.
        scores: Final scores of the held-out frames; empty before they are scored.
        licence: What it was made with, and what that allows (`preprocess.licence_chain`).
    """

    trainer: Trainer
    held_out: list[HeldOutFrame]
    curve: tuple[CurvePoint, ...]
    meter: StreamMeter
    coverage: Coverage
    frames_added: int
    interrupted: bool
    exported: ExportReport | None = None
    refusal: str | None = None
    ready_at: float | None = None
    scores: FinalScores = field(default_factory=FinalScores)
    earlier_videos: EarlierVideoStats | None = None
    licence: dict[str, Any] = field(default_factory=dict)

    @property
    def is_trained(self) -> bool:
        """True if any step was made on any frame."""
        return self.trainer.steps > 0 and self.frames_added > 0

    def all_round_verdict(self) -> AllRoundVerdict:
        """The verdict on the avatar from all sides; there is none until those were looked at."""
        scores, exported = self.scores, self.exported
        held_out = better_verdict(overall_verdict(scores.given), overall_verdict(scores.fitted))
        return AllRoundVerdict.of(
            None if scores.half_transparent is None else held_out,
            seen=self.coverage.seen_share,
            mean_cosine=self.coverage.mean_cosine,
            half_transparent=scores.half_transparent,
            player_psnr=exported.psnr_to_renderer.get("hq") if exported else None,
            film_advice=coverage_advice(self.coverage),
        )


class _ScoredFrame(NamedTuple):
    """A frame in its given pose; without a rendering where a sample of it was scored."""

    frame: HeldOutFrame
    given: HeldOutScore
    sampled: HeldOutScore
    rendering: WhiteImage | None


def score_finally(
    trainer: Trainer,
    held_out: list[HeldOutFrame],
    *,
    fit_poses: bool,
    report_progress: Callable[[str, float], object] = lambda *_: None,
    is_left_out: Callable[[], bool] = lambda: False,
    clock: Callable[[], float] = time.perf_counter,
) -> FinalScores:
    """Score the held-out frames in about `SCORING_LIMIT_S`; with `fit_poses` in fitted poses, too.

    After a given number of steps all are scored, whatever the time: the results of such a run do
    not depend on the machine. `report_progress` receives the stage and its share that is done; once
    `is_left_out` is true, what was scored until then is returned. `clock` gives the seconds by
    which the limit is kept.
    """
    if not held_out:
        return FinalScores()
    limit_s = math.inf if trainer.config.steps else SCORING_LIMIT_S
    began, scored, fitted = clock(), list[_ScoredFrame](), list[HeldOutScore]()

    def is_late(share: float) -> bool:
        return clock() - began > share * limit_s

    with closing(_score_in_given_poses(trainer.avatar, held_out, is_late)) as given:
        while not is_left_out() and (one := next(given, None)) is not None:
            scored.append(one)
            report_progress(
                f"scoring {counted(len(held_out), 'held-out frame')}", len(scored) / len(held_out)
            )
    half_transparent = None
    if not is_left_out():
        half_transparent = half_transparent_share(
            render_unfilmed_views(trainer.avatar, reduction=UNFILMED_REDUCTION)
        )
    if fit_poses and not is_left_out():
        with suppress(KeyboardInterrupt):
            for score in _score_in_fitted_poses(
                trainer, scored, is_late, report_progress, is_left_out
            ):
                fitted.append(score)
    order = np.argsort([one.given.frame for one in scored])
    shown = [one for one in scored if one.rendering is not None][:KEPT_RENDERINGS]
    return FinalScores(
        given=tuple(scored[i].given for i in order),
        sampled=tuple(scored[i].sampled for i in order),
        fitted=tuple(sorted(fitted, key=lambda score: score.frame)),
        renderings={one.given.frame: one.rendering for one in shown if one.rendering is not None},
        half_transparent=half_transparent,
    )


def _score_in_given_poses(
    avatar: Avatar, held_out: list[HeldOutFrame], is_late: Callable[[float], bool]
) -> Generator[_ScoredFrame, None, None]:
    """Score frames in an order of which every prefix is spread over the video."""

    def score(numbered: tuple[int, HeldOutFrame]) -> _ScoredFrame:
        numba.set_num_threads(1)  # of this frame; others are scored beside it
        count, frame = numbered
        late = count >= MIN_WHOLE_IMAGES and is_late(0.2)
        if late or count >= MAX_WHOLE_IMAGES:
            sampled = PixelSample.of(frame).score(avatar)
            return _ScoredFrame(frame, score_fine_sample(avatar, frame), sampled, None)
        seen = frame.observation
        picture = render(avatar, seen.pose, seen.camera, cells=frame.correspondences, shaded=True)
        white = np.clip(composite_on_white(picture), 0.0, 1.0)
        sampled = PixelSample.of(frame).score_rendering(picture)
        shown = (white * 255.0 + 0.5).astype(np.uint8)
        return _ScoredFrame(frame, score_rendering(picture, frame), sampled, shown)

    yield from map_ahead(
        score, enumerate(coarse_to_fine_order(held_out)), workers=numba.get_num_threads()
    )


def _score_in_fitted_poses(
    trainer: Trainer,
    scored: list[_ScoredFrame],
    is_late: Callable[[float], bool],
    report_progress: Callable[[str, float], object],
    is_left_out: Callable[[], bool],
) -> Iterator[HeldOutScore]:
    """Fit frames, a few at a time, and score them as they were in the given poses.

    Raises:
        KeyboardInterrupt: Once `is_left_out`, also amid a fit.
    """

    def check(share: float) -> None:
        if is_left_out():
            raise KeyboardInterrupt

    def fit(first: int) -> list[HeldOutScore]:
        numba.set_num_threads(1)  # of these frames; others are fitted beside them
        if is_left_out() or (first and is_late(1.0)):
            return []
        some, scores = scored[first : first + FRAMES_PER_FIT], list[HeldOutScore]()
        fitted = fit_test_poses(trainer, [one.frame for one in some], progress=check)
        for one, frame in zip(some, fitted, strict=True):
            score = score_fine_sample if one.rendering is None else score_frame
            after = score(trainer.avatar, frame)
            scores.append(after if after.psnr >= one.given.psnr else one.given)
        return scores

    stage = "fitting poses to the held-out frames"
    first_frames = range(0, len(scored), FRAMES_PER_FIT)
    report_progress(stage, 0.0)
    with closing(map_ahead(fit, first_frames, workers=numba.get_num_threads())) as fits:
        for done, scores in enumerate(fits, start=1):
            yield from scores
            report_progress(stage, done / len(first_frames))


@final
class EarlierVideos:
    """The videos that an avatar was trained on before this one.

    Their key frames stay in the replay buffer and compete with new ones for its places.
    """

    def __init__(self, run: RunFolder, notes: dict[str, Any]) -> None:
        """Load the frames of earlier videos, if the run's checkpoint folder holds any.

        `notes` are stored with each checkpoint; they receive what an interrupted run needs.
        """
        self._run, self._notes = run, notes
        began = "before" in notes  # otherwise the file is from a run that was killed at its start
        self._kept = load_frames(run.checkpoint / EARLIER_VIDEOS_FILE) if began else []

    def start_new_video(self, trainer: Trainer, console: Console) -> None:
        """Turn the previous video into an earlier one, whose key frames are replayed."""
        self._kept = as_earlier_video(load_frames(self._run.checkpoint / LAST_RUN_FILE))
        save_frames(self._kept, self._run.checkpoint / EARLIER_VIDEOS_FILE)
        trainer.pose_corrections = {
            index - INDEX_SHIFT_PER_VIDEO: correction
            for index, correction in trainer.pose_corrections.items()
        }
        gains = trainer.exposures.by_frame
        trainer.exposures.restore(
            {index - INDEX_SHIFT_PER_VIDEO: gain for index, gain in gains.items()}
        )
        if not self._kept:
            console.warning(
                "The previous video's run did not finish, so its key frames were not saved and "
                "cannot be replayed."
            )
        self.restore_key_frames(trainer, console)
        previous = self._notes.get("name") or Path(self._notes["video"]).name
        self._notes["before"] = {
            "videos": [*earlier_video_names(self._notes), previous],
            "frames": trainer.frames_seen,
            "seconds": trainer.wall_seconds,
            "steps": trainer.steps,
        }

    def restore_key_frames(self, trainer: Trainer, console: Console) -> None:
        """Put the key frames of earlier videos back into the replay buffer."""
        if not self._kept:
            return
        with console.status(f"preparing {counted(len(self._kept), 'frame')} of the earlier video"):
            for frame in self._kept:
                restored = rebuild_frame(*frame[:4], trainer.avatar.rig, head=frame.head)
                trainer.add_frame(restored, is_restored=True)

    def save_frames(self, trainer: Trainer) -> None:
        """Save the frames of this video for the next one."""
        save_frames(trainer.replay.replay_frames(), self._run.checkpoint / LAST_RUN_FILE)

    def stats(self) -> EarlierVideoStats | None:
        """Describe the earlier videos, if there are any."""
        if "before" not in self._notes:
            return None
        return EarlierVideoStats(
            videos=earlier_video_names(self._notes),
            frames_trained=self._notes["before"]["frames"],
            wall_seconds=self._notes["before"]["seconds"],
            replayed_key_frames=len(self._kept),
        )


def earlier_video_names(notes: dict[str, Any]) -> tuple[str, ...]:
    """Return the names of the videos before the current one from a checkpoint's notes."""
    return tuple(notes.get("before", {}).get("videos", ()))
