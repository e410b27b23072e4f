"""Arguments of ia-evaluate; the text under each field is its --help."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal
from zipfile import is_zipfile

from tyro.conf import Positional, arg

from capture.input_error import InputError
from instant_avatar.cli.shared_options import (
    Flag,
    OptionalCameras,
    OptionalCount,
    OptionalFile,
    OptionalFolder,
    OptionalPixels,
    Switch,
    check_output_file,
    parse_frame_range,
)
from preprocess.capture_inputs import CaptureInputs


@dataclass(frozen=True, kw_only=True)
class EvaluateArguments:
    """Score avatars as a table (Markdown): renderer and player against real frames.

    Try it:

        ia-evaluate run                            its own held-out frames
        ia-evaluate run other/run                  which one is better
        ia-evaluate run --on another/capture       the same person elsewhere
        ia-evaluate run/avatar.iavatar --on capture --frames 100:200:5
        ia-evaluate run --card run.html            a page with images
        ia-evaluate PeopleSnapshot --body SMPL_MALE.pkl
        ia-evaluate neuman/dataset --body SMPL_NEUTRAL.pkl

    A dataset is a folder with subjects of PeopleSnapshot (in InstantAvatar's layout:
    male-3-casual, …) or of NeuMan (seattle, …). Each subject is trained on the protocol's training
    frames for --seconds and scored on its test frames, on white and black, next to the paper's
    scores (docs/evaluation.md). Subjects that were trained before are not trained again.

    Images are compared on white, in the capture's poses ("given" in a file, or "tracked") and in
    poses fitted to each frame with the avatar frozen ("fitted", as in the paper).

    LPIPS needs the extra [lpips] and torchvision's weights of AlexNet and VGG-16, which are not
    downloaded here; without them the table says n/a.

    Exit codes: 0 done; 2 bad input; 3 disk full; 130 Ctrl-C, after a table of the scored frames.
    """

    targets: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="RUN|AVATAR|DATASET", help_behavior_hint="")
    ] = ()
    """Folders written by ia-ingest, .iavatar packages, or folders of PeopleSnapshot or NeuMan."""
    on: Annotated[Path | None, arg(metavar="CAPTURE", help_behavior_hint="")] = None
    """Score all frames of this video or capture folder instead of the run's held-out frames."""
    background: Annotated[tuple[Literal["white", "black"], ...], arg(help_behavior_hint="")] = ()
    """Backgrounds behind the person, one or both (default: white; both for a dataset)."""
    lpips: Annotated[tuple[Literal["alex01", "alex", "vgg"], ...], arg(help_behavior_hint="")] = (
        "alex01",
        "alex",
        "vgg",
    )
    """LPIPS as published tables compute it: AlexNet fed [0, 1] (PeopleSnapshot), AlexNet fed
    [-1, 1] (NeuMan), VGG fed [-1, 1] (ZJU-MoCap; five seconds of CPU per image of 540 px).
    Default: all three."""
    lpips_weights: OptionalFolder = None
    """Folder with alexnet-owt-7be5be79.pth and vgg16-397923af.pth (default: torch's cache)."""
    poses: OptionalFile = None
    """Poses of --on, as in ia-ingest (default: those in the capture folder)."""
    masks: OptionalFolder = None
    """Masks of --on, as in ia-ingest (default: those in the capture folder)."""
    cameras: OptionalCameras = None
    """Cameras of --on, as in ia-ingest (default: those in the capture folder)."""
    body: OptionalFile = None
    """Body file that the avatars were trained with, if not the embedded body."""
    frames: str = "::"
    """Frames of --on to use: START:STOP:STEP, counted from 0."""
    rotate: Literal[0, 90, 180, 270] = 0
    """Turn the frames of --on clockwise by this many degrees, as in ia-ingest."""
    size: OptionalPixels = None
    """Longer side of the images (default: as in training, else the original size)."""
    fitted: Switch = True
    """Score poses fitted to the frames as well."""
    player: Switch = True
    """Score each tier of the package's player as well."""
    seconds: float = 60.0
    """Training time per subject of a dataset."""
    steps: OptionalCount = None
    """Training steps per subject of a dataset, instead of --seconds."""
    out: OptionalFolder = None
    """Folder for the runs of a dataset, and for its frames under captures/ (default: runs/NAME,
    named after the dataset)."""
    json: OptionalFile = None
    """Write conditions and the scores of every frame to this file."""
    card: OptionalFile = None
    """Write a page with conditions, scores and pictures to this file."""
    overwrite: Flag = False
    """Replace the files that --json and --card name, if they exist."""

    def validate(self) -> None:
        """Check ranges, combinations and output files; an `InputError` names the option."""
        if not self.targets:
            raise InputError("Pass a run, a package or a dataset: ia-evaluate run (see --help).")
        if self.lpips_weights is not None and not self.lpips_weights.is_dir():
            raise InputError(f"--lpips-weights is {self.lpips_weights}, which is no folder.")
        if self.size is not None and self.size < 16:
            raise InputError(f"--size is {self.size}, but must be at least 16 pixels.")
        if not 0.0 < self.seconds < float("inf"):
            raise InputError(f"--seconds is {self.seconds}, but must be positive.")
        if self.steps is not None and self.steps < 1:
            raise InputError(f"--steps is {self.steps}, but must be at least 1.")
        parse_frame_range(self.frames)
        named = ("poses", "masks", "cameras")
        of_capture = [f"--{name}" for name in named if getattr(self, name) is not None]
        of_capture += ["--frames"] * (self.frames != "::") + ["--rotate"] * (self.rotate != 0)
        if of_capture and self.on is None:
            raise InputError(f"{', '.join(of_capture)} require a capture: pass it with --on.")
        for path in self.targets:
            if not path.exists():
                raise InputError(f"{path} does not exist; expected a run, a package or a data set.")
            if path.is_file() and not is_zipfile(path):
                raise InputError(f"{path} is no package; expected a run, a package or a data set.")
            if path.is_file() and self.on is None:
                raise InputError(
                    f"{path} is a package, which holds no frames: pass a capture of the same "
                    "person with --on, or the run's folder."
                )
        for flag, path in (("--json", self.json), ("--card", self.card)):
            if path is not None:
                check_output_file(path, flag, self._inputs(), overwrite=self.overwrite)

    def _inputs(self) -> list[Path]:
        packages = [path for path in self.targets if path.is_file()]
        if self.on is not None:
            return [*packages, *self.capture_inputs(self.on).input_paths()]
        return packages if self.body is None else [*packages, self.body]

    def capture_inputs(self, video: Path) -> CaptureInputs:
        """Return the inputs of the capture in --on."""
        return CaptureInputs(
            video=video,
            poses=self.poses,
            masks=self.masks,
            cameras=self.cameras,
            body=self.body,
            frames=parse_frame_range(self.frames),
            rotate=self.rotate,
            refine_masks=False,
        )
