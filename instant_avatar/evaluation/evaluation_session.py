"""Score avatars on frames: the volume renderer, in given and fitted poses, and the player."""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, final

from avatar.evaluation.held_out import HeldOutFrame
from avatar.evaluation.perceptual import Lpips
from avatar.render import render
from avatar.training import checkpoint
from avatar.training.held_out_pose_fitting import fit_test_poses
from avatar.training.trainer import Trainer
from capture.input_error import counted
from export.player import Player, premultiply
from instant_avatar.cli.console import Console
from instant_avatar.evaluation.evaluate_arguments import EvaluateArguments
from instant_avatar.evaluation.evaluation_frames import (
    EvaluationFrames,
    capture_frames,
    read_report,
)
from instant_avatar.evaluation.frame_scoring import (
    FrameRenderer,
    PremultipliedImage,
    ShownFrame,
    score_picture,
)
from instant_avatar.evaluation.score_table import AvatarEvaluation, ScoreRow
from instant_avatar.run.run_folder import RunFolder
from preprocess.observation import Observation

VOLUME_RENDERER = "renderer"
"""Name of the volume renderer in the table."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluationSession:
    """One call of ia-evaluate; `stop`, set by Ctrl-C, ends scoring early."""

    arguments: EvaluateArguments
    console: Console
    stop: threading.Event
    lpips: Lpips

    def evaluate_run(
        self,
        name: str,
        run: RunFolder,
        frames: EvaluationFrames,
        *,
        backgrounds: tuple[str, ...] = ("white",),
        paper: dict[str, float] | None = None,
    ) -> AvatarEvaluation:
        """Score renderer and player of a run.

        `backgrounds` apply if the user names none; `paper` holds the published scores of a
        dataset's subject, which may be none; None for the runs of a user.
        """
        with self.console.status(f"loading {run.checkpoint}"):
            trainer = checkpoint.load(run.checkpoint)[0]
        report = read_report(run) if run.report_json.is_file() else None
        package = run.package if run.package.is_file() else None
        return self.evaluate(
            name, frames, trainer, package,
            backgrounds=backgrounds, report=report, paper=paper,
        )  # fmt: skip

    def frames_of_capture(self, run: RunFolder, size_px: int | None = None) -> EvaluationFrames:
        """Open the capture of --on for the person of a run, if the run is known."""
        arguments = self.arguments
        assert arguments.on is not None
        person = run.body_file if run.body_file.is_file() else None
        inputs = arguments.capture_inputs(arguments.on)
        return capture_frames(inputs, person, arguments.size or size_px)

    def evaluate(
        self,
        name: str,
        frames: EvaluationFrames,
        trainer: Trainer | None = None,
        package: Path | None = None,
        *,
        backgrounds: tuple[str, ...] = ("white",),
        report: dict[str, Any] | None = None,
        paper: dict[str, float] | None = None,
    ) -> AvatarEvaluation:
        """Score a trainer's renderer and a package's player, on frames before `stop` is set."""
        renderers = self._renderers(frames, trainer, package)
        scorer = FrameScorer(
            renderers,
            trainer if self.arguments.fitted else None,
            self.arguments.background or backgrounds,
            self.lpips,
            poses=frames.poses,
            keeps_pictures=self.arguments.card is not None,
        )
        with self.console.progress(f"scoring {name}", float(frames.count or 0)) as bar:
            done, rest = 0, iter(frames)
            while group := list(islice(rest, 25)):
                for observation in group:
                    if self.stop.is_set():
                        break
                    scorer.score_frame(observation)
                    done += 1
                    bar.update(float(done), f"frame {observation.frame.index}, {done} scored")
                if self.stop.is_set():
                    break
                if scorer.fits_poses:
                    bar.update(float(done), f"fitting poses to {counted(len(group), 'frame')}")
                    scorer.score_fitted(group)
        return AvatarEvaluation(
            name=name,
            capture=str(frames.capture.paths.video),
            size=scorer.size_px,
            rows=scorer.rows,
            shown=scorer.shown,
            report=report,
            paper=paper,
        )

    def _renderers(
        self, frames: EvaluationFrames, trainer: Trainer | None, package: Path | None
    ) -> dict[str, FrameRenderer]:
        """Return what draws the capture's poses, by name: volume renderer and player's tiers."""
        renderers: dict[str, FrameRenderer] = {}
        if trainer is not None:
            renderers[VOLUME_RENDERER] = partial(_render_volume, trainer)
        if package is None or not (self.arguments.player or trainer is None):
            return renderers
        if frames.capture.cameras[0].distortion:
            self.console.warning(
                "The player renders pinhole images; this lens has distortion, so it is not scored."
            )
            return renderers
        best = Player.load(package)
        for tier in best.manifest.tiers:
            player = best if tier == "hq" else Player.load(package, tier=tier)
            renderers[f"player {tier}"] = partial(_play, player)
        return renderers


@final
class FrameScorer:
    """Scorer of the frames of one avatar.

    Attributes:
        rows: Scores by renderer, poses and background.
        size_px: Width and height of the images; None before the first.
        shown: Frames with their renderings, of the fitted poses or else of the first row.
    """

    def __init__(
        self,
        renderers: dict[str, FrameRenderer],
        fitted: Trainer | None,
        backgrounds: tuple[str, ...],
        lpips: Lpips | None = None,
        *,
        poses: str = "given",
        keeps_pictures: bool = False,
    ) -> None:
        """Prepare the rows of the table.

        Args:
            renderers: What draws the capture's poses, by name.
            fitted: Holds the avatar to which poses are fitted; None not to fit any.
            backgrounds: Names of `BACKGROUNDS`.
            poses: Where the capture's poses come from: "tracked" or "given".
            keeps_pictures: Whether `shown` is filled.
        """
        self._renderers, self._trainer, self._lpips = renderers, fitted, lpips
        self._poses = poses
        ways = [(name, poses) for name in renderers]
        if fitted is not None:
            ways.insert(1, (VOLUME_RENDERER, "fitted"))
        self._rows = {
            way: [ScoreRow(renderer=way[0], poses=way[1], background=each) for each in backgrounds]
            for way in ways
        }
        self._shown_way = None
        if keeps_pictures and ways:
            self._shown_way = ways[0] if fitted is None else ways[1]
        self.rows = [row for rows in self._rows.values() for row in rows]
        self.size_px: tuple[int, int] | None = None
        self.shown: list[ShownFrame] = []

    @property
    def fits_poses(self) -> bool:
        """True if fitted poses are scored."""
        return self._trainer is not None

    def score_frame(self, observation: Observation) -> None:
        """Score all renderers in a frame's own pose."""
        self.size_px = observation.camera.size_px
        for name, draw in self._renderers.items():
            self._score((name, self._poses), observation, draw)

    def score_fitted(self, observations: Sequence[Observation]) -> None:
        """Score the volume renderer in poses and exposures that are fitted to frames."""
        trainer = self._trainer
        assert trainer is not None
        frames = [HeldOutFrame(observation=each) for each in observations]
        for frame in fit_test_poses(trainer, frames):
            draw = partial(_render_volume, trainer, frame=frame)
            self._score((VOLUME_RENDERER, "fitted"), frame.observation, draw)

    def _score(self, way: tuple[str, str], observation: Observation, draw: FrameRenderer) -> None:
        started = time.process_time()
        picture = draw(observation)
        cpu_ms = 1000.0 * (time.process_time() - started)
        for row in self._rows[way]:
            score = score_picture(observation, picture, row.background, self._lpips, cpu_ms=cpu_ms)
            row.scores.append(score)
        if way == self._shown_way:
            row = self._rows[way][0]
            shown = ShownFrame.of(observation, picture, row.background, row.scores[-1])
            self.shown.append(shown)


def _render_volume(
    trainer: Trainer, observation: Observation, frame: HeldOutFrame | None = None
) -> PremultipliedImage:
    """Render a pose, in the exposure of a held-out frame if there is one."""
    picture = render(trainer.avatar, observation.pose, observation.camera, shaded=True)
    return picture if frame is None else frame.expose(picture)


def _play(player: Player, observation: Observation) -> PremultipliedImage:
    return premultiply(player.render(observation.pose, observation.camera))
