"""Find captures, in folders and in tables, with the options of each."""

import csv
import functools
import hashlib
import io
import json
import re
import shlex
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path

from capture.image_folder import IMAGE_SUFFIXES
from capture.input_error import InputError
from capture.source_opening import SIDE_VIDEO_PREFIXES
from capture.video import VIDEO_SUFFIXES
from instant_avatar.batching.remote_files import ListedFile, is_url, list_files, read_text
from instant_avatar.cli.command_line import parse_arguments
from instant_avatar.cli.shared_options import USUAL_NAMES
from instant_avatar.run.ingest_arguments import IngestArguments
from preprocess.capture_inputs import CAMERA_NAMES, MASK_NAMES, POSE_FILE_NAMES

PART_NAMES = frozenset((*POSE_FILE_NAMES, *MASK_NAMES, *CAMERA_NAMES))
"""Names of files and folders beside the video of a capture folder."""
KEYWORDS = re.compile(r"static|solve|segmenter:.*")
"""Values of path options that are no paths."""
Options = tuple[dict[str, str], tuple[str, ...]]
"""Options of ia-ingest: paths, absolute or URLs, by option, and the words of all others."""
Row = tuple[str, str, Options, Mapping[str, ListedFile]]
"""Name, video, options of its own, and files of a capture."""


@dataclass(frozen=True, kw_only=True)
class BatchCapture:
    """A capture to learn.

    Attributes:
        name: Unique; the name of its folder in --out.
        video: Absolute path, or URL, of the video or folder.
        paths: Absolute paths, or URLs, of its parts, by option of ia-ingest.
        options: Other options, as words of ia-ingest.
        sources: URLs of the files that must be fetched.
        input_key: Fingerprint of the names, sizes and times of its files.
        options_key: Fingerprint of its options.
    """

    name: str
    video: str
    paths: dict[str, str] = field(default_factory=dict)
    options: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    input_key: str
    options_key: str

    def places(self) -> list[str]:
        """Return the paths and URLs of its video and its parts."""
        return [p for p in (self.video, *self.paths.values()) if not KEYWORDS.fullmatch(p)]


def find_captures(places: Iterable[str], common: Iterable[str] = ()) -> list[BatchCapture]:
    """Find the captures in folders, files, tables and URLs, in order of their names.

    Options in `common` are for all captures; a capture's own take precedence.
    """
    paths, words = split_paths(common, Path.cwd().as_posix())
    captures: dict[str, BatchCapture] = {}
    for place in places:
        place = place.rstrip("/") if is_url(place) else Path(place).absolute().as_posix()
        is_table = place.lower().endswith(".csv")
        rows = list(_table_rows(place) if is_table else _folder_captures(place, list_files(place)))
        for name, video, (own_paths, own_words), files in rows:
            capture = _make_capture(name, video, ({**paths, **own_paths}, words + own_words), files)
            other = captures.setdefault(capture.name, capture)
            if other != capture:
                raise InputError(
                    f"Two captures would be called {capture.name}: {other.video} and "
                    f"{capture.video}. Rename one, or give names in a table (docs/batch.md)."
                )
        if not rows:
            raise InputError(
                f"{place} holds no capture: expected videos, capture folders (a video or images/ "
                "with poses or masks), or a table (.csv). See docs/batch.md."
            )
    return [captures[name] for name in sorted(captures)]


@functools.cache
def parse_options(words: tuple[str, ...]) -> IngestArguments:
    """Parse and check options of ia-ingest, other than paths, for captures of a batch.

    Raises:
        SystemExit: If the words cannot be parsed.
    """
    parsed = parse_arguments(IngestArguments, "ia-ingest", ["CAPTURE", *words])
    for each in fields(parsed):
        if (
            each.name in ("out", "resume", "overwrite", "json", "view", "live", "realtime")
            and getattr(parsed, each.name) != each.default
        ):
            raise InputError(f"--{each.name} cannot be given for captures of a batch. Omit it.")
    parsed.validate()
    return parsed


def split_paths(words: Iterable[str], base: str) -> Options:
    """Separate the options of ia-ingest that are paths from all others.

    Values may follow as --option=value. Relative paths start from `base`, a folder or URL.
    """
    paths, others, rest = {}, [], deque(words)
    while rest:
        word = rest.popleft()
        option, equals, value = word.partition("=")
        if option in ("--poses", "--masks", "--cameras", "--body") and (equals or rest):
            paths[option] = _absolute(value if equals else rest.popleft(), base)
        else:
            others.append(word)
    return paths, tuple(others)


