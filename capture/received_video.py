"""Videos that are still being received: a file that grows in pieces, and the frames in it.

Beside the file lies a note of the bytes that have come, so that a transfer goes on after any break,
and another thread or program reads the frames as far as they have come.
"""

import json
import threading
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from typing import Any, final

import av
from av.error import FFmpegError

from capture.atomic_files import write_text_atomically
from capture.input_error import InputError
from capture.source import Frame, FrameSelection, FrameSource, PacingClock
from capture.video import decode

POLL_S = 0.01
"""Interval at which a reader looks for bytes that it waits for, seconds."""
MAX_LONGER_PX = 1920
"""Longer side to which larger images are reduced, so that those that wait stay small."""
STREAM_OPTIONS = {"probesize": "131072", "analyzeduration": "200000", "fpsprobesize": "0"}
"""FFmpeg's options that begin with the first frames of a stream instead of some seconds of it."""
INDEX_BOXES = (b"ftyp", b"wide", b"free", b"skip", b"mdat", b"moov", b"uuid", b"meta", b"pnot")
"""Top-level boxes of MP4 and QuickTime before the end of the index."""


@final
class ReceivedFile:
    """A file that comes in pieces, in any order; pieces may be written by one thread only.

    Attributes:
        size: Size of the whole file in bytes; None while it is still being filmed.
        reason: Why the transfer ended before its end, for people; empty if it has not.
    """

    def __init__(self, path: Path, size: int | None) -> None:
        """Create an empty file and its note."""
        self.path, self.size, self.reason, self._ended = path, size, "", False
        self._spans: list[list[int]] = []
        self._lock = threading.Lock()
        path.touch(exist_ok=False)
        self._write_note()

    @property
    def received(self) -> int:
        """Number of bytes that have come."""
        return sum(end - start for start, end in self._spans)

    @property
    def ended(self) -> bool:
        """Return whether nothing more will come."""
        return self._ended or self.received == self.size

    def write(self, offset: int, content: bytes) -> None:
        """Write a piece; what has come before may be in it again."""
        with self._lock:
            with self.path.open("r+b") as file:
                file.seek(offset)
                file.write(content)
            merged: list[list[int]] = []
            for start, end in sorted([*self._spans, [offset, offset + len(content)]]):
                if merged and start <= merged[-1][1]:
                    merged[-1][1] = max(merged[-1][1], end)
                else:
                    merged.append([start, end])
            self._spans = merged
            self._write_note()

    def end(self, reason: str = "") -> None:
        """Expect no more; what has come is read."""
        self._ended, self.reason = True, self.reason or reason
        with suppress(OSError):  # of a full disk; readers then wait for their time without a byte
            self._write_note()

    def next_offset(self) -> int:
        """Where the piece that is of most use begins: the index of a video, else its first gap."""
        gap = self._spans[0][1] if self._spans and self._spans[0][0] == 0 else 0
        return gap if self.size is None else self._missing_index(gap)

    def _missing_index(self, gap: int) -> int:
        """The first byte that is missing up to the end of the index, which may come last."""
        at = 0
        with self.path.open("rb") as file:
            while self.size is not None and at + 16 <= self.size:
                if self._end_of_span(at) < at + 16:
                    return self._end_of_span(at)
                file.seek(at)
                head = file.read(16)
                length = int.from_bytes(head[:4])
                length = int.from_bytes(head[8:]) if length == 1 else length
                if head[4:8] not in INDEX_BOXES or length < 8:
                    return gap
                if head[4:8] == b"moov":
                    end = self._end_of_span(at)
                    return end if end < min(at + length, self.size) else gap
                at += length
        return gap

    def _end_of_span(self, offset: int) -> int:
        """The end of what has come without a gap from an offset on."""
        return next((end for start, end in self._spans if start <= offset < end), offset)

    def _write_note(self) -> None:
        note = {"size": self.size, "spans": self._spans, "ended": self.ended, "reason": self.reason}
        write_text_atomically(note_of(self.path), json.dumps(note), replace=True)


def note_of(path: Path) -> Path:
    """The note beside a video that is being received."""
    return path.with_name(path.name + ".received")


