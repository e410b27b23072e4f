"""Score an avatar on frames: volume renderer, fitted poses, and each tier of the player."""

import threading
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import final

from apps.cli.console import Console, ProgressBar
from apps.evaluation.evaluation_frames import EvaluationFrames
from apps.evaluation.score_table import AvatarEvaluation, PremultipliedImage, ScoreRow, score_frame
from avatar.evaluation.held_out import HeldOutFrame
from avatar.render import render
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.trainer import Trainer
from export.picture_difference import premultiply
from export.player import Player
from preprocess.observation import Observation

BEST_TIER = "hq"
"""Tier that every package has."""
FIT_BATCH_FRAMES = 25
"""Number of frames whose poses are fitted together."""


@final
class AvatarScorer:
    """Scores one avatar.

    Attributes:
        rows: Scores by renderer and poses.
        size_px: Width and height of the images; None before the first.
    """

    def __init__(
        self, trainer: Trainer | None, players: dict[str, Player], *, fit_poses: bool
    ) -> None:
        """Prepare the rows of the table.

        Args:
            trainer: Holds the avatar for the volume renderer; None for the player alone.
            players: Players by tier.
            fit_poses: Whether to score fitted poses as well.
        """
        self._trainer, self._players = trainer, players
        self._given = ScoreRow(renderer="renderer", poses="given")
        self._fitted = ScoreRow(renderer="renderer", poses="fitted")
        self._played = {
            tier: ScoreRow(renderer=f"player {tier}", poses="given") for tier in players
        }
        self.rows: list[ScoreRow] = [*([self._given] if trainer else []), *self._played.values()]
        self.size_px: tuple[int, int] | None = None
        self._fits = fit_poses and trainer is not None
        if self._fits:
            self.rows.insert(1, self._fitted)

    def score_frames(
        self, frames: Iterable[Observation], bar: ProgressBar, stop: threading.Event
    ) -> None:
        """Score all frames, or those before `stop` is set."""
        done = 0
        rest = iter(frames)
        while some := list(islice(rest, FIT_BATCH_FRAMES)):
            for seen in some:
                if stop.is_set():
                    return
                self._score_frame(seen)
                done += 1
                bar.update(float(done), f"frame {seen.frame.index}, {done} scored")
            if self._fits and not stop.is_set():
                bar.update(float(done), f"fitting poses to {len(some)} frames")
                self._score_in_fitted_poses(some)

    def _score_frame(self, observation: Observation) -> None:
        trainer, self.size_px = self._trainer, observation.camera.size_px
        if trainer is not None:
            draw = partial(
                render, trainer.avatar, observation.pose, observation.camera, shaded=True
            )
            self._given.scores.append(score_frame(observation, draw))
        for tier, player in self._players.items():
            self._played[tier].scores.append(
                score_frame(observation, partial(_render_with_player, player, observation))
            )

    def _score_in_fitted_poses(self, observations: Sequence[Observation]) -> None:
        trainer = self._trainer
        assert trainer is not None
        for held in fit_test_poses(
            trainer, [HeldOutFrame(observation=seen) for seen in observations]
        ):
            draw = partial(_render_exposed, trainer, held)
            self._fitted.scores.append(score_frame(held.observation, draw))


def evaluate_avatar(
    name: str,
    frames: EvaluationFrames,
    trainer: Trainer | None,
    package: Path | None,
    console: Console,
    stop: threading.Event,
    *,
    fit_poses: bool,
) -> AvatarEvaluation:
    """Score an avatar.

    Args:
        name: Name of the avatar in the table.
        frames: Frames to compare with.
        trainer: Holds the avatar for the volume renderer; None for the player alone.
        package: Package for the player; None without one.
        console: Shows progress.
        stop: Ends scoring early.
        fit_poses: Whether to score fitted poses as well.

    Raises:
        InputError: If the package is damaged.
    """
    judge = AvatarScorer(trainer, _load_players(package, frames, console), fit_poses=fit_poses)
    with console.progress(f"scoring {name}", float(frames.count or 0)) as bar:
        judge.score_frames(frames, bar, stop)
    video = str(frames.recording.paths.video)
    return AvatarEvaluation(name=name, capture=video, size=judge.size_px, rows=judge.rows)


def _render_exposed(trainer: Trainer, held: HeldOutFrame) -> PremultipliedImage:
    seen = held.observation
    return held.expose(render(trainer.avatar, seen.pose, seen.camera, shaded=True))


def _render_with_player(player: Player, observation: Observation) -> PremultipliedImage:
    return premultiply(player.render(observation.pose, observation.camera))


def _load_players(
    package: Path | None, frames: EvaluationFrames, console: Console
) -> dict[str, Player]:
    """Load a player per tier; none for images with lens distortion."""
    if package is None:
        return {}
    if frames.recording.cameras[0].distortion:
        console.warning(
            "The player renders pinhole images; this lens has distortion, so it is not scored."
        )
        return {}
    best = Player.load(package)
    rest = [tier for tier in best.manifest.tiers if tier != BEST_TIER]
    return {BEST_TIER: best, **{tier: Player.load(package, tier=tier) for tier in rest}}
