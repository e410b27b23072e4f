"""ia-play --web: the avatar's page on this machine's own address, or as a folder for any host."""

import errno
import threading
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from apps.animation.following_camera import FollowingCamera
from apps.cli.console import Console
from apps.cli.interrupt import interrupt_event
from capture.atomic_files import atomic_folder
from capture.input_error import InputError
from export.player import Player
from export.web.player_page import PageMotion, StartView, flatten_pose
from preprocess.body.body_pose import Motion

HOST = "127.0.0.1"
PORTS_TRIED = 20
"""So many ports are tried, one after the other."""
MIME_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}


def web_clip(player: Player, motion: Motion, rows: tuple[int, ...], fps: float) -> PageMotion:
    """The valid poses of a motion, and a camera before the first of them."""
    camera = FollowingCamera.of(player, motion, 540)
    return PageMotion(
        poses=np.stack([flatten_pose(motion[row]) for row in rows]),
        fps=fps,
        start_view=StartView(
            axes=camera.level_axes, height_m=camera.height_m, middle_m=camera.center_above_pelvis_m
        ),
    )


def write_site(files: Mapping[str, bytes], path: Path) -> None:
    """The page as a folder, whole or not at all.

    Raises:
        OSError: If the disk is full; then nothing is written.
    """
    with atomic_folder(path) as part:
        for name, content in files.items():
            target = part / name
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(content)


def serve_site(files: Mapping[str, bytes], port: int, console: Console) -> None:
    """Serves the page to this machine's own browsers until Ctrl-C.

    Args:
        files: By relative path.
        port: Tried first.
        console: Where the address is said; stdout hears it, too.

    Raises:
        InputError: If no port is free.
    """
    server = make_server(files, port)
    address = f"http://{HOST}:{server.server_port}"
    with interrupt_event() as ended:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        console.info("The avatar plays in a browser on this machine; Ctrl-C ends it:")
        print(address, flush=True)  # noqa: T201 - the address goes to stdout, for scripts
        ended.wait()
    server.shutdown()
    server.server_close()


def make_server(files: Mapping[str, bytes], port: int) -> ThreadingHTTPServer:
    """A server of these files on this machine's own address, not running yet.

    Raises:
        InputError: If neither this port nor one of the next ones is free.
    """
    for tried in range(port, min(port + PORTS_TRIED, 1 << 16)):
        try:
            return _QuietHttpServer((HOST, tried), _handler(files))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
    raise InputError(
        f"Ports {port} to {port + PORTS_TRIED - 1} are all taken. Give --web another one."
    )


class _QuietHttpServer(ThreadingHTTPServer):
    def handle_error(self, *_: object) -> None:
        """A browser that goes away in the middle is no error."""


def _handler(files: Mapping[str, bytes]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        """Answers with the page's files and nothing else."""

        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            """One file."""
            host = self.headers.get("Host", "").rsplit(":", 1)[0]
            name = self.path.split("?", 1)[0].removeprefix("/") or "index.html"
            if host not in (HOST, "localhost"):  # another site's name that was bent to here
                self._answer(HTTPStatus.FORBIDDEN, b"not here\n", ".txt")
            elif name not in files:
                self._answer(HTTPStatus.NOT_FOUND, b"there is no such file\n", ".txt")
            else:
                self._answer(HTTPStatus.OK, files[name], Path(name).suffix)

        def _answer(self, status: HTTPStatus, content: bytes, suffix: str) -> None:
            self.send_response(status)
            self.send_header("Content-Type", MIME_TYPES.get(suffix, "application/octet-stream"))
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-cache")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Says nothing: the console is for people."""

    return Handler
