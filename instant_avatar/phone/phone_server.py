"""The server of the phone page: films come in pieces, messages go out, avatars are played."""

import asyncio
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, final
from urllib.parse import quote

from aiohttp import web

from capture.input_error import InputError
from export.build import write_warm_up_package
from export.package.package_file import read_package
from export.player_page import (
    ORT_WEB_VERSION,
    PACKAGE_FILE,
    PACKED_WASM_FILE,
    encode_motion,
    player_files,
    titled,
)
from instant_avatar.animation import web_server
from instant_avatar.animation.driving_motion import pose_rate
from instant_avatar.animation.web_server import sample_motions
from instant_avatar.cli.command_line import DONE
from instant_avatar.phone.access_control import AccessControl
from instant_avatar.phone.film_queue import Film, FilmQueue, FilmRefused

PAGE = Path(__file__).with_name("page")
"""Folder of the page's own files."""
COOKIES = {False: "session", True: "session-tls"}
"""Cookie that a browser gets for its token, by whether the page has TLS: ports share cookies, and a
page without TLS may not replace one of a page with it."""
MAX_PIECE_BYTES = 8 << 20
"""Largest piece of a film, bytes."""
MAX_REQUESTS_PER_S = 120
"""Requests of one browser in a second, above which it must wait; a player makes twenty."""
PIECE_TIMEOUT_S = 60.0
"""Longest time that one piece may take, seconds."""
WARM_UP = "-"
"""Name of an avatar of two points, which the page's hidden player draws before a film: the browser
has then compiled what draws the film's avatar. Names of films do not end in a dash."""
EXPORTS = ("avatar.glb", "avatar.vrm", "avatar.spz", "avatar.ply", "avatar.obj")
"""Files for other programs that the page offers: meshes, and splats (.spz)."""
HEADERS = web_server.HEADERS | {
    "Cross-Origin-Resource-Policy": "same-origin", "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "SAMEORIGIN",
}  # fmt: skip
"""Headers of all answers."""
MODULE_FILE = f"ort-{ORT_WEB_VERSION}.wasm.zlib"
"""The player's WebAssembly module, named by its release."""
WEB_MODULE = f"runtime/{PACKED_WASM_FILE}"
"""Its name within a player's page."""
KEPT = {"Cache-Control": "max-age=31536000, immutable"}
"""Header of that file."""
REFUSED = (
    "This page is opened by the address that ia-capture prints. Each address opens it once, in one "
    "browser: scan the newest code, or look at the terminal for it.\n"
)
"""Answer to a browser without a session."""


