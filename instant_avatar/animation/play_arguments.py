"""Arguments of ia-play; the text under each field is its --help. Viewpoint of its camera."""

import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from tyro.conf import Positional, arg

from capture.hardware import usable_cores
from capture.input_error import InputError
from instant_avatar.cli.shared_options import (
    Flag,
    OptionalCount,
    OptionalFile,
    OptionalId,
    check_output_file,
)
from preprocess.body.kinematics import JOINT_NAMES, rotation_matrices

WEB_PORT = 8010
"""Port of --web where it names none."""
DEFAULT_TURN_S = 6.0
"""Seconds per turn of --turntable where it names none."""
DEFAULT_SIZE_PX = 540
"""Width and height without --size and --camera."""
MIN_SIZE_PX, MAX_SIZE_PX = 16, 4096
"""Limits of --size, pixels."""
MAX_WORKERS = 64
"""Limit of --workers."""
CLOSE_UP_ZOOM = 3.5
"""Magnification of --close-up relative to a view of the whole person."""


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Position of the camera relative to the person, who faces it at 0°.

    Attributes:
        orbit_deg: Azimuth around the person; 90° is at the person's left hand.
        elevation_deg: Elevation above the person's center; 90° looks straight down.
        joint: Target of a close-up (see `JOINT_NAMES`); None for the whole person.
        turn_period_s: Seconds per turn around the person; negative for the other direction, None
            for no turntable.
    """

    orbit_deg: float = 0.0
    elevation_deg: float = 0.0
    joint: str | None = None
    turn_period_s: float | None = None

    def __post_init__(self) -> None:
        """Check ranges."""
        if not np.isfinite(self.orbit_deg):
            raise InputError(f"--orbit is {self.orbit_deg}, but must be an angle in degrees.")
        if not -90.0 <= self.elevation_deg <= 90.0:
            raise InputError(
                f"--elevation is {self.elevation_deg:g}, but must lie between -90 (from below) and "
                "90 degrees (from above)."
            )
        if self.joint is not None and self.joint not in JOINT_NAMES:
            raise InputError(
                f"--close-up is {self.joint}, but must be one of {', '.join(JOINT_NAMES)}."
            )
        if self.turn_period_s is not None and not 0.1 <= abs(self.turn_period_s) <= 3600.0:
            raise InputError(
                f"--turntable is {self.turn_period_s:g}, but must lie between 0.1 and 3600 seconds "
                "(negative reverses)."
            )

    def rotation_at(self, seconds: float) -> Float[np.ndarray, "3 3"]:
        """Return the rotation from a level camera in front of the person to this viewpoint."""
        turns = 0.0 if self.turn_period_s is None else seconds / self.turn_period_s
        round_it = np.array([0.0, np.deg2rad(self.orbit_deg) + 2.0 * np.pi * turns, 0.0])
        above = np.array([np.deg2rad(self.elevation_deg), 0.0, 0.0])
        return rotation_matrices(above) @ rotation_matrices(round_it)


@dataclass(frozen=True, kw_only=True)
class PlayArguments:
    """Animate an avatar: a package written by ia-ingest, and poses from any source.

    Try it:

        ia-play run/avatar.iavatar                 the built-in motion
        ia-play run/avatar.iavatar --web           in a browser
        ia-play run/avatar.iavatar --verify        check rendering here
        ia-play run/avatar.iavatar --still 12 --close-up head --out face.png
        ia-play run/avatar.iavatar --turntable --background transparent
        ia-play run/avatar.iavatar --poses dance.npz --out dance.mp4
        ia-play run/avatar.iavatar --poses amass.npz --orbit 40 --size 1280x720
        ia-play run/avatar.iavatar --poses walk.bvh

    Needs no GPU and no torch. Without --camera the camera stands in front of the first pose,
    follows the pelvis and shows the standing person at 80 % of the image height.

    Exit codes: 0 done, 2 bad input, 3 disk full, 130 Ctrl-C (frames rendered by then are kept).
    Outputs are written whole or not at all.
    """

    avatar: Annotated[Positional[Path], arg(metavar="AVATAR")]
    """The .iavatar package."""
    poses: OptionalFile = None
    """Poses: an .npz with global_orient, body_pose, transl (or poses, trans), a motion of a
    skeleton (.bvh, .glb, .vrma), or a file of AMASS, AIST++ or a tracker (docs/formats.md;
    default: a turn, a wave, a few steps)."""
    person: OptionalId = None
    """Person ID in the pose file (default: the longest track)."""
    still: Annotated[int | None, arg(metavar="ROW", help_behavior_hint="")] = None
    """Hold this pose of the motion (0 is the first): one image, or a turntable."""
    out: Annotated[Path | None, arg(metavar="FILE|DIR", help_behavior_hint="")] = None
    """Clip (.mp4, .webm), animation (.gif, .webp) or image (.png) to write, or a folder for RGBA
    frames 0000.png … (default: an .mp4 next to the package, named after the poses). With --web: a
    folder for the page."""
    size: Annotated[str | None, arg(metavar="PX|WxH", help_behavior_hint="")] = None
    """Size in pixels: one number for a square or for the longer side of --camera's images, or width
    and height as in 1280x720 (default: 540, or the size in --camera)."""
    fps: Annotated[float | None, arg(metavar="F", help_behavior_hint="")] = None
    """Frames per second (default: rate of the poses, at most 60). The motion keeps its speed."""
    speed: Annotated[float, arg(metavar="X", help_behavior_hint="")] = 1.0
    """Factor on the speed of the motion; 0.25 is slow motion."""
    background: Annotated[str | None, arg(metavar="COLOR|FILE", help_behavior_hint="")] = None
    """A color (white, #203040), an image (cropped to the size), or `transparent` (default: white
    for clips, transparent for .png and frames)."""
    camera: OptionalFile = None
    """Cameras to render, as in ia-ingest: one, or one per pose."""
    orbit: Annotated[float, arg(metavar="DEG", help_behavior_hint="")] = 0.0
    """Azimuth of the camera around the person: 90 is at its left hand, 180 behind it."""
    elevation: Annotated[float, arg(metavar="DEG", help_behavior_hint="")] = 0.0
    """Elevation of the camera: 30 looks down on the person, -30 up."""
    close_up: Annotated[str | None, arg(metavar="JOINT", help_behavior_hint="")] = None
    """Follow a joint, 3.5 times as large: head, spine3, left_hand, right_foot, …"""
    turntable: Annotated[float | None, arg(metavar="[SECONDS]", help_behavior_hint="")] = None
    """Orbit the camera once in SECONDS (default 6; negative reverses): around the canonical pose,
    or around the motion while it plays."""
    tier: Literal["hq", "lite"] = "hq"
    """Quality tier: lite takes two thirds of the time of hq."""
    workers: OptionalCount = None
    """Frames rendered in parallel (default: one per core). They do not depend on it."""
    provider: Annotated[str, arg(metavar="NAME", help_behavior_hint="")] = "cpu"
    """Execution provider of onnxruntime (cpu, cuda, …), if installed."""
    web: Annotated[int | None, arg(metavar="[PORT]", help_behavior_hint="")] = None
    """Play in a browser at http://127.0.0.1:PORT (default 8010): orbit, pause, seek. With --out
    FOLDER the page is written there for any static host, and nothing is served."""
    bench: Flag = False
    """Measure the rendering time per image; write no images (--workers defaults to 1)."""
    verify: Flag = False
    """Render the package's golden frames and compare them with the stored ones; write no images.
    Exit code 2 if they differ."""
    json: OptionalFile = None
    """Also write the results of --bench or --verify to this file."""
    overwrite: Flag = False
    """Replace the file that --out or --json names, if it exists. Without this flag a file is
    replaced only in a run's folder, and only if ia-play wrote it."""

    def validate(self) -> None:
        """Check ranges, combinations and output files."""
        self._validate_mode()
        if self.json is not None and not (self.bench or self.verify):
            raise InputError("--json requires --bench or --verify.")
        if self.json is not None:
            check_output_file(self.json, "--json", self.inputs, overwrite=self.overwrite)
        limits = {"fps": (0.1, 240), "speed": (0.01, 100), "workers": (1, MAX_WORKERS)}
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise InputError(f"--{name} is {value}, but must lie between {low} and {high}.")
        if self.camera is not None and self.viewpoint != Viewpoint():
            raise InputError(
                "--camera sets the viewpoint: leave out --orbit, --elevation, --close-up and "
                "--turntable, or leave out --camera."
            )
        self.size_px  # noqa: B018 - raises
        self.viewpoint  # noqa: B018 - raises

    def _validate_mode(self) -> None:
        """Refuse arguments that the mode would ignore."""
        given = {f.name for f in fields(self) if getattr(self, f.name) != f.default}
        for mode, (does, used) in MODES.items():
            ignored = given - used - {"avatar", mode}
            if mode in given and ignored:
                flag = min(ignored).replace("_", "-")
                raise InputError(f"--{mode} {does}: leave out --{flag}, or --{mode}.")

    @property
    def size_px(self) -> tuple[int, int] | int | None:
        """Width and height; one number for a square or a longer side; None without --size."""
        if self.size is None:
            return None
        found = re.fullmatch(r"(\d+)(?:[x×,](\d+))?", self.size.strip().lower())
        sides = [int(side) for side in found.groups() if side] if found else []
        if not sides or not all(MIN_SIZE_PX <= side <= MAX_SIZE_PX for side in sides):
            raise InputError(
                f"--size is {self.size}, but must lie between {MIN_SIZE_PX} and {MAX_SIZE_PX} "
                "pixels, as in 540 or 1280x720."
            )
        return sides[0] if len(sides) == 1 else (sides[0], sides[1])

    @property
    def viewpoint(self) -> Viewpoint:
        """Viewpoint of the camera."""
        return Viewpoint(
            orbit_deg=self.orbit,
            elevation_deg=self.elevation,
            joint=self.close_up,
            turn_period_s=self.turntable,
        )

    @property
    def inputs(self) -> list[Path]:
        """Files that are read and must not be written to."""
        given = [self.avatar, self.poses, self.camera]
        if self.background is not None and Path(self.background).is_file():
            given.append(Path(self.background))
        return [path for path in given if path is not None]

    @property
    def worker_count(self) -> int:
        """Number of frames rendered in parallel."""
        return self.workers or min(usable_cores(), MAX_WORKERS)

    @property
    def output_path(self) -> Path:
        """Path of the clip."""
        if self.out is not None:
            return self.out
        stem = self.avatar.stem if self.poses is None else self.poses.stem
        if self.still is not None and self.turntable is None:
            return self.avatar.parent / f"{stem}-{self.still}.png"
        is_clear = self.background == "transparent"
        return self.avatar.parent / f"{stem}.{'webm' if is_clear else 'mp4'}"


MODES = {
    "verify": ("renders the golden frames as stored", frozenset({"provider", "json", "overwrite"})),
    "web": (
        "shows a page with its own camera, size and choice of tiers",
        frozenset({"poses", "person", "out", "fps", "speed"}),
    ),
    "bench": (
        "writes no pictures",
        frozenset(f.name for f in fields(PlayArguments) if f.name not in ("out", "background")),
    ),
}
"""For each mode other than rendering a clip: what it does, and the arguments it uses."""
