"""ia-play --web: the avatar's page on this machine's own address, or as a folder for any host."""

import errno
import threading
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from apps.playing.follow import FollowingCamera
from apps.terminal.console import Console
from apps.terminal.interrupt import ended_by_ctrl_c
from capture.atomic_files import whole_folder
from capture.errors import BadInput
from export.player import Player
from export.web.site import Clip, Look, pose_row
from preprocess.pose import Motion

HOST = "127.0.0.1"
PORTS = 20
"""So many ports are tried, one after the other."""
KINDS = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}


def clip_of(player: Player, motion: Motion, rows: tuple[int, ...], fps: float) -> Clip:
    """The valid poses of a motion, and a camera before the first of them."""
    camera = FollowingCamera.of(player, motion, 540)
    return Clip(
        poses=np.stack([pose_row(motion[row]) for row in rows]),
        fps=fps,
        look=Look(axes=camera.axes, height_m=camera.height_m, middle_m=camera.middle_m),
    )


def write_site(files: Mapping[str, bytes], path: Path) -> None:
    """The page as a folder, whole or not at all.

    Raises:
        OSError: If the disk is full; then nothing is written.
    """
    with whole_folder(path) as part:
        for name, content in files.items():
            target = part / name
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(content)


def serve(files: Mapping[str, bytes], port: int, console: Console) -> None:
    """Serves the page to this machine's own browsers until Ctrl-C.

    Args:
        files: By relative path.
        port: Tried first.
        console: Where the address is said; stdout hears it, too.

    Raises:
        BadInput: If no port is free.
    """
    server = server_of(files, port)
    address = f"http://{HOST}:{server.server_port}"
    with ended_by_ctrl_c() as ended:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        console.say("The avatar plays in a browser on this machine; Ctrl-C ends it:")
        print(address, flush=True)  # noqa: T201 - where it is goes to stdout, for scripts
        ended.wait()
    server.shutdown()
    server.server_close()


def server_of(files: Mapping[str, bytes], port: int) -> ThreadingHTTPServer:
    """A server of these files on this machine's own address, not running yet.

    Raises:
        BadInput: If neither this port nor one of the next ones is free.
    """
    for tried in range(port, min(port + PORTS, 1 << 16)):
        try:
            return _Server((HOST, tried), _handler(files))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
    raise BadInput(f"Ports {port} to {port + PORTS - 1} are all taken. Give --web another one.")


class _Server(ThreadingHTTPServer):
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
            self.send_header("Content-Type", KINDS.get(suffix, "application/octet-stream"))
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-cache")
            self.send_header("X-Content-Type-Options", "nosniff")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Says nothing: the console is for people."""

    return Handler