@final
class PhoneServer:
    """Serves the page on a thread of its own; `queue` is filled, others take from it.

    Attributes:
        on_entered: Called when a browser has entered with a token.
        missing_player: Why the page cannot play avatars, once it is served; empty if it can.
    """

    def __init__(self, queue: FilmQueue, access: AccessControl, live_port: int | None) -> None:
        """Serve nothing yet; `live_port` is that of the page with TLS, if there is one."""
        self._queue, self._access, self._live_port = queue, access, live_port
        self.on_entered: Callable[[], object] = lambda: None
        self.missing_player = ""
        self._loop = asyncio.new_event_loop()
        self._sockets: list[socket.socket] = []
        self._player: dict[str, bytes] = {}
        self._warm_up = b""
        self._requests: dict[str, deque[float]] = {}
        self._exporting = asyncio.Lock()  # exports are costly: one at a time
        self._listeners: dict[str, set[asyncio.Event]] = {}
        self._app = web.Application(client_max_size=MAX_PIECE_BYTES, middlewares=[self._guard])
        self._app.add_routes(
            [
                web.get("/", self._index),
                web.get("/live", self._go_live),
                web.get("/page/{file}", self._file),
                web.get("/films", self._begun),
                web.post("/films", self._begin),
                web.get("/films/{number}", self._state),
                web.put("/films/{number}", self._piece),
                web.post("/films/{number}/end", self._end),
                web.get("/films/{number}/messages", self._messages),
                web.get("/avatars", self._avatars),
                web.get("/avatars/{name}/{file:.*}", self._avatar),
                web.get("/runtime/{file:.*}", self._runtime),
            ]
        )

    def start(self, host: str, sites: list[tuple[int, Any]]) -> None:
        """Serve at ports, each with a TLS context or None; raise an OSError if one is in use."""
        try:
            self._player = _player_files()
        except InputError as error:
            self.missing_player = str(error)
        runner = web.AppRunner(self._app, access_log=None, shutdown_timeout=1.0)

        async def listen() -> None:
            await runner.setup()
            for port, context in sites:
                self._sockets.append(socket.create_server((host, port)))
                await web.SockSite(runner, self._sockets[-1], ssl_context=context).start()

        self._runner = runner
        self._loop.run_until_complete(listen())
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End all connections."""
        for film in self._queue:
            film.is_over = True

        async def end() -> None:
            with suppress(NotImplementedError):  # as on Windows
                for each in self._sockets:
                    self._loop.remove_reader(each)
            await asyncio.sleep(0.0)  # one accepted in this moment would be refused, but not closed
            assert self._runner.server is not None
            transports = [e.transport for e in self._runner.server.connections if e.transport]
            await self._runner.cleanup()
            for each in transports:
                with suppress(AttributeError):  # of Python 3.11, if TLS has ended meanwhile
                    each.abort()  # TLS would wait for the browser to close, too
            left = asyncio.all_tasks() - {asyncio.current_task()}
            for task in left:
                task.cancel()
            await asyncio.gather(*left, return_exceptions=True)

        asyncio.run_coroutine_threadsafe(end(), self._loop).result(timeout=10.0)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.run_until_complete(asyncio.sleep(0.0))  # its sockets are closed in a next round
        self._loop.close()

    @web.middleware
    async def _guard(
        self,
        request: web.Request,
        handler: Callable[[web.Request], Awaitable[web.StreamResponse]],
    ) -> web.StreamResponse:
        """Refuse browsers without a session, pages of other sites, and more than the limits."""
        session = _session(request)
        try:
            if request.path == "/" and "token" in request.query:
                return self._enter(request)
            if not self._access.is_known(session):
                raise FilmRefused(403, REFUSED)
            origin = request.headers.get("Origin")
            is_foreign = origin is not None and origin.split("://")[-1] != request.host
            if is_foreign or (request.method != "GET" and origin is None):
                raise FilmRefused(403, "Another page may not use this one.\n")
            self._limit_rate(session)
            answer = await handler(request)
        except FilmRefused as refused:
            answer = web.json_response({"message": str(refused)}, status=refused.status)
            if request.path == "/":  # a person reads it
                answer = web.Response(text=str(refused), status=refused.status)
        except InputError as error:
            answer = web.json_response({"message": str(error)}, status=404)
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            answer = web.json_response({"message": f"Malformed: {error}"}, status=400)
        except (ConnectionError, TimeoutError) as error:  # most often the answer reaches no one
            answer = web.json_response({"message": f"The connection broke: {error}"}, status=504)
        if not answer.prepared:
            for name, value in HEADERS.items():
                answer.headers.setdefault(name, value)
        return answer

    def _enter(self, request: web.Request) -> web.Response:
        session = _session(request)
        if self._access.is_known(session):  # it keeps its films
            return web.Response(status=303, headers={"Location": "/", **HEADERS})
        session = self._access.enter(request.query["token"])
        if session is None:
            raise FilmRefused(403, REFUSED)
        answer = web.Response(status=303, headers={"Location": "/", **HEADERS})
        answer.set_cookie(  # a strict one is not sent on the way to the page with TLS
            COOKIES[request.secure], session, httponly=True, samesite="Lax", secure=request.secure
        )
        self.on_entered()
        return answer

    def _limit_rate(self, session: str) -> None:
        now, recent = self._loop.time(), self._requests.setdefault(session, deque())
        while recent and recent[0] < now - 1.0:
            recent.popleft()
        if len(recent) >= MAX_REQUESTS_PER_S:
            raise FilmRefused(429, "Too many requests in a second. Wait a moment.")
        recent.append(now)

    async def _index(self, request: web.Request) -> web.Response:
        text = (PAGE / "index.html").read_text(encoding="utf-8")
        policy = "default-src 'self'; img-src 'self' data: blob:; media-src 'self' blob:"
        headers = {"Content-Security-Policy": f"{policy}; base-uri 'none'; form-action 'none'"}
        with suppress(InputError):  # it may have been fetched meanwhile
            self._player = self._player or _player_files()
        live = "here" if request.secure else "elsewhere" if self._live_port else "no"
        warm_up = f"avatars/{WARM_UP}/?start=lite&warm-up" if self._player else ""
        player = "here" if self._player else "missing"
        for name, value in (("live", live), ("warm_up", warm_up), ("player", player)):
            text = text.replace(f"{{{{{name}}}}}", value)
        return web.Response(text=text, content_type="text/html", headers=headers)

    async def _go_live(self, request: web.Request) -> web.Response:
        """Go on at the page with TLS, which has cookies of its own."""
        host = request.host.rsplit(":", 1)[0]
        address = f"https://{host}:{self._live_port}/?token={self._access.token}"
        return web.Response(status=303, headers={"Location": address})

    async def _file(self, request: web.Request) -> web.Response:
        path = PAGE / request.match_info["file"]
        if path.parent != PAGE or path.suffix not in (".js", ".css") or not path.is_file():
            raise InputError("There is no such file.")
        kind = web_server.MIME_TYPES[path.suffix]
        return web.Response(body=path.read_bytes(), headers={"Content-Type": kind})

    async def _runtime(self, request: web.Request) -> web.Response:
        if request.match_info["file"] != MODULE_FILE or not self._player:
            raise InputError("There is no such file.")
        return web.Response(body=self._player[WEB_MODULE], headers=HEADERS | KEPT)

    def _film(self, request: web.Request) -> Film:
        return self._queue.find(request.match_info["number"], _session(request))

    async def _begin(self, request: web.Request) -> web.Response:
        given = await request.json()
        size = given.get("size")
        if size is not None and (not isinstance(size, int) or isinstance(size, bool)):
            raise ValueError("size is a number of bytes, or null")
        film = self._queue.begin(
            _session(request),
            name=str(given.get("name", "")), kind=str(given["type"]), size=size,
            avatar=str(given.get("avatar") or ""),
        )  # fmt: skip
        film.on_message = lambda: self._loop.call_soon_threadsafe(self._wake, film.number)
        begun = {"film": film.number, "avatar": film.place.name}
        return web.json_response(begun, status=201)

    async def _begun(self, request: web.Request) -> web.Response:
        """This browser's films that are not over, for a page that was loaded again."""
        own = [film for film in self._queue if film.owner == _session(request)]
        return web.json_response(
            [{"film": film.number, "avatar": film.place.name, "size": film.file.size,
              "received": film.file.received, "ended": film.file.ended} for film in own]
        )  # fmt: skip

    async def _state(self, request: web.Request) -> web.Response:
        film = self._film(request)
        film.heard_at = time.monotonic()  # a page that waits for a choice is not silent
        return self._progress(film)

    def _progress(self, film: Film) -> web.Response:
        file = film.file
        return web.json_response(
            {"next": file.next_offset(), "received": file.received, "ended": file.ended,
             "reason": file.reason}
        )  # fmt: skip

    async def _piece(self, request: web.Request) -> web.Response:
        """Write a piece as it comes, so that a broken connection keeps what it has brought."""
        film, offset = self._film(request), int(request.query["offset"])
        length = request.content_length
        if offset < 0 or not length or length > MAX_PIECE_BYTES:
            raise FilmRefused(413 if length else 400, "A piece has 1 byte to 8 MiB.")
        if film.file.ended:
            return self._progress(film)
        async with asyncio.timeout(PIECE_TIMEOUT_S):
            async for content, _ in request.content.iter_chunks():
                await asyncio.to_thread(film.write, offset, content)
                offset += len(content)
        return self._progress(film)

    async def _end(self, request: web.Request) -> web.Response:
        film, total = self._film(request), int(request.query["size"])
        if film.file.received >= total:
            film.file.end()
        return self._progress(film)

    def _wake(self, number: str) -> None:
        for listener in self._listeners.get(number, ()):
            listener.set()

    @contextmanager
    def _listening(self, film: Film) -> Iterator[asyncio.Event]:
        """Set an event at each message to a film's page."""
        woken, listeners = asyncio.Event(), self._listeners.setdefault(film.number, set())
        listeners.add(woken)
        try:
            yield woken
        finally:
            listeners.discard(woken)

    async def _messages(self, request: web.Request) -> web.StreamResponse:
        """Send the newest message of each kind; a slow browser misses older ones."""
        film, after = self._film(request), 0
        headers = {**HEADERS, "Content-Type": "text/event-stream"}
        answer = web.StreamResponse(headers=headers)
        await answer.prepare(request)
        with suppress(ConnectionError), self._listening(film) as woken:
            while True:
                is_over = film.is_over
                woken.clear()
                for number, kind, content in film.messages(after):
                    after = number
                    text = f"event: {kind}\ndata: {json.dumps(content)}\n\n"
                    await answer.write(text.encode())
                if is_over:
                    await answer.write(b"event: over\ndata: {}\n\n")
                    return answer
                try:
                    await asyncio.wait_for(woken.wait(), 5.0)  # proxies cut silent connections
                except TimeoutError:
                    await answer.write(b": alive\n\n")
        return answer

    async def _avatars(self, request: web.Request) -> web.Response:
        return web.json_response(self._queue.avatars())

    async def _avatar(self, request: web.Request) -> web.StreamResponse:
        """A file of an avatar's player page, its poster, its package, or a file for other programs.

        The package that a film in progress makes is waited for: its player starts meanwhile.
        """
        name, file = request.match_info["name"], request.match_info["file"] or "index.html"
        if file == WEB_MODULE:  # one module for all avatars
            return web.Response(status=302, headers={"Location": f"../../../runtime/{MODULE_FILE}"})
        if file not in (PACKAGE_FILE, "poster.png", *EXPORTS):
            self._player = self._player or _player_files()
            if file not in self._player:
                raise InputError("There is no such file.")
            body = self._player[file]
            kind = web_server.MIME_TYPES.get(Path(file).suffix, "application/octet-stream")
            body = titled(body, name) if file == "index.html" else body
            return web.Response(body=body, headers={"Content-Type": kind})
        if name == WARM_UP:
            self._warm_up = self._warm_up or await asyncio.to_thread(_warm_up_package)
            return web.Response(body=self._warm_up)
        film = next((film for film in self._queue if film.place.name == name), None)
        if film is not None:
            with self._listening(film) as woken:
                while film.has_turn and not (film.is_playable or film.is_over):
                    woken.clear()
                    await woken.wait()
        package = self._queue.package(name)
        saved_as = quote(name + Path(file).suffix)
        saved = {"Content-Disposition": f"attachment; filename*=UTF-8''{saved_as}"}
        if file == PACKAGE_FILE:
            return web.FileResponse(package, headers=saved | HEADERS)
        if file == "poster.png":
            content = await asyncio.to_thread(lambda: read_package(package).preview)
            return web.Response(body=content, content_type="image/png")
        author = request.query.get("author", "").strip()[:80]
        async with self._exporting:
            content = await asyncio.to_thread(_exported, package, file, author)
        return web.Response(body=content, headers=saved)


def _session(request: web.Request) -> str:
    return request.cookies.get(COOKIES[request.secure], "")


def _player_files() -> dict[str, bytes]:
    samples = sample_motions()
    motions = {name: encode_motion(motion, pose_rate(motion)) for name, motion in samples.items()}
    return player_files(motions, compression_level=1)


def _warm_up_package() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / PACKAGE_FILE
        write_warm_up_package(path)
        return path.read_bytes()


def _exported(package: Path, file: str, author: str) -> bytes:
    """A file of an avatar for other programs, as ia-export writes it; a VRM names its author.

    A process of its own makes it: what unwraps textures stops all threads of its process for
    seconds, and the film that is being learnt from, too.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / file
        to = "splats" if out.suffix == ".spz" else out.suffix[1:]
        words = [str(package), f"--to={to}", f"--out={out}"]
        words += [] if to == "splats" else ["--triangles=20000"]
        words += [f"--author={author}"] if author and to == "vrm" else []
        command = [sys.executable, "-m", "instant_avatar.export", *words]
        done = subprocess.run(command, capture_output=True, encoding="utf-8", check=False)
        if done.returncode != DONE:
            raise InputError(done.stderr.strip())
        return out.read_bytes()
