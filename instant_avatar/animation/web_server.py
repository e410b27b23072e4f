"""ia-play --web: the player page, served on the loopback address or written as a folder.

It offers short motions, each a loop on the spot.

Run as a module (`make web`), it fetches onnxruntime-web with npm, which the page needs.
"""

import errno
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline

from capture.atomic_files import atomic_folder
from capture.input_error import InputError
from capture.source import ASSUMED_FPS
from export import player_page
from instant_avatar.animation.driving_motion import demo_motion
from instant_avatar.cli.command_line import DONE, parse_arguments, run_command, stop_on_interrupt
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import HOST
from instant_avatar.studio.gestures import UNFILMED_DANCE, Arm, Gesture, Leg
from preprocess.body.body_pose import Motion

PORTS_TRIED = 20
"""Consecutive ports to try."""
MIME_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}
"""MIME type by suffix."""
HEADERS = {
    "Cross-Origin-Opener-Policy": "same-origin", "Cross-Origin-Embedder-Policy": "require-corp",
    "Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff",
}  # fmt: skip
"""Headers of all answers; the first two isolate the page, so that its player may use threads."""
HANGING = Arm(lift=-72, elbow=14)
GREETINGS = tuple(
    Gesture(left=Arm(lift=12, forward=10, twist=72, elbow=elbow), right=HANGING, tilt=-5)
    for elbow in (55, 100)
)
"""A raised hand, in and out."""
STRIDE = Gesture(
    left=Arm(lift=-62, forward=-48, elbow=18),
    right=Arm(lift=-62, forward=62, elbow=32),
    left_leg=Leg(out=3, forward=26, knee=8),
    right_leg=Leg(out=3, forward=-16, knee=20, heel=22),
    turn=-8,
)
PASSING = Gesture(
    left=HANGING,
    right=HANGING,
    left_leg=Leg(out=3, forward=3, knee=6),
    right_leg=Leg(out=3, forward=24, knee=58, heel=10),
)
"""One leg passes the other, which stands."""


def write_site(files: Mapping[str, bytes], path: Path) -> None:
    """Write the page as a folder, whole or not at all."""
    with atomic_folder(path) as part:
        for name, content in files.items():
            target = part / name
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(content)


def serve_site(files: Mapping[str, bytes], port: int, console: Console) -> None:
    """Serve the page on the loopback address until Ctrl-C."""
    server = make_server(files, port)
    address = f"http://{HOST}:{server.server_port}"
    with stop_on_interrupt(console, "closing the server") as ended:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        console.info("Open this address in a browser of this machine; Ctrl-C stops the server:")
        print(address, flush=True)  # noqa: T201 - the address goes to stdout, for scripts
        ended.wait()
    server.shutdown()
    server.server_close()


def make_server(files: Mapping[str, bytes], port: int) -> ThreadingHTTPServer:
    """Return a server of the files on the loopback address, not running yet."""
    for tried in range(port, min(port + PORTS_TRIED, 1 << 16)):
        try:
            return _QuietHttpServer((HOST, tried), _handler(files))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
    raise InputError(
        f"Ports {port} to {port + PORTS_TRIED - 1} are all in use. Pass another one to --web."
    )


class _QuietHttpServer(ThreadingHTTPServer):
    def handle_error(self, *_: object) -> None:
        """Ignore browsers that disconnect."""


def _handler(files: Mapping[str, bytes]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """Serves the page's files and nothing else."""

        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True  # a head waits 40 ms for its body otherwise

        def do_GET(self) -> None:
            """Answer with one file."""
            host = self.headers.get("Host", "").rsplit(":", 1)[0]
            name = self.path.split("?", 1)[0].removeprefix("/") or "index.html"
            if host not in (HOST, "localhost"):  # DNS rebinding
                self._answer(HTTPStatus.FORBIDDEN, b"not here\n", ".txt")
            elif name not in files:
                self._answer(HTTPStatus.NOT_FOUND, b"there is no such file\n", ".txt")
            else:
                self._answer(HTTPStatus.OK, files[name], Path(name).suffix)

        def _answer(self, status: HTTPStatus, content: bytes, suffix: str) -> None:
            self.send_response(status)
            self.send_header("Content-Type", MIME_TYPES.get(suffix, "application/octet-stream"))
            self.send_header("Content-Length", str(len(content)))
            for header, value in HEADERS.items():
                self.send_header(header, value)
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Log nothing: the console is for the user."""

    return Handler


PROGRAM = "python -m instant_avatar.animation.web_server"
"""Name of the command in its --help."""


@dataclass(frozen=True, kw_only=True)
class FetchArguments:
    """Fetch the pinned release of onnxruntime-web that `ia-play --web` needs (`make web`).

    npm downloads it once (33 MB); its checksum is verified, and it is stored in your cache folder.
    An existing copy is kept.

    Exit codes: 0 done; 2 npm is missing or failed; 3 disk full; 130 Ctrl-C.
    """


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parse_arguments(FetchArguments, PROGRAM, argv)
    return run_command("make web", lambda: fetch_runtime(Console()))


def fetch_runtime(console: Console) -> int:
    """Fetch, verify and store the pinned release, unless it exists."""
    try:
        player_page.runtime_files()
    except InputError:
        with console.status(f"fetching onnxruntime-web {player_page.ORT_WEB_VERSION}"):
            player_page.install_runtime(_fetch_tarball())
    console.print_artifact("onnxruntime-web", player_page.RUNTIME_FOLDER)
    return DONE


def _fetch_tarball() -> bytes:
    npm = shutil.which("npm")
    if npm is None:
        raise InputError("npm was not found. Install Node.js, which includes it, and try again.")
    with tempfile.TemporaryDirectory() as folder:
        package = f"onnxruntime-web@{player_page.ORT_WEB_VERSION}"
        command = [npm, "pack", package, "--ignore-scripts", "--pack-destination", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
        found = list(Path(folder).glob("*.tgz"))
        if done.returncode or len(found) != 1:
            lines = done.stderr.strip().splitlines() or ["no reason given"]
            raise InputError(f"npm could not fetch {package}: {lines[-1]}")
        return found[0].read_bytes()


if __name__ == "__main__":
    sys.exit(main())


def sample_motions() -> dict[str, Motion]:
    """The motions by their names on the page; the first is the built-in one."""
    steps = (STRIDE, PASSING, STRIDE.mirror(), PASSING.mirror())
    return {
        "Turn": demo_motion(),
        "Wave": _looped(GREETINGS, 24),
        "Walk": _looped(steps, 36),
        "Dance": _looped(UNFILMED_DANCE[:-1], 180),
    }


def _looped(gestures: tuple[Gesture, ...], frames: int) -> Motion:
    """Through the gestures and back to the first, smooth to the second derivative."""
    keys = np.stack([gesture.joint_rotations().as_rotvec() for gesture in (*gestures, gestures[0])])
    times = np.linspace(0.0, frames, len(keys))
    still = np.zeros((frames, 3))
    return Motion(
        root_rotations=still,
        root_translations=still,
        joint_rotations=CubicSpline(times, keys, bc_type="periodic")(np.arange(frames)),
        valid=np.ones(frames, dtype=bool),
        betas=np.zeros(10),
        body_model="body24",
        times_s=np.arange(frames) / ASSUMED_FPS,
    )