def _absolute(value: str, base: str) -> str:
    if is_url(value) or value.startswith("/") or KEYWORDS.fullmatch(value):
        return value
    return f"{base}/{value}" if is_url(base) else Path(base, value).absolute().as_posix()


def _make_capture(
    name: str, video: str, options: Options, files: Mapping[str, ListedFile]
) -> BatchCapture:
    paths, words = options
    parsed = parse_options(words)
    above = video.rsplit("/", 1)[0] + "/"  # relative to it: captures may be moved
    content = [(path.removeprefix(above), *state) for path, state in sorted(files.items())]
    chosen = {
        each.name: value
        for each in fields(parsed)
        if (value := getattr(parsed, each.name)) != each.default
        and each.name not in ("video", "threads", "force")  # of an avatar that is done, no change
    }
    chosen |= {option: Path(path).name for option, path in paths.items()}
    return BatchCapture(
        name=re.sub(r"[^\w.-]+", "-", name).strip("-._") or "capture",
        video=video,
        paths=paths,
        options=words,
        sources=tuple(filter(is_url, files)),
        input_key=_fingerprint(content),
        options_key=_fingerprint(chosen),
    )


def _fingerprint(content: object) -> str:
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _folder_captures(
    place: str, files: Mapping[str, ListedFile], prefix: str = ""
) -> Iterator[Row]:
    """Yield the captures at a place and below it, of which `files` are all files.

    A folder is a capture as a whole if it has images/, a video with poses, masks or cameras, or
    pictures and no video; otherwise each video in it, and its folders are searched. Names start
    with `prefix`: the folders above, with hyphens.
    """
    if list(files) == [place]:
        yield Path(place).stem, place, ({}, ()), files
        return
    entries: dict[str, dict[str, ListedFile]] = defaultdict(dict)
    for path, state in files.items():
        entries[path[len(place) + 1 :].split("/")[0]][path] = state
    names = [name for name in entries if f"{place}/{name}" in files]
    videos = [name for name in names if Path(name).suffix.lower() in VIDEO_SUFFIXES]
    films = [name for name in videos if not name.lower().startswith(SIDE_VIDEO_PREFIXES)] or videos
    pictures = [name for name in names if Path(name).suffix.lower() in IMAGE_SUFFIXES]
    is_film = len(films) == 1 and not PART_NAMES.isdisjoint(entries)
    if "images" in entries or is_film or (not videos and len(pictures) > 1):
        yield prefix.rstrip("-") or Path(place).name, place, ({}, ()), files
        return
    for name in sorted(entries):
        path = f"{place}/{name}"
        if name in films:
            alone = len(films) == 1 and Path(name).stem.lower() in USUAL_NAMES
            called = prefix.rstrip("-") or Path(place).name if alone else prefix + Path(name).stem
            yield called, path, ({}, ()), entries[name]
        elif name not in names and name not in PART_NAMES:
            yield from _folder_captures(path, entries[name], f"{prefix}{name}-")


def _table_rows(table: str) -> Iterator[Row]:
    """Yield the captures of a CSV file: columns capture, name, and options of ia-ingest."""
    base = table.rsplit("/", 1)[0]
    rows = csv.DictReader(io.StringIO(read_text(table)), restkey="more cells than columns")
    for number, row in enumerate(rows, start=1):
        where = f"{table}, row {number}"
        cells = {column.strip(): str(cell) for column, cell in row.items() if cell}
        if "capture" not in cells:
            raise InputError(f"{where}: no capture; expected a column `capture`.")
        video = _absolute(cells.pop("capture"), base)
        name = cells.pop("name", Path(video).stem)
        paths, words = split_paths(_row_words(cells), base)
        try:
            parse_options(words)
        except SystemExit:
            raise InputError(f"{where}: ia-ingest cannot take {shlex.join(words)}.") from None
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
        files = list_files(video)
        if not files:
            raise InputError(f"{where}: {video} does not exist; check the path.")
        for path in paths.values():
            files |= {} if KEYWORDS.fullmatch(path) else list_files(path)
        yield name, video, (paths, words), files


def _row_words(cells: Mapping[str, str]) -> Iterator[str]:
    """Yield the cells of a row as words of ia-ingest; yes and no are flags."""
    for column, cell in cells.items():
        option = column.lstrip("-").replace("_", "-")
        yield f"--no-{option}" if cell.lower() == "no" else f"--{option}"
        if cell.lower() not in ("yes", "no"):
            yield cell
