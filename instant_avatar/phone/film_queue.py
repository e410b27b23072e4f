"""Films that phones send: one is learnt from at a time, others wait by name."""

import re
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, final

from capture.input_error import InputError
from capture.received_video import ReceivedFile
from instant_avatar.cli.shared_options import unused_path
from instant_avatar.run.run_folder import RunFolder

MAX_FILM_BYTES = 8 << 30
"""Largest film, bytes: ten minutes of 4K."""
MIN_FREE_BYTES = 1 << 30
"""Space on the disk that films leave free, bytes."""
SUFFIXES = {
    "video/mp4": ".mp4", "video/quicktime": ".mov", "video/webm": ".webm",
    "video/x-matroska": ".mkv", "video/3gpp": ".3gp", "video/x-m4v": ".m4v",
}  # fmt: skip
"""File endings by MIME type."""
RUN_FOLDER = "run"
"""Folder of an avatar's run, beside its films."""


class FilmRefused(Exception):  # noqa: N818 - an answer to a phone, not a failure of this program
    """A request that is refused; `status` is the HTTP status."""

    def __init__(self, status: int, message: str) -> None:
        """Set the status and the message for people."""
        super().__init__(message)
        self.status = status


@final
class Film:
    """One film: its file, its avatar, and the newest message of each kind for its page.

    Attributes:
        owner: Session of the browser that sends it.
        place: Folder of its avatar.
        adds: Whether it is added to an avatar that exists.
        heard_at: When a byte came last, on `time.monotonic`'s clock.
        on_message: Called after each message, on any thread.
    """

    def __init__(
        self, owner: str, place: Path, suffix: str, *, size: int | None, adds: bool
    ) -> None:
        """Create the film's file in the avatar's folder."""
        self.number, self.owner, self.place, self.adds = secrets.token_hex(8), owner, place, adds
        place.mkdir(parents=True, exist_ok=True)
        self.file = ReceivedFile(unused_path(place / f"film{suffix}"), size)
        self.heard_at = time.monotonic()
        self.has_turn = self.is_over = False
        self.on_message: Callable[[], object] = lambda: None
        self._messages: dict[str, tuple[int, dict[str, Any]]] = {}
        self._count = 0
        self._lock = threading.Lock()

    @property
    def run(self) -> RunFolder:
        """The run's folder."""
        return RunFolder(path=self.place / RUN_FOLDER)

    @property
    def is_playable(self) -> bool:
        """Whether a package of its avatar has been written."""
        return "avatar" in self._messages

    def tell(self, kind: str, **content: Any) -> None:
        """Leave a message for the page, in place of an older one of its kind; on any thread."""
        with self._lock:
            self._count += 1
            self._messages[kind] = (self._count, content)
        self.on_message()

    def messages(self, after: int) -> list[tuple[int, str, dict[str, Any]]]:
        """Messages after a number, in order, each with its own number."""
        with self._lock:
            newer = [(n, kind, text) for kind, (n, text) in self._messages.items() if n > after]
        return sorted(newer, key=lambda message: message[0])

    def write(self, offset: int, content: bytes) -> None:
        """Write a piece; a full disk ends the film, and what has come is kept."""
        self.heard_at = time.monotonic()
        end = offset + len(content)
        if end > min(self.file.size or MAX_FILM_BYTES, MAX_FILM_BYTES):
            raise FilmRefused(413, "The piece lies beyond the end of the film.")
        if self.file.size is None and offset > self.file.received:
            raise FilmRefused(409, "A piece before this one is missing.")
        try:
            if shutil.disk_usage(self.place).free < MIN_FREE_BYTES:
                raise OSError
            self.file.write(offset, content)
        except OSError as cause:
            self.file.end("The disk of the computer is full: the film ends here.")
            raise FilmRefused(507, self.file.reason) from cause


