"""ia-play: an avatar in poses it was never filmed in, as a clip, a web page, or figures."""

import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from apps.playing.arguments import TURN_S, WEB_PORT, PlayArguments
from apps.terminal.command_line import parsed
from apps.terminal.console import Console
from apps.terminal.exit_codes import BAD_INPUT, DONE, INTERRUPTED, exit_code
from apps.terminal.port import with_port, with_value
from capture.errors import BadInput

if TYPE_CHECKING:  # onnxruntime is loaded after --help has been answered
    from export.player import Player


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    words = with_port(sys.argv[1:] if arguments is None else arguments, "--web", WEB_PORT)
    words = with_value(words, "--turntable", TURN_S)
    given = parsed(PlayArguments, "ia-play", words)
    return exit_code("ia-play", lambda: play(given, Console()))


def play(given: PlayArguments, console: Console) -> int:
    """Does what the arguments say.

    Raises:
        BadInput: If something is missing, unreadable or does not fit together.
        OSError: If the disk is full.
    """
    given.check()
    if given.verify:
        return _verify(given, console)
    if given.web is not None:
        return _web(given, given.web, console)
    return _bench(given, console) if given.bench else _clip(given, console)


def _clip(given: PlayArguments, console: Console) -> int:
    from apps.playing.background import TRANSPARENT, background
    from apps.playing.clip import GIF_FPS, check_clip, encoder_of, write_clip
    from apps.playing.shots import shots_of
    from apps.terminal.interrupt import asked_to_stop
    from export.player import Player

    out = given.clip
    suffix = out.suffix.lower()
    check_clip(out, given.inputs, overwrite=given.overwrite)
    clear = suffix in ("", ".png") if given.background is None else given.background == TRANSPARENT
    blend = None if clear else background(given.background or "white")
    encoder = encoder_of(out, blend)
    player = Player.load(given.avatar, tier=given.tier, provider=given.provider)
    _warn(player, console)
    shots = shots_of(given, player, console, most_fps=GIF_FPS if suffix == ".gif" else np.inf)
    if given.fps is not None and shots.fps < given.fps:
        console.say(f"note: a GIF shows {GIF_FPS:g} pictures a second at most.")
    total = len(shots)
    with (
        asked_to_stop(console, "the pictures drawn so far are being kept") as stop,
        console.bar(f"drawing {out.name}", float(total)) as bar,
    ):

        def pictures() -> Iterator[np.ndarray]:
            drawn = player.render_all(shots, workers=given.threads, samples=given.samples)
            for done, picture in enumerate(drawn):
                bar.move(float(done), f"{done}/{total} pictures")
                yield picture
                if stop.is_set():
                    drawn.close()
                    return

        count = write_clip(
            out, pictures(), fps=shots.fps, blend=blend, encoder=encoder, replace=given.overwrite
        )
    width, height = shots.cameras[0].size_px
    pace = f" at {shots.fps:.4g} a second" if count > 1 else ""
    what = "a picture" if count == 1 else f"{count} pictures"
    cut = f" of {total}" if count < total else ""
    console.say(f"Drew {what}{cut} of {width}x{height} px{pace}; {encoder.said}:")
    print(out)  # noqa: T201 - what was made goes to stdout, for scripts
    return DONE if count == total else INTERRUPTED


def _warn(player: "Player", console: Console) -> None:
    from apps.playing.verdict import package_notes

    for note in package_notes(player.manifest):
        console.warn(note)


def _bench(given: PlayArguments, console: Console) -> int:
    from apps.playing.bench import benchmark
    from apps.playing.shots import shots_of
    from capture.atomic_files import write_text
    from export.player import Player

    started = time.perf_counter()
    player = Player.load(given.avatar, tier=given.tier, provider=given.provider)
    load_ms = 1000.0 * (time.perf_counter() - started)
    shots = list(shots_of(given, player, console))
    result = benchmark(
        player,
        shots,
        load_ms=load_ms,
        tier=given.tier,
        workers=given.workers or 1,
        samples=given.samples,
    )
    if given.json is not None:
        write_text(given.json, result.to_json(), replace=given.overwrite)
    console.say(
        f"{result.cpu_ms_per_frame:.1f} CPU-ms a picture of {result.size} px, "
        f"{result.pictures_per_second:.1f} pictures a second with {_counted(result.workers)} "
        f"({result.frames} pictures, {result.pixels_covered:.0%} covered, {result.provider}); "
        f"loaded in {result.load_ms:.0f} ms; reference graph {result.reference_ms:.1f} ms"
    )
    return DONE


def _counted(workers: int) -> str:
    return "one worker" if workers == 1 else f"{workers} workers"


def _web(given: PlayArguments, port: int, console: Console) -> int:
    from apps.playing.driving import driving_motion
    from apps.playing.novel import novel_motion
    from apps.playing.rate import poses_a_second
    from apps.playing.web import clip_of, serve, write_site
    from apps.terminal.places import check_folder_place
    from export.player import Player
    from export.web.runtime import runtime_files
    from export.web.site import site

    if not 0 < port < 1 << 16:
        raise BadInput(f"--web {port} is no port; 1 to 65535 were expected.")
    runtime_files()
    if given.out is not None:
        check_folder_place(given.out, "--out", given.inputs)
    player = Player.load(given.avatar)
    _warn(player, console)
    joints, motion = player.manifest.rest_joints, novel_motion()
    if given.poses is not None:
        motion = driving_motion(given.poses, joints, console, person=given.person)
    rows = tuple(int(row) for row in np.flatnonzero(motion.valid))
    clip = clip_of(player, motion, rows, given.fps or given.speed * poses_a_second(motion))
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


def _verify(given: PlayArguments, console: Console) -> int:
    from apps.playing.verdict import verdict_of
    from capture.atomic_files import write_text

    verdict = verdict_of(given.avatar, provider=given.provider)
    if given.json is not None:
        write_text(given.json, verdict.to_json(), replace=given.overwrite)
    for line in verdict.lines():
        console.say(line)
    return DONE if verdict.same else BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
