"""ia-capture: film with the phone's own browser, and play with the avatar there."""

import errno
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg

from capture.input_error import InputError
from instant_avatar.cli.command_line import (
    DONE,
    INTERRUPTED,
    CommandExit,
    exit_on_interrupt,
    is_disk_full,
    require_packages,
    run_main,
)
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import Flag, OptionalFile, check_writable
from instant_avatar.run.ingest_arguments import IngestArguments

if TYPE_CHECKING:
    from instant_avatar.phone.film_queue import Film, FilmQueue

PROGRAM = "ia-capture"
"""Name of the command."""
POLL_S = 0.5
"""Interval at which silent phones are looked for, seconds."""


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """Film with the phone's own browser: a page on your network takes the film, the avatar plays
    there when you stop.

    Try it:

        ia-capture

    Scan the code that it prints with the phone, on the same network. The page takes a film of the
    phone's camera app, or any video file, and learns while it arrives. `Film here` films with the
    page itself and tells you what to do while you film; for that, browsers demand TLS, and they
    warn of the certificate, which is made on the spot. A certificate of your own: --cert and --key.
    A tunnel of your own: forward it to the plain port.

    Films and avatars are kept in --out, one folder a person. Each printed address opens the page
    once, in one browser; nothing leaves your network. Ctrl-C closes the page.

    Exit codes: 0 closed by Ctrl-C while no film was learnt from; 2 bad input or port in use; 3 disk
    full; 130 Ctrl-C during a film, after its avatar was written.
    """

    out: Annotated[Path, arg(metavar="DIR")] = Path("avatars")
    """Folder for films and avatars."""
    host: Annotated[str, arg(metavar="ADDRESS", help_behavior_hint="")] = ""
    """Address to serve at (default: all of this machine; 127.0.0.1 for this machine only)."""
    port: int = 8010
    """Port of the page; the one after it has the page with TLS."""
    cert: OptionalFile = None
    """Certificate (PEM) instead of one made on the spot."""
    key: OptionalFile = None
    """Key of --cert (PEM)."""
    no_tls: Flag = False
    """Serve the plain page only."""
    size: int = 400
    """Longer side of training images in pixels (400: for films of half a minute)."""
    silent_seconds: float = 30.0
    """End a film when nothing has come of it for this many seconds."""

    def validate(self) -> None:
        """Check ranges and files."""
        if not 0 < self.port < (1 << 16) - 1:
            raise InputError(f"--port is {self.port}, but must be from 1 to 65534.")
        if not 10.0 <= self.silent_seconds < float("inf"):  # the page counts down before it sends
            raise InputError(f"--silent-seconds is {self.silent_seconds}, but must be at least 10.")
        if self.size < 64:
            raise InputError(f"--size is {self.size}, but must be at least 64 pixels.")
        if (self.cert is None) != (self.key is None):
            raise InputError("--cert and --key belong together: give both, or none.")
        for flag, path in (("--cert", self.cert), ("--key", self.key)):
            if path is not None and not path.is_file():
                raise InputError(f"{flag} is {path}, but there is no such file.")
        if self.out.exists() and not self.out.is_dir():
            raise InputError(f"--out is {self.out}, which is a file, but must be a folder.")
        check_writable(self.out, "--out")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main(PROGRAM, CaptureOptions, capture, argv)


def capture(options: CaptureOptions, console: Console) -> int:
    """Serve the page, and learn from one film after the other until Ctrl-C."""
    require_packages("aiohttp", "cryptography", "segno", "torch", "numba", "onnx")
    options.validate()
    with exit_on_interrupt(console, PROGRAM):
        with console.status("loading torch"):
            import instant_avatar.report.report_writer
            import instant_avatar.run.session_start  # noqa: F401 - no film waits for these
            from instant_avatar.phone.access_control import (
                AccessControl,
                load_certificate,
                local_address,
                made_certificate,
            )
            from instant_avatar.phone.film_queue import FilmQueue
            from instant_avatar.phone.phone_server import PhoneServer
            from instant_avatar.run.start_up import warm_up
        with console.status("compiling kernels (slow on the first run only)"):
            warm_up()
    options.out.mkdir(parents=True, exist_ok=True)
    queue, access = FilmQueue(options.out, options.silent_seconds), AccessControl()
    address = options.host or local_address()
    sites: list[tuple[int, Any]] = [(options.port, None)]
    if not options.no_tls:
        own = None if options.cert is None or options.key is None else (options.cert, options.key)
        context = made_certificate(address) if own is None else load_certificate(*own)
        sites.append((options.port + 1, context))
    server = PhoneServer(queue, access, None if options.no_tls else options.port + 1)

    def print_address() -> None:
        _print_address(f"http://{address}:{options.port}/?token={access.token}", console)

    server.on_entered = print_address
    try:
        server.start(options.host or "0.0.0.0", sites)
    except OSError as error:
        cause = f"The page cannot be served at {address}: {error.strerror}. Check --host, --port."
        if error.errno == errno.EADDRINUSE:
            cause = f"Port {options.port} or the next is in use. Pass another --port."
        raise InputError(cause) from None
    if server.missing_player:
        console.warning(f"The page will film, but not play. {server.missing_player}")
    print_address()
    try:
        return _serve(options, queue, console)
    finally:
        queue.end_all()
        server.close()


def _print_address(address: str, console: Console) -> None:
    import segno

    console.info("Open this address on the phone, once; Ctrl-C closes the page:")
    if console.is_terminal:
        segno.make(address).terminal(sys.stderr, compact=True)
    print(address, flush=True)  # noqa: T201 - the address goes to stdout, for scripts


def _serve(options: CaptureOptions, queue: "FilmQueue", console: Console) -> int:
    closed = threading.Event()

    def watch() -> None:
        while not closed.wait(POLL_S):
            queue.end_silent()

    threading.Thread(target=watch, daemon=True).start()
    try:
        while True:
            film = None
            with suppress(KeyboardInterrupt):
                film = queue.take_next(POLL_S)
                if film is None:
                    continue
            if film is None:
                return DONE
            try:
                if _learn(options, film, console) == INTERRUPTED:
                    return INTERRUPTED
            finally:
                queue.finish(film)
    finally:
        closed.set()


def _learn(options: CaptureOptions, film: "Film", console: Console) -> int:
    """Learn from a film; tell its page what went wrong, and go on with the next one."""
    from instant_avatar.ingest import ingest
    from instant_avatar.phone.film_feedback import FilmFeedback

    console.info(f"Filming {film.place.name}: {film.file.path}")
    arguments = IngestArguments(
        video=film.file.path, out=film.run.path, live=True, size=options.size,
        resume=film.adds, idle_seconds=2.0 * options.silent_seconds,
    )  # fmt: skip
    try:
        code = ingest(arguments, console, [FilmFeedback(film)])
    except (InputError, CommandExit) as error:
        code = error.code if isinstance(error, CommandExit) else DONE
        console.warning(f"{film.place.name}: {error}")
        film.tell("failed", text=str(error))
    except OSError as error:
        if not is_disk_full(error):
            raise
        code = DONE
        console.warning(f"{film.place.name}: the disk is full. Film and run are kept.")
        film.tell(
            "failed",
            text="The disk of the computer is full: free some space. Film and run are kept.",
        )
    return code


if __name__ == "__main__":
    sys.exit(main())
