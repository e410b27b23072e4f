"""Score avatars on frames: volume renderer, fitted poses, each tier of the player, pictures."""

import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import final

from apps.animation.driving_motion import load_driving_motion
from apps.cli.console import Console, ProgressBar
from apps.evaluation.evaluate_arguments import EvaluateArguments
from apps.evaluation.evaluation_frames import (
    EvaluationFrames,
    PictureFolder,
    capture_frames,
    read_report,
)
from apps.evaluation.frame_scoring import FrameJudge, FrameRenderer, PremultipliedImage, ShownFrame
from apps.evaluation.score_table import AvatarEvaluation, ScoreRow
from apps.report.report_page import data_uri
from apps.report.report_writer import motion_animation
from apps.run.run_folder import RunFolder
from avatar.evaluation.held_out import HeldOutFrame
from avatar.evaluation.perceptual import Lpips
from avatar.render import render
from avatar.training import checkpoint
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.trainer import Trainer
from capture.input_error import InputError
from export.player import Player, premultiply
from preprocess.observation import Observation

BEST_TIER = "hq"
"""Tier that every package has."""
FIT_BATCH_FRAMES = 25
"""Number of frames whose poses are fitted together."""
VOLUME_RENDERER, PICTURES = "renderer", "pictures"
"""What the rows of the volume renderer, and of another system's pictures, are drawn by."""


@final
class AvatarScorer:
    """Scores one avatar.

    Attributes:
        rows: Scores by renderer, poses and background.
        size_px: Width and height of the images; None before the first.
        shown: Frames with their renderings, of the fitted poses or else of the first row.
    """

    def __init__(
        self,
        trainer: Trainer | None,
        renderers: Mapping[str, FrameRenderer],
        judge: FrameJudge,
        *,
        fit_poses: bool,
        keeps_images: bool = False,
    ) -> None:
        """Prepare the rows of the table.

        Args:
            trainer: Holds the avatar for the volume renderer; None for the others alone.
            renderers: Other renderers in given poses, by name.
            judge: Compares renderings with frames.
            fit_poses: Whether to score fitted poses of the volume renderer as well.
            keeps_images: Whether `shown` is filled.
        """
        self._trainer, self._judge = trainer, judge
        self._renderers: dict[str, FrameRenderer] = dict(renderers)
        if trainer is not None:
            self._renderers = {VOLUME_RENDERER: self._render_volume} | self._renderers
        self._fits = fit_poses and trainer is not None
        ways = [(name, _poses_of(name)) for name in self._renderers]
        if self._fits:
            ways.insert(1, (VOLUME_RENDERER, "fitted"))
        self._rows = {
            (name, poses): [
                ScoreRow(renderer=name, poses=poses, background=background)
                for background in judge.backgrounds
            ]
            for name, poses in ways
        }
        self._shown_way = None
        if keeps_images:
            self._shown_way = (VOLUME_RENDERER, "fitted") if self._fits else ways[0]
        self.rows = [row for rows in self._rows.values() for row in rows]
        self.size_px: tuple[int, int] | None = None
        self.shown: list[ShownFrame] = []

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
                self.size_px = seen.camera.size_px
                for name, draw in self._renderers.items():
                    self._score((name, _poses_of(name)), seen, partial(draw, seen))
                done += 1
                bar.update(float(done), f"frame {seen.frame.index}, {done} scored")
            if self._fits and not stop.is_set():
                bar.update(float(done), f"fitting poses to {len(some)} frames")
                self._score_in_fitted_poses(some)

    def _score(
        self,
        way: tuple[str, str],
        observation: Observation,
        draw: Callable[[], PremultipliedImage | None],
    ) -> None:
        started = time.process_time()
        picture = draw()
        cpu_ms = 1000.0 * (time.process_time() - started)
        if picture is None:
            return
        if way[0] == PICTURES:
            cpu_ms = float("nan")  # it was read, not rendered
        scores = self._judge.score(observation, picture, cpu_ms=cpu_ms)
        for row, score in zip(self._rows[way], scores, strict=True):
            row.scores.append(score)
        if way == self._shown_way:
            background = self._judge.backgrounds[0]
            self.shown.append(ShownFrame.of(observation, picture, background, scores[0]))

    def _render_volume(self, observation: Observation) -> PremultipliedImage:
        assert self._trainer is not None
        return render(self._trainer.avatar, observation.pose, observation.camera, shaded=True)

    def _score_in_fitted_poses(self, observations: Sequence[Observation]) -> None:
        trainer = self._trainer
        assert trainer is not None
        for held in fit_test_poses(
            trainer, [HeldOutFrame(observation=seen) for seen in observations]
        ):
            draw = partial(_render_exposed, trainer, held)
            self._score((VOLUME_RENDERER, "fitted"), held.observation, draw)


def score_avatar(
    name: str,
    frames: EvaluationFrames,
    scorer: AvatarScorer,
    console: Console,
    stop: threading.Event,
) -> AvatarEvaluation:
    """Score an avatar on all frames, with a progress bar."""
    with console.progress(f"scoring {name}", float(frames.count or 0)) as bar:
        scorer.score_frames(frames, bar, stop)
    return AvatarEvaluation(
        name=name,
        capture=str(frames.recording.paths.video),
        size=scorer.size_px,
        rows=scorer.rows,
        shown=scorer.shown,
    )


