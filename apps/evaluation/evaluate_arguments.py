"""What ia-evaluate can be told; the text under each field is its --help."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from apps.cli.capture_options import parse_frame_range
from apps.cli.output_paths import check_output_file
from capture.input_error import InputError
from preprocess.capture_session import CaptureInputs


@dataclass(frozen=True, kw_only=True)
class EvaluateArguments:
    """Says how good avatars are, as a table (Markdown): renderer and player beside real frames.

    Try it:

        ia-evaluate run                              a run's own held-out frames
        ia-evaluate run other/run --json table.json  several; their mean, too
        ia-evaluate run --on another/capture         the same person in another video
        ia-evaluate run/avatar.iavatar --on capture --frames 100:200:5      the player alone
        ia-evaluate PeopleSnapshot --out evaluation --body SMPL_MALE.pkl    the paper's protocol

    The last one learns each subject of PeopleSnapshot that it finds (folders in InstantAvatar's
    layout: male-3-casual, …) from the paper's training frames for --seconds, scores the paper's
    test frames, and puts the paper's figures beside (docs/evaluation.md). Subjects that were
    learnt before are not learnt again.

    All pictures are compared on white and whole, in the capture's poses ("given") and in poses
    fitted to each frame with the avatar frozen ("fitted", as the paper does).

    Exit codes: 0 done; 2 bad input; 3 disk full; 130 Ctrl-C, after a table of what was scored.
    """

    targets: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="RUN|AVATAR|DATASET", help_behavior_hint="")
    ]
    """Folders that ia-ingest wrote, .iavatar packages, or a folder of PeopleSnapshot's subjects."""
    on: Annotated[Path | None, arg(metavar="CAPTURE", help_behavior_hint="")] = None
    """Score on this video or capture folder, all of its frames, instead of the run's own held-out
    ones."""
    poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Of --on, as ia-ingest takes them; without it what lies in the folder."""
    masks: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Of --on; as above."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Of --on; as above."""
    body: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """The body that the avatars were learnt with, if it was a file of your own."""
    frames: str = "::"
    """Which frames of --on, START:STOP:STEP, counted from 0."""
    size: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Longer side of the pictures; without it as the run was learnt, else as they are."""
    fitted: Annotated[bool, arg(help_behavior_hint="")] = True
    """Also in poses fitted to the frames."""
    player: Annotated[bool, arg(help_behavior_hint="")] = True
    """Also as the package's player draws them, in each tier."""
    seconds: float = 60.0
    """Of a dataset: how long each subject is learnt."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Of a dataset: number of training steps for each subject, instead of --seconds."""
    out: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """Of a dataset: folder for the runs; without it runs/NAME, after the dataset."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to learn and to render."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Write all figures to this file, of every frame."""
    markdown: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Write the table to this file as well."""
    overwrite: Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")] = False
    """Replace the files that --json and --markdown name, if they are there."""

    def validate(self) -> None:
        """Refuses what cannot be meant.

        Raises:
            InputError: Naming the option.
        """
        if not self.targets:
            raise InputError("Name a run, a package or a dataset: ia-evaluate run (see --help).")
        if self.size is not None and self.size < 16:
            raise InputError(f"--size is {self.size}; at least 16 pixels were expected.")
        if not 0.0 < self.seconds < float("inf"):
            raise InputError(f"--seconds is {self.seconds}; a positive number was expected.")
        if self.steps is not None and self.steps < 1:
            raise InputError(f"--steps is {self.steps}; at least 1 was expected.")
        parse_frame_range(self.frames)
        told = [
            f"--{name}" for name in ("poses", "masks", "cameras") if getattr(self, name) is not None
        ]
        if self.frames != "::":
            told.append("--frames")
        if told and self.on is None:
            raise InputError(f"{', '.join(told)} belong to a capture: name it with --on.")
        for flag, place in (("--json", self.json), ("--markdown", self.markdown)):
            if place is not None:
                check_output_file(place, flag, self._inputs(), overwrite=self.overwrite)
        for path in self.targets:
            if not path.exists():
                raise InputError(
                    f"{path} does not exist; a run's folder or a package was expected."
                )

    def _inputs(self) -> list[Path]:
        """What is read and must not be written to."""
        packages = [path for path in self.targets if path.is_file()]
        if self.on is not None:
            return [*packages, *self.capture_inputs(self.on).input_paths()]
        return packages if self.body is None else [*packages, self.body]

    def capture_inputs(self, video: Path) -> CaptureInputs:
        """What is to be opened of --on."""
        return CaptureInputs(
            video=video,
            poses=self.poses,
            masks=self.masks,
            cameras=self.cameras,
            body=self.body,
            frames=parse_frame_range(self.frames),
        )