@final
class _GrowingReader:
    """Reads what has come of a file, and waits for what has not; `waits` counts the waits."""

    def __init__(self, path: Path, pace: PacingClock, idle_s: float) -> None:
        self._file, self._pace, self._idle_s = path.open("rb", buffering=0), pace, idle_s
        self._note, self._at, self.waits = note_of(path), 0, 0
        self._state: dict[str, Any] = {"spans": []}
        self._look()

    @property
    def is_whole_known(self) -> bool:
        """Whether it is a file of known size, not a stream."""
        return self._state["size"] is not None

    @property
    def reason(self) -> str:
        """Why the file ends early, if it does."""
        return self._state["reason"]

    def read(self, count: int) -> bytes:
        """Read some of what has come; wait for at least a byte, unless no more will come."""
        if not self._available():
            self.waits += 1
            deadline = self._pace.now() + self._idle_s
            while not self._available():
                if self._state["ended"] or self._pace.stopped or self._pace.now() > deadline:
                    return b""
                self._pace.wait_until(self._pace.now() + POLL_S)
                before = self._state["spans"]
                self._look()
                if self._state["spans"] != before:
                    deadline = self._pace.now() + self._idle_s
        self._file.seek(self._at)
        content = self._file.read(min(count, self._available()))
        self._at += len(content)
        return content

    def seekable(self) -> bool:
        """Return whether to seek: only MP4 and QuickTime need it, of a file of known size."""
        if not self.is_whole_known:
            return False
        head, self._at = self.read(8), 0
        return head[4:8] in INDEX_BOXES

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go to a place, which need not have come."""
        self._at = offset + (0, self._at, self._state["size"] or 0)[whence]
        return self._at

    def tell(self) -> int:
        """The place to which `seek` has gone, or `read`."""
        return self._at

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _available(self) -> int:
        spans = self._state["spans"]
        return next((end - self._at for start, end in spans if start <= self._at < end), 0)

    def _look(self) -> None:
        self._state = json.loads(self._note.read_text(encoding="utf-8"))


@final
class ReceivedVideo(FrameSource):
    """The frames of a video that is still being received, as they come; none is lost.

    Of a file they are due whenever they are read; of what is being filmed, at the speed of the
    film, counted from where its reader last had to wait for bytes.
    """

    paced = True

    def __init__(
        self, path: Path, selection: FrameSelection, pace: PacingClock, *, idle_s: float
    ) -> None:
        """Wait for the first frame; an InputError if none can be decoded.

        The video ends when no byte has come for `idle_s` seconds.
        """
        super().__init__(path, selection, pace)
        self._reader = _GrowingReader(path, pace, idle_s)
        self.skippable = not self._reader.is_whole_known
        options = {} if self._reader.is_whole_known else STREAM_OPTIONS
        try:
            self._container: Any = av.open(self._reader, options=options)
            stream = self._container.streams.video[0]
            self._decoded = decode(self._container, stream, at_once=not self._reader.is_whole_known)
            first = next(self._decoded, None)
            rgb = None if first is None else first.rgb(MAX_LONGER_PX)
        except (FFmpegError, ValueError, IndexError, OSError) as cause:
            self._reader.close()
            raise InputError(self._unreadable()) from cause
        if first is None or rgb is None:
            raise InputError(self._unreadable())
        self._first, self.size_px = first, (rgb.shape[1], rgb.shape[0])
        self._began = pace.now() - first.time_s

    def frames(self) -> Iterator[Frame]:
        """The frames as they come; to be read once."""
        try:
            yield from self._selected()
        finally:
            self._container.close()
            self._reader.close()
        if self._reader.reason:
            self._warn(self._reader.reason)

    def _selected(self) -> Iterator[Frame]:
        waits = self._reader.waits
        for index, decoded in enumerate(chain([self._first], self._decoded)):
            now = self._pace.now()
            if waits != self._reader.waits:
                waits, self._began = self._reader.waits, now - decoded.time_s
            due_s = now if self._reader.is_whole_known else self._began + decoded.time_s
            if self._pace.stopped or self.selection.is_past_end(index):
                return
            rgb = decoded.rgb(MAX_LONGER_PX) if self.selection.contains(index) else None
            if rgb is None or rgb.shape[1::-1] != self.size_px:
                continue
            time_s, flags = decoded.time_s, decoded.flags
            yield Frame(index=index, time_s=time_s, rgb=rgb, flags=flags, due_s=due_s)

    def _unreadable(self) -> str:
        why = f" {self._reader.reason}" if self._reader.reason else ""
        return (
            f"No frame of {self.path.name} could be decoded.{why} Expected a video as phones film "
            "it: MP4, MOV or WebM."
        )