def load_players(
    package: Path | None, frames: EvaluationFrames, console: Console
) -> dict[str, FrameRenderer]:
    """Load a player per tier; none for images with lens distortion.

    Raises:
        InputError: If the package is damaged.
    """
    if package is None:
        return {}
    if frames.recording.cameras[0].distortion:
        console.warning(
            "The player renders pinhole images; this lens has distortion, so it is not scored."
        )
        return {}
    best = Player.load(package)
    rest = [tier for tier in best.manifest.tiers if tier != BEST_TIER]
    players = {BEST_TIER: best, **{tier: Player.load(package, tier=tier) for tier in rest}}
    return {f"player {tier}": partial(_play, player) for tier, player in players.items()}


def _poses_of(renderer: str) -> str:
    """Return whose poses a renderer is given."""
    return "theirs" if renderer == PICTURES else "given"


def _render_exposed(trainer: Trainer, held: HeldOutFrame) -> PremultipliedImage:
    seen = held.observation
    return held.expose(render(trainer.avatar, seen.pose, seen.camera, shaded=True))


def _play(player: Player, observation: Observation) -> PremultipliedImage:
    return premultiply(player.render(observation.pose, observation.camera))


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluationSession:
    """One call of ia-evaluate.

    Attributes:
        arguments: As given.
        console: Shows progress.
        stop: Set by Ctrl-C; ends scoring early.
        lpips: LPIPS with the weights that were found.
    """

    arguments: EvaluateArguments
    console: Console
    stop: threading.Event
    lpips: Lpips

    @classmethod
    def begin(
        cls, arguments: EvaluateArguments, console: Console, stop: threading.Event
    ) -> "EvaluationSession":
        """Load the networks of LPIPS, and say which are missing."""
        lpips = Lpips(arguments.lpips, arguments.lpips_weights)
        if lpips.unavailable is not None:
            console.info(lpips.unavailable)
        return cls(arguments=arguments, console=console, stop=stop, lpips=lpips)

    def evaluate_package(self, package: Path, frames: EvaluationFrames) -> AvatarEvaluation:
        """Score the player alone."""
        players, dances = load_players(package, frames, self.console), self._dances(package)
        return replace(self._evaluate(str(package), frames, None, players), dances=dances)

    def evaluate_run(
        self,
        name: str,
        run: RunFolder,
        frames: EvaluationFrames,
        backgrounds: tuple[str, ...] = ("white",),
    ) -> AvatarEvaluation:
        """Score renderer and player of a run, by default on white."""
        package = run.package if self.arguments.player and run.package.is_file() else None
        players, dances = load_players(package, frames, self.console), self._dances(run.package)
        report = read_report(run) if run.report_json.is_file() else None
        scored = self._evaluate(name, frames, self._load_trainer(run), players, backgrounds)
        return replace(scored, report=report, dances=dances)

    def evaluate_pictures(self, folder: Path) -> AvatarEvaluation:
        """Score pictures that another system rendered of the frames of --on.

        Raises:
            InputError: If no picture belongs to a frame, or one does not match its frame.
        """
        frames = self.frames_of_capture(None)
        pictures = PictureFolder(folder, frames.recording.source, self._backgrounds(("white",)))
        scored = self._evaluate(str(folder), frames, None, {PICTURES: pictures})
        missing = pictures.describe_missing()
        if missing is not None and not scored.rows[0].scores:
            raise InputError(missing)
        for note in (pictures.order_note, missing):
            if note is not None:
                self.console.warning(note)
        return scored

    def frames_of_capture(
        self, run: RunFolder | None, size_px: int | None = None
    ) -> EvaluationFrames:
        """Open the capture of --on for the person of a run, or for the poses' own."""
        arguments, person = self.arguments, None
        assert arguments.on is not None
        if run is not None and run.body_file.is_file():
            person = run.body_file
        inputs = arguments.capture_inputs(arguments.on)
        return capture_frames(inputs, person, arguments.size or size_px)

    def _evaluate(
        self,
        name: str,
        frames: EvaluationFrames,
        trainer: Trainer | None,
        renderers: dict[str, FrameRenderer],
        backgrounds: tuple[str, ...] = ("white",),
    ) -> AvatarEvaluation:
        judge = FrameJudge(self._backgrounds(backgrounds), self.lpips, frames.recording.shaped)
        scorer = AvatarScorer(
            trainer,
            renderers,
            judge,
            fit_poses=self.arguments.fitted,
            keeps_images=self.arguments.card is not None,
        )
        return score_avatar(name, frames, scorer, self.console, self.stop)

    def _dances(self, package: Path) -> dict[str, str]:
        """Draw the motions of --dance; nothing without a package."""
        if not package.is_file() or not self.arguments.dance or self.stop.is_set():
            return {}
        player, drawn = Player.load(package), dict[str, str]()
        for path in self.arguments.dance:
            with self.console.status(f"drawing {path}"):
                motion = load_driving_motion(path, player.manifest.rest_joints, self.console)
                drawn[path.stem] = data_uri(motion_animation(player, motion))
        return drawn

    def _backgrounds(self, usual: tuple[str, ...]) -> tuple[str, ...]:
        return self.arguments.background or usual

    def _load_trainer(self, run: RunFolder) -> Trainer:
        with self.console.status(f"loading {run.checkpoint}"):
            return checkpoint.load(run.checkpoint)[0]
