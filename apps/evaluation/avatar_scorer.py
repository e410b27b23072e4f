"""Draws an avatar for each frame in every way that it can be drawn, and scores it."""

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
"""The tier that every package has."""
FIT_BATCH_FRAMES = 25
"""Frames that poses are fitted to at a time."""


@final
class AvatarScorer:
    """One avatar, to be compared with frames.

    Attributes:
        rows: What was found so far.
        size_px: Of the pictures, width and height; None before the first.
    """

    def __init__(
        self, trainer: Trainer | None, players: dict[str, Player], *, fit_poses: bool
    ) -> None:
        """Nothing is drawn yet.

        Args:
            trainer: With the avatar, for the volume renderer; None for the player alone.
            players: By tier.
            fits: Whether poses are fitted to the frames, too.
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
        """Scores frame after frame, until there is none left or somebody stops it."""
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
            draw = partial(render, trainer.avatar, observation.pose, observation.camera)
            self._given.scores.append(score_frame(observation, draw))
        for tier, player in self._players.items():
            self._played[tier].scores.append(
                score_frame(observation, partial(_render_with_player, player, observation))
            )

    def _score_in_fitted_poses(self, observations: Sequence[Observation]) -> None:
        trainer = self._trainer
        assert trainer is not None
        for held, _ in fit_test_poses(
            trainer, [HeldOutFrame(observation=seen) for seen in observations]
        ):
            seen = held.observation
            draw = partial(render, trainer.avatar, seen.pose, seen.camera)
            self._fitted.scores.append(score_frame(seen, draw))


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
    """An avatar's rows.

    Args:
        name: By which the table calls it.
        frames: What it is compared with.
        trainer: With the avatar, for the volume renderer.
        package: For the player.
        console: Where progress is shown.
        stop: Ends it before all frames were scored.
        fits: Whether poses are fitted to the frames, too.

    Raises:
        InputError: If the package is damaged.
    """
    judge = AvatarScorer(trainer, _load_players(package, frames, console), fit_poses=fit_poses)
    with console.progress(f"scoring {name}", float(frames.count or 0)) as bar:
        judge.score_frames(frames, bar, stop)
    video = str(frames.recording.paths.video)
    return AvatarEvaluation(name=name, capture=video, size=judge.size_px, rows=judge.rows)


def _render_with_player(player: Player, observation: Observation) -> PremultipliedImage:
    return premultiply(player.render(observation.pose, observation.camera))


def _load_players(
    package: Path | None, frames: EvaluationFrames, console: Console
) -> dict[str, Player]:
    """A player for each tier; none for pictures that a lens has bent."""
    if package is None:
        return {}
    if frames.recording.cameras[0].distortion:
        console.warning("The player draws pinhole pictures; this lens bends, so it is not scored.")
        return {}
    best = Player.load(package)
    rest = [tier for tier in best.manifest.tiers if tier != BEST_TIER]
    return {BEST_TIER: best, **{tier: Player.load(package, tier=tier) for tier in rest}}
