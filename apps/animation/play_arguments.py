"""What ia-play can be told; the text under each field is its --help."""

import os
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from apps.animation.viewpoint import CLOSE_UP_ZOOM, Viewpoint
from apps.cli.output_paths import check_output_file
from capture.input_error import InputError

WEB_PORT = 8010
DEFAULT_TURN_S = 6.0
DEFAULT_SIZE_PX = 540
MIN_SIZE_PX, MAX_SIZE_PX = 16, 4096
MAX_WORKERS = 64
Flag = Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")]


@dataclass(frozen=True, kw_only=True)
class PlayArguments:
    """Moves an avatar: a package that ia-ingest wrote, and poses from anywhere.

    Try it:

        ia-play run/avatar.iavatar                                       a little motion of ours
        ia-play run/avatar.iavatar --poses dance.npz --out dance.mp4
        ia-play run/avatar.iavatar --turntable --out turn.webp --background transparent
        ia-play run/avatar.iavatar --poses walk.npz --still 12 --close-up head --out face.png
        ia-play run/avatar.iavatar --poses amass.npz --orbit 40 --size 1280x720 \\
            --background beach.jpg --speed 0.5
        ia-play run/avatar.iavatar --web                                 in a browser
        ia-play run/avatar.iavatar --verify                              does it look right here?

    Needs no GPU and no torch. Without --camera the camera stands before the first pose, follows
    the pelvis and shows the standing person at 80 % of the picture's height.

    Exit codes: 0 done, 2 bad input, 3 disk full, 130 Ctrl-C (what was drawn by then is kept). What
    is written is written whole or not at all.
    """

    avatar: Annotated[Positional[Path], arg(metavar="AVATAR")]
    """The .iavatar package."""
    poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Poses to move it through: an .npz with global_orient, body_pose, transl (or poses, trans), or
    a file of AMASS, AIST++ or any tracker (docs/formats.md). Without it: a turn, a wave, a few
    steps."""
    person: Annotated[str | None, arg(metavar="ID", help_behavior_hint="")] = None
    """Whose poses, where the file holds several people's; without it whoever has most."""
    still: Annotated[int | None, arg(metavar="ROW", help_behavior_hint="")] = None
    """Hold this pose of --poses (0 is the first): one picture, or a turntable."""
    out: Annotated[Path | None, arg(metavar="FILE|DIR", help_behavior_hint="")] = None
    """Clip (.mp4, .webm), moving picture (.gif, .webp) or picture (.png) to write, or a folder for
    RGBA frames 0000.png …; without it a .webm beside the package, named after the poses. With
    --web: a folder for the page."""
    size: Annotated[str | None, arg(metavar="PX|WxH", help_behavior_hint="")] = None
    """Size in pixels: a number for a square or for the longer side of --camera's pictures, or width
    and height as in 1280x720; without it 540, or what --camera says."""
    fps: Annotated[float | None, arg(metavar="F", help_behavior_hint="")] = None
    """Pictures a second; without it what the poses say, at most 60. The motion keeps its pace."""
    speed: Annotated[float, arg(metavar="X", help_behavior_hint="")] = 1.0
    """How many times faster the motion is; 0.25 is slow motion."""
    background: Annotated[str | None, arg(metavar="COLOUR|FILE", help_behavior_hint="")] = None
    """A colour (white, #203040), a picture (cropped to the size), or `transparent`. Without it
    clips are on white, and .png and frames are transparent."""
    camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Cameras to look through, as ia-ingest takes them: one, or one for each pose."""
    orbit: Annotated[float, arg(metavar="DEG", help_behavior_hint="")] = 0.0
    """How far round the person the camera stands: 90 at its left hand, 180 behind it."""
    elevation: Annotated[float, arg(metavar="DEG", help_behavior_hint="")] = 0.0
    """How far above: 30 looks down on the person, -30 up."""
    distance: Annotated[float | None, arg(metavar="M", help_behavior_hint="")] = None
    """How many metres away; without it 3.5 heights of the person. Nearer is larger and steeper."""
    zoom: Annotated[float | None, arg(metavar="X", help_behavior_hint="")] = None
    """How many times larger than when the whole person is shown; 3.5 with --close-up."""
    close_up: Annotated[str | None, arg(metavar="JOINT", help_behavior_hint="")] = None
    """Look at a joint and follow it: head, spine3, left_hand, right_foot, …"""
    turntable: Annotated[float | None, arg(metavar="[SECONDS]", help_behavior_hint="")] = None
    """The camera goes round the person once in so many seconds (6 if left out; negative: the other
    way): round a standing person, or round the motion while it plays."""
    tier: Literal["hq", "lite"] = "hq"
    """Quality: lite takes two thirds of the time."""
    samples: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Samples along 5 cm of a ray, 1 to 256; without it what the tier says."""
    workers: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Pictures that are drawn at the same time; without it one for each core. The pictures do not
    depend on it."""
    provider: Annotated[str, arg(metavar="NAME", help_behavior_hint="")] = "cpu"
    """onnxruntime's execution provider (cpu, cuda, …), where it is installed."""
    web: Annotated[int | None, arg(metavar="[PORT]", help_behavior_hint="")] = None
    """Play it in a browser, http://127.0.0.1:PORT (8010 if PORT is left out): turn it, pause, seek.
    With --out FOLDER nothing is served; the page is written there, for any static host."""
    bench: Flag = False
    """Write no pictures; say how long one takes (--workers: 1 if left out)."""
    verify: Flag = False
    """Write no pictures; draw the package's golden frames and compare them with the stored ones.
    Exit code 2 if they differ."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """With --bench or --verify: write the figures to this file too."""
    overwrite: Flag = False
    """Replace the file that --out or --json names, if there is one. Without it a file is replaced
    only in a run's folder, and only if it is one of ours."""

    def validate(self) -> None:
        """Whether the wishes fit together.

        Raises:
            InputError: If they do not, or a number cannot be.
        """
        self._validate_mode()
        if self.json is not None and not (self.bench or self.verify):
            raise InputError("--json writes the figures of --bench or --verify; give one of them.")
        if self.json is not None:
            check_output_file(self.json, "--json", self.inputs, overwrite=self.overwrite)
        if self.fps is not None and not 0.1 <= self.fps <= 240.0:
            raise InputError(f"--fps is {self.fps}; 0.1 to 240 pictures a second were expected.")
        if not 0.01 <= self.speed <= 100.0:
            raise InputError(f"--speed is {self.speed}; 0.01 to 100 times were expected.")
        if self.workers is not None and not 1 <= self.workers <= MAX_WORKERS:
            raise InputError(f"--workers is {self.workers}; 1 to {MAX_WORKERS} were expected.")
        if self.still is not None and self.poses is None:
            raise InputError("--still takes a pose of --poses; give both.")
        if self.camera is not None and self.viewpoint != Viewpoint():
            raise InputError(
                "--camera says where the camera stands: leave out --orbit, --elevation, "
                "--distance, --zoom, --close-up and --turntable, or leave out --camera."
            )
        self.size_px  # noqa: B018 - raises
        self.viewpoint  # noqa: B018 - raises

    def _validate_mode(self) -> None:
        """Refuses what would not be listened to."""
        given = {f.name for f in fields(self) if getattr(self, f.name) != f.default}
        for mode, (does, heard) in MODES.items():
            unheard = given - heard - {"avatar", mode}
            if mode in given and unheard:
                flag = min(unheard).replace("_", "-")
                raise InputError(f"--{mode} {does}: leave out --{flag}, or --{mode}.")

    @property
    def size_px(self) -> tuple[int, int] | int | None:
        """Width and height; one number for a square or a longer side; None if it is left open."""
        if self.size is None:
            return None
        found = re.fullmatch(r"(\d+)(?:[x×,](\d+))?", self.size.strip().lower())
        sides = [int(side) for side in found.groups() if side] if found else []
        if not sides or not all(MIN_SIZE_PX <= side <= MAX_SIZE_PX for side in sides):
            raise InputError(
                f"--size is {self.size}; {MIN_SIZE_PX} to {MAX_SIZE_PX} pixels can be drawn, as in "
                "540 or 1280x720."
            )
        return sides[0] if len(sides) == 1 else (sides[0], sides[1])

    @property
    def viewpoint(self) -> Viewpoint:
        """Where the camera stands."""
        usual = 1.0 if self.close_up is None else CLOSE_UP_ZOOM
        return Viewpoint(
            orbit_deg=self.orbit,
            elevation_deg=self.elevation,
            zoom=usual if self.zoom is None else self.zoom,
            distance_m=self.distance,
            joint=self.close_up,
            turn_period_s=self.turntable,
        )

    @property
    def inputs(self) -> list[Path]:
        """What is read and must not be written to."""
        given = [self.avatar, self.poses, self.camera]
        if self.background is not None and Path(self.background).is_file():
            given.append(Path(self.background))
        return [path for path in given if path is not None]

    @property
    def worker_count(self) -> int:
        """How many pictures are drawn at the same time."""
        if self.workers is not None:
            return self.workers
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        return min(cores or 1, MAX_WORKERS)

    @property
    def output_path(self) -> Path:
        """Where the pictures go."""
        if self.out is not None:
            return self.out
        stem = self.avatar.stem if self.poses is None else self.poses.stem
        one = self.still is not None and self.turntable is None
        return self.avatar.parent / (f"{stem}-{self.still}.png" if one else f"{stem}.webm")


ALL_ARGUMENTS = frozenset(field.name for field in fields(PlayArguments))
MODES = {
    "verify": (
        "draws the golden frames as they were drawn",
        frozenset({"provider", "json", "overwrite"}),
    ),
    "web": (
        "shows a page that has a camera, a size and a choice of tiers of its own",
        frozenset({"poses", "person", "out", "fps", "speed"}),
    ),
    "bench": ("writes no pictures", ALL_ARGUMENTS - {"out", "background"}),
}
"""What is done instead of a clip, and which arguments it listens to."""
