"""What all evaluations of one command share: arguments, console, metrics, and the stop signal."""

import threading
from dataclasses import dataclass, replace
from pathlib import Path

from apps.animation.driving_motion import load_driving_motion
from apps.cli.console import Console
from apps.cli.device import resolve_device
from apps.evaluation.avatar_scorer import PICTURES, AvatarScorer, load_players, score_avatar
from apps.evaluation.evaluate_arguments import EvaluateArguments
from apps.evaluation.evaluation_frames import EvaluationFrames, capture_frames, read_report
from apps.evaluation.frame_scoring import FrameJudge, FrameRenderer
from apps.evaluation.picture_folder import PictureFolder
from apps.evaluation.score_table import AvatarEvaluation
from apps.run.report_writer import motion_animation
from apps.run.run_folder import RunFolder
from avatar.evaluation.perceptual import Lpips
from avatar.training import checkpoint
from avatar.training.trainer import Trainer
from capture.input_error import InputError
from export.player import Player


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
                drawn[path.stem] = motion_animation(player, motion)
        return drawn

    def _backgrounds(self, usual: tuple[str, ...]) -> tuple[str, ...]:
        return self.arguments.background or usual

    def _load_trainer(self, run: RunFolder) -> Trainer:
        with self.console.status(f"loading {run.checkpoint}"):
            device = resolve_device(self.arguments.device)
            return checkpoint.load(run.checkpoint, device)[0]
