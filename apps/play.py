"""ia-play: an avatar in poses it was never filmed in, as a clip, a web page, or figures."""

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg

from apps.console import Console
from apps.exit_codes import BAD_INPUT, DONE, exit_code
from apps.port import with_port
from apps.rate import poses_a_second
from capture.camera import Camera
from capture.errors import BadInput
from preprocess.pose import BodyPose, Motion

if TYPE_CHECKING:
    from export.player import Player  # onnxruntime is loaded after --help has been answered

WEB_PORT = 8010
Flag = Annotated[bool, FlagCreatePairsOff, arg(help_behavior_hint="")]


@dataclass(frozen=True, kw_only=True)
class PlayArguments:
    """Moves an avatar: a package that ia-ingest wrote, and poses from anywhere.

    Try it:

        ia-play run/avatar.iavatar --poses capture/dance.npz --out dance.webm

    Needs no GPU and no torch. Without --camera the camera stands before the first pose, follows
    the pelvis and shows the standing person at 80 % of the picture's height.

    Exit codes: 0 done, 2 bad input, 3 disk full, 130 Ctrl-C. What is written is written whole or
    not at all.
    """

    avatar: Positional[Path]
    """The .iavatar package."""
    poses: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Poses to move it through: an .npz with global_orient, body_pose, transl (or poses, trans), or
    a file of AMASS, AIST++ or any tracker (docs/formats.md)."""
    person: Annotated[str | None, arg(metavar="ID", help_behavior_hint="")] = None
    """Whose poses, where the file holds several people's; without it whoever has most."""
    camera: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Cameras to look through, as ia-ingest takes them: one, or one for each pose."""
    out: Annotated[Path | None, arg(metavar="FILE|DIR", help_behavior_hint="")] = None
    """Clip to write (.webm, .mp4, .gif), or a folder for RGBA frames 0000.png …; without it a
    .webm beside the package, named after the poses. With --web: a folder for the page."""
    size: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Longer side in pixels; without it 540, or what --camera says."""
    fps: Annotated[float | None, arg(metavar="F", help_behavior_hint="")] = None
    """Pictures a second; without it what the poses say, else 30."""
    tier: Literal["hq", "lite"] = "hq"
    """Quality: lite takes three quarters of the time."""
    background: str = "white"
    """Of clips: a colour (white, #203040) or a picture. Frames keep their alpha."""
    web: Annotated[int | None, arg(metavar="[PORT]", help_behavior_hint="")] = None
    """Play it in a browser, http://127.0.0.1:PORT (8010 if PORT is left out): turn it, pause, seek.
    With --out FOLDER nothing is served; the page is written there, for any static host."""
    bench: Flag = False
    """Write no pictures; say how long one takes. Without --poses it moves through a turn."""
    verify: Flag = False
    """Write no pictures; draw the package's golden frames and compare them with the stored ones."""
    json: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """With --bench: write the figures to this file too."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Shots:
    """What is drawn: valid poses, each with the camera that sees it."""

    motion: Motion
    rows: tuple[int, ...]
    cameras: tuple[Camera, ...]

    def __iter__(self) -> Iterator[tuple[BodyPose, Camera]]:
        """Pose and camera, in order."""
        return zip((self.motion[row] for row in self.rows), self.cameras, strict=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    words = with_port(sys.argv[1:] if arguments is None else arguments, "--web", WEB_PORT)
    given = tyro.cli(PlayArguments, prog="ia-play", args=words)
    return exit_code("ia-play", lambda: play(given, Console()))


def play(given: PlayArguments, console: Console) -> int:
    """Does what the arguments say.

    Raises:
        BadInput: If something is missing, unreadable or does not fit together.
        OSError: If the disk is full.
    """
    if given.verify:
        return _verify(given.avatar, console)
    if given.json is not None and not given.bench:
        raise BadInput("--json writes the figures of --bench; give both.")
    if given.size is not None and not 16 <= given.size <= 4096:
        raise BadInput(f"--size is {given.size}; 16 to 4096 pixels can be drawn.")
    if given.fps is not None and not 0.1 <= given.fps <= 240.0:
        raise BadInput(f"--fps is {given.fps}; 0.1 to 240 pictures a second were expected.")
    if given.web is not None:
        return _web(given, given.web, console)
    return _bench(given, console) if given.bench else _clip(given, console)


def _clip(given: PlayArguments, console: Console) -> int:
    from apps.background import background
    from apps.clip import check_clip, write_clip
    from export.player import Player

    if given.poses is None:
        raise BadInput("No poses: give --poses FILE, an .npz with the motion to play.")
    out = given.out or given.avatar.parent / f"{given.poses.stem}.webm"
    check_clip(out)
    blend = background(given.background)
    player = Player.load(given.avatar, tier=given.tier)
    shots = _shots(given, player, console)
    fps = given.fps or poses_a_second(shots.motion)
    with console.bar(f"drawing {out.name}", float(len(shots.rows))) as bar:

        def pictures() -> Iterator[np.ndarray]:
            for done, (pose, camera) in enumerate(shots):
                bar.move(float(done), f"{done}/{len(shots.rows)} pictures")
                yield player.render(pose, camera)

        count = write_clip(out, pictures(), fps=fps, blend=blend)
    if out.suffix.lower() == ".mp4":
        console.say("note: this .mp4 is MPEG-4 part 2, which browsers do not play; .webm they do.")
    console.say(f"Drew {count} pictures at {fps:g} a second:")
    print(out)  # noqa: T201 - what was made goes to stdout, for scripts
    return DONE


def _bench(given: PlayArguments, console: Console) -> int:
    from apps.bench import benchmark
    from apps.whole import write_text
    from export.player import Player

    started = time.perf_counter()
    player = Player.load(given.avatar, tier=given.tier)
    load_ms = 1000.0 * (time.perf_counter() - started)
    shots = list(_shots(given, player, console))
    result = benchmark(player, shots, load_ms=load_ms, tier=given.tier)
    if given.json is not None:
        write_text(given.json, result.to_json())
    console.say(
        f"{result.cpu_ms_per_frame:.1f} CPU-ms a picture of {result.size} px "
        f"({result.wall_ms_per_frame:.1f} ms wall, {result.frames} pictures, "
        f"{result.pixels_covered:.0%} covered); loaded in {result.load_ms:.0f} ms; "
        f"reference graph {result.reference_ms:.1f} ms"
    )
    return DONE


def _web(given: PlayArguments, port: int, console: Console) -> int:
    from apps.web import check_folder, clip_of, serve, write_site
    from export.player import Player
    from export.web.runtime import runtime_files
    from export.web.site import site

    if given.camera is not None or given.bench:
        raise BadInput("--web has a camera of its own: leave out --camera and --bench.")
    if not 0 < port < 1 << 16:
        raise BadInput(f"--web {port} is no port; 1 to 65535 were expected.")
    runtime_files()
    if given.out is not None:
        check_folder(given.out)
    player = Player.load(given.avatar)
    shots = _shots(given, player, console)
    clip = clip_of(player, shots.motion, shots.rows, given.fps or poses_a_second(shots.motion))
    name = (
        given.avatar.resolve().parent.name if given.avatar.stem == "avatar" else given.avatar.stem
    )
    with console.waiting("unpacking the avatar for the page"):
        files = site(given.avatar, clip, name=name, level=1 if given.out is None else 6)
    if given.out is None:
        serve(files, port, console)
        return DONE
    write_site(files, given.out)
    megabytes = sum(map(len, files.values())) / 1e6
    console.say(f"Wrote {len(files)} files, {megabytes:.1f} MB; any static host serves them:")
    print(given.out)  # noqa: T201 - what was made goes to stdout, for scripts
    return DONE


def _verify(path: Path, console: Console) -> int:
    from export.player import verify

    bad = 0
    for number, likeness in enumerate(verify(path)):
        bad += not likeness.alike
        console.say(
            f"golden frame {number}: {'same' if likeness.alike else 'DIFFERENT'} "
            f"({likeness.close:.2%} within 2/255, largest difference {likeness.largest:.0f}/255)"
        )
    if bad:
        console.say(
            f"{bad} golden frames look different here than where the package was written; "
            "update onnxruntime, or report it with its version."
        )
    return BAD_INPUT if bad else DONE


def _shots(given: PlayArguments, player: "Player", console: Console) -> Shots:
    from apps.follow import FollowingCamera
    from apps.novel import novel_motion
    from preprocess.poses import read_poses
    from preprocess.poses.place import about_pelvis

    if given.poses is None:
        motion = novel_motion()
    else:
        motion = read_poses(given.poses, person=given.person, driving=True)
        motion = about_pelvis(motion, player.manifest.rest_joints)
        if motion.note is not None:
            console.say(f"note: {motion.note}")
    rows = tuple(int(row) for row in np.flatnonzero(motion.valid))
    if not rows:
        raise BadInput(f"None of the {len(motion)} poses in {given.poses} is valid.")
    if len(rows) < len(motion):
        console.warn(f"{len(motion) - len(rows)} of {len(motion)} poses are not valid; left out.")
    if given.camera is not None:
        cameras = _cameras_from(given.camera, len(motion), rows, given.size)
    else:
        following = FollowingCamera.of(player, motion, given.size or 540)
        cameras = tuple(following.at(motion[row]) for row in rows)
    return Shots(motion=motion, rows=rows, cameras=cameras)


def _cameras_from(
    path: Path, poses: int, rows: tuple[int, ...], size: int | None
) -> tuple[Camera, ...]:
    from preprocess.camera_file import read_cameras

    track = read_cameras(path, _picture_size(path))
    if track.moves and len(track.cameras) != poses:
        raise BadInput(
            f"{path} holds {len(track.cameras)} cameras for {poses} poses; expected one, or one "
            "for each pose."
        )
    return tuple(_fitted(track[row], size) for row in rows)


def _picture_size(path: Path) -> tuple[int, int]:
    """Width and height that a camera file belongs to; twice its principal point if it is silent."""
    from preprocess.cameras.door import read_named
    from preprocess.npz import read_npz

    if path.suffix != ".npz":
        return read_named(path)[0].camera.size_px

    arrays = read_npz(path, ("width", "height", "intrinsic"))
    if {"width", "height"} <= arrays.keys():
        width, height = (float(arrays[key].reshape(-1)[0]) for key in ("width", "height"))
    elif "intrinsic" in arrays and arrays["intrinsic"].shape[-2:] == (3, 3):
        width, height = (2.0 * float(c) for c in arrays["intrinsic"].reshape(-1, 3, 3)[0, :2, 2])
    else:
        raise BadInput(f"{path} holds no camera: expected intrinsic (3, 3), height and width.")
    if not (1.0 <= width <= 16384.0 and 1.0 <= height <= 16384.0):
        raise BadInput(f"{path} belongs to pictures of {width:.0f}x{height:.0f} px; up to 16384.")
    return round(width), round(height)


def _fitted(camera: Camera, size: int | None) -> Camera:
    """The camera as a pinhole whose longer side is `size`."""
    width, height = camera.size_px
    scale = (size or max(width, height)) / max(width, height)
    pinhole = replace(camera, distortion=())
    return pinhole.resized((max(1, round(width * scale)), max(1, round(height * scale))))


if __name__ == "__main__":
    sys.exit(main())