@final
class FilmQueue:
    """The films that are being received or learnt from, in the order in which they were begun."""

    def __init__(self, folder: Path, silent_s: float) -> None:
        """Keep films and avatars in a folder; end a film from which no byte comes in `silent_s`."""
        self.folder, self._silent_s = folder, silent_s
        self._films: list[Film] = []
        self._changed = threading.Condition()

    def begin(self, owner: str, *, name: str, kind: str, size: int | None, avatar: str) -> Film:
        """Begin a film of a new person, or of one whose avatar exists; refuse what cannot be."""
        suffix = SUFFIXES.get(kind.split(";")[0].strip().lower())
        if suffix is None:
            found = f" ({kind})" if kind else ""
            raise FilmRefused(415, f"That file is no video{found}: choose an MP4, MOV or WebM.")
        if size is not None and not 0 < size <= MAX_FILM_BYTES:
            raise FilmRefused(413, f"A film has 1 byte to {MAX_FILM_BYTES >> 30} GiB.")
        free = shutil.disk_usage(self.folder).free - MIN_FREE_BYTES
        if (size or 0) > free:
            raise FilmRefused(507, "The disk of the computer is too full for this film.")
        slug = re.sub(r"[^\w-]+", "-", name).strip("-_")[:40] or "avatar"
        with self._changed:
            if len(self._films) >= 8:
                raise FilmRefused(503, "Too many films are waiting. Try again later.")
            place = self.folder / avatar if avatar else unused_path(self.folder / slug)
            if avatar and avatar not in self.avatars():
                raise FilmRefused(404, "There is no avatar of that name to add to.")
            film = Film(owner, place, suffix, size=size, adds=bool(avatar))
            self._films.append(film)
            self._tell_places()
            self._changed.notify_all()
        return film

    def find(self, number: str, owner: str) -> Film:
        """The film of a number; refuse those of other browsers."""
        film = next((film for film in self._films if film.number == number), None)
        if film is None or film.owner != owner:
            raise FilmRefused(404, "There is no such film; it may be over.")
        return film

    def take_next(self, timeout_s: float) -> Film | None:
        """Wait for a film whose turn it is."""
        with self._changed:
            self._changed.wait_for(lambda: self._films, timeout_s)
            film = self._films[0] if self._films else None
        if film is not None:
            film.has_turn, film.heard_at = True, time.monotonic()
            film.tell("state", state="filming")
        return film

    def finish(self, film: Film) -> None:
        """Give the turn to the next film."""
        film.is_over = True
        if not film.file.ended:
            film.file.end()
        film.on_message()
        with self._changed:
            self._films.remove(film)
            self._tell_places()

    def end_silent(self) -> None:
        """End a film whose phone has fallen silent; what has come is learnt from."""
        for film in self._films:
            silence = time.monotonic() - film.heard_at
            if film.has_turn and not film.file.ended and silence > self._silent_s:
                reason = f"The phone fell silent for {self._silent_s:.0f} s: the film ends here."
                film.file.end(reason)
                film.tell("warning", text=reason)

    def end_all(self) -> None:
        """End all films: the server closes."""
        for film in self._films:
            film.file.end("The computer has ended the film.")

    def avatars(self) -> list[str]:
        """Names of the avatars, the newest first."""
        made = self.folder.glob(f"*/{RUN_FOLDER}/avatar.iavatar")
        return [path.parts[-3] for path in sorted(made, key=lambda p: -p.stat().st_mtime)]

    def package(self, name: str) -> Path:
        """The package of an avatar; an InputError if there is none."""
        if name not in self.avatars():
            raise InputError(f"There is no avatar {name!r}.")
        return RunFolder(path=self.folder / name / RUN_FOLDER).package

    def _tell_places(self) -> None:
        for place, film in enumerate(self._films):
            if place:
                names = [other.place.name for other in self._films[:place]]
                film.tell("state", state="waiting", behind=names)

    def __iter__(self) -> Iterator[Film]:
        """The films, in order."""
        return iter(list(self._films))
