"""ia-play: render an avatar in any motion, as a clip or a web page; benchmark and verify it."""

import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from capture.atomic_files import write_text_atomically
from capture.input_error import InputError, counted
from instant_avatar.animation.play_arguments import DEFAULT_TURN_S, WEB_PORT, PlayArguments
from instant_avatar.cli.command_line import (
    BAD_INPUT,
    DONE,
    INTERRUPTED,
    fill_optional_value,
    run_main,
    stop_on_interrupt,
)
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import check_output_folder

if TYPE_CHECKING:  # onnxruntime is loaded after --help has been answered
    from export.player import Player
    from instant_avatar.animation.clip_file import Shot


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    words = fill_optional_value(sys.argv[1:] if argv is None else argv, "--web", WEB_PORT)
    words = fill_optional_value(words, "--turntable", DEFAULT_TURN_S)
    return run_main("ia-play", PlayArguments, play, words)


def play(arguments: PlayArguments, console: Console) -> int:
    """Render a clip, serve or write a page, benchmark, or verify."""
    arguments.validate()
    if arguments.verify:
        return _run_verification(arguments, console)
    if arguments.web is not None:
        return _run_web(arguments, arguments.web, console)
    run = _run_benchmark if arguments.bench else _render_clip
    return run(arguments, console)


def _render_clip(arguments: PlayArguments, console: Console) -> int:
    from instant_avatar.animation.clip_file import (
        MAX_GIF_FPS,
        TRANSPARENT,
        background_compositor,
        check_clip_path,
        clip_format,
        plan_render,
        write_clip,
    )

    player, out = _load_player(arguments, console), arguments.output_path
    suffix = out.suffix.lower()
    check_clip_path(out, arguments.inputs, overwrite=arguments.overwrite)
    usual = TRANSPARENT if suffix in ("", ".png") else "white"
    background = usual if arguments.background is None else arguments.background
    blend = None if background == TRANSPARENT else background_compositor(background or "white")
    description = clip_format(out, transparent=blend is None).description
    shots, fps = plan_render(
        arguments, player, console, max_fps=MAX_GIF_FPS if suffix == ".gif" else np.inf
    )
    if arguments.fps is not None and fps < arguments.fps:
        console.info(f"note: GIF output is limited to {MAX_GIF_FPS:g} fps.")
    total = len(shots)
    with (
        stop_on_interrupt(console, "keeping the frames rendered by now") as stop,
        console.progress(f"rendering {out.name}", float(total)) as bar,
    ):

        def pictures() -> Iterator[np.ndarray]:
            drawn = player.render_all(shots, workers=arguments.worker_count)
            for done, picture in enumerate(drawn):
                bar.update(float(done), f"{done}/{total} frames")
                yield picture
                if stop.is_set():
                    drawn.close()
                    return

        count = write_clip(out, pictures(), fps=fps, blend=blend, replace=arguments.overwrite)
    console.info(f"Rendered {_describe_clip(shots, count, fps)}; {description}:")
    print(out)  # noqa: T201 - paths go to stdout, for scripts
    return DONE if count == total else INTERRUPTED


def _describe_clip(shots: "list[Shot]", count: int, fps: float) -> str:
    """Return how many frames were rendered, their size, and their rate if there are several."""
    width, height = shots[0][1].size_px
    cut = f" of {len(shots)}" if count < len(shots) else ""
    frames = "1 frame" if len(shots) == 1 else f"{count}{cut} frames"
    rate = f" at {fps:.4g} fps" if count > 1 else ""
    return f"{frames} of {width}x{height} px{rate}"


def _load_player(arguments: PlayArguments, console: Console) -> "Player":
    """Open the package, and print the weaknesses that it was written with."""
    from export.player import Player
    from instant_avatar.animation.player_checks import package_warnings

    player = Player.load(arguments.avatar, tier=arguments.tier, provider=arguments.provider)
    for note in package_warnings(player.manifest):
        console.warning(note)
    return player


def _run_benchmark(arguments: PlayArguments, console: Console) -> int:
    from instant_avatar.animation.clip_file import plan_render
    from instant_avatar.animation.player_checks import benchmark_player

    started = time.perf_counter()
    player = _load_player(arguments, console)
    load_ms = 1000.0 * (time.perf_counter() - started)
    shots, _ = plan_render(arguments, player, console)
    result = benchmark_player(
        player, shots, load_ms=load_ms, tier=arguments.tier, workers=arguments.workers or 1
    )
    if arguments.json is not None:
        write_text_atomically(arguments.json, result.to_json(), replace=arguments.overwrite)
    console.info(
        f"{result.cpu_ms_per_frame:.1f} CPU-ms per {result.size} px frame, "
        f"{result.pictures_per_second:.1f} frames/s with --workers {result.workers} "
        f"({counted(result.frames, 'frame')}, {result.pixels_covered:.0%} covered, "
        f"{result.provider}); loaded in {result.load_ms:.0f} ms; reference "
        f"graph {result.reference_ms:.1f} ms"
    )
    return DONE


def _run_web(arguments: PlayArguments, port: int, console: Console) -> int:
    from export.player_page import build_page, encode_motion, runtime_files
    from instant_avatar.animation.driving_motion import load_driving_motion, pose_rate
    from instant_avatar.animation.web_server import sample_motions, serve_site, write_site

    if not 0 < port < 1 << 16:
        raise InputError(f"--web is {port}, but must be a port from 1 to 65535.")
    runtime_files()
    if arguments.out is not None:
        check_output_folder(arguments.out, "--out", arguments.inputs)
    joints, motions = _load_player(arguments, console).manifest.rest_joints, sample_motions()
    if arguments.poses is not None:
        given = load_driving_motion(arguments.poses, joints, console, person=arguments.person)
        motions = {"Given": given, **motions}
    encoded = {
        motion_name: encode_motion(motion, arguments.fps or arguments.speed * pose_rate(motion))
        for motion_name, motion in motions.items()
    }
    path = arguments.avatar.resolve()
    name = path.parent.name if arguments.avatar.stem == "avatar" else arguments.avatar.stem
    with console.status("packing the page"):
        level = 1 if arguments.out is None else 6
        files = build_page(arguments.avatar, encoded, name=name, compression_level=level)
    if arguments.out is None:
        serve_site(files, port, console)
        return DONE
    write_site(files, arguments.out)
    megabytes = sum(map(len, files.values())) / 1e6
    console.info(f"Wrote {len(files)} files, {megabytes:.1f} MB, for any static host:")
    print(arguments.out)  # noqa: T201 - paths go to stdout, for scripts
    return DONE


def _run_verification(arguments: PlayArguments, console: Console) -> int:
    from instant_avatar.animation.player_checks import to_json_text, verdict_lines, verify_package

    result = verify_package(arguments.avatar, provider=arguments.provider)
    if arguments.json is not None:
        write_text_atomically(arguments.json, to_json_text(result), replace=arguments.overwrite)
    for note in result["warnings"]:
        console.warning(note)
    for line in verdict_lines(result):
        console.info(line)
    return DONE if result["verdict"] == "same" else BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
