"""Draws an avatar for each frame in every way that it can be drawn, and scores it."""

import threading
from collections.abc import Iterable, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import final

from apps.evaluating.frames import Frames
from apps.evaluating.rows import Evaluation, Picture, Row, scored
from apps.terminal.console import Bar, Console
from avatar.fit import fitted
from avatar.hold import HeldOut
from avatar.render import render
from avatar.trainer import Trainer
from export.player import Player, premultiplied
from preprocess.observation import Observation

BEST = "hq"
"""The tier that every package has."""
TOGETHER = 25
"""Frames that poses are fitted to at a time."""


@final
class Judge:
    """One avatar, to be compared with frames.

    Attributes:
        rows: What was found so far.
        size_px: Of the pictures, width and height; None before the first.
    """

    def __init__(self, trainer: Trainer | None, players: dict[str, Player], *, fits: bool) -> None:
        """Nothing is drawn yet.

        Args:
            trainer: With the avatar, for the volume renderer; None for the player alone.
            players: By tier.
            fits: Whether poses are fitted to the frames, too.
        """
        self._trainer, self._players = trainer, players
        self._given = Row(drawn_by="renderer", poses="given")
        self._fitted = Row(drawn_by="renderer", poses="fitted")
        self._played = {tier: Row(drawn_by=f"player {tier}", poses="given") for tier in players}
        self.rows: list[Row] = [*([self._given] if trainer else []), *self._played.values()]
        self.size_px: tuple[int, int] | None = None
        self._fits = fits and trainer is not None
        if self._fits:
            self.rows.insert(1, self._fitted)

    def look(self, frames: Iterable[Observation], bar: Bar, stop: threading.Event) -> None:
        """Scores frame after frame, until there is none left or somebody stops it."""
        done = 0
        rest = iter(frames)
        while some := list(islice(rest, TOGETHER)):
            for seen in some:
                if stop.is_set():
                    return
                self._one(seen)
                done += 1
                bar.move(float(done), f"frame {seen.frame.index}, {done} scored")
            if self._fits and not stop.is_set():
                bar.move(float(done), f"fitting poses to {len(some)} frames")
                self._fit(some)

    def _one(self, seen: Observation) -> None:
        trainer, self.size_px = self._trainer, seen.camera.size_px
        if trainer is not None:
            draw = partial(render, trainer.avatar, seen.pose, seen.camera)
            self._given.scores.append(scored(seen, draw))
        for tier, player in self._players.items():
            self._played[tier].scores.append(scored(seen, partial(_played, player, seen)))

    def _fit(self, some: Sequence[Observation]) -> None:
        trainer = self._trainer
        assert trainer is not None
        for held, _ in fitted(trainer, [HeldOut(observation=seen) for seen in some]):
            seen = held.observation
            draw = partial(render, trainer.avatar, seen.pose, seen.camera)
            self._fitted.scores.append(scored(seen, draw))


def judged(
    name: str,
    frames: Frames,
    trainer: Trainer | None,
    package: Path | None,
    console: Console,
    stop: threading.Event,
    *,
    fits: bool,
) -> Evaluation:
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
        BadInput: If the package is damaged.
    """
    judge = Judge(trainer, _players(package, frames, console), fits=fits)
    with console.bar(f"scoring {name}", float(frames.count or 0)) as bar:
        judge.look(frames, bar, stop)
    video = str(frames.recording.paths.video)
    return Evaluation(name=name, capture=video, size=judge.size_px, rows=judge.rows)


def _played(player: Player, seen: Observation) -> Picture:
    return premultiplied(player.render(seen.pose, seen.camera))


def _players(package: Path | None, frames: Frames, console: Console) -> dict[str, Player]:
    """A player for each tier; none for pictures that a lens has bent."""
    if package is None:
        return {}
    if frames.recording.cameras[0].distortion:
        console.warn("The player draws pinhole pictures; this lens bends, so it is not scored.")
        return {}
    best = Player.load(package)
    rest = [tier for tier in best.manifest.tiers if tier != BEST]
    return {BEST: best, **{tier: Player.load(package, tier=tier) for tier in rest}}
