"""Finds captures: in folders, beside one another, and in manifests, with the options of each."""

import csv
import hashlib
import io
import json
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, get_args, get_type_hints

from apps.batching.remote_files import ListedFile, is_url, list_files, read_text
from apps.run.ingest_arguments import IngestArguments
from capture.image_folder import IMAGE_SUFFIXES
from capture.input_error import InputError
from capture.source_opening import SIDE_VIDEO_PREFIXES
from capture.video import VIDEO_SUFFIXES
from preprocess.capture_paths import CAMERA_NAMES, MASK_NAMES, POSE_FILE_NAMES

MANIFEST_SUFFIXES = (".csv", ".jsonl", ".ndjson")
"""Endings of manifests."""
PART_NAMES = {"poses": POSE_FILE_NAMES, "masks": MASK_NAMES, "cameras": CAMERA_NAMES}
"""Names of the parts of a capture, by the option that names them."""
PATH_OPTIONS = ("poses", "masks", "cameras", "body")
"""Options whose values are paths."""
KEYWORDS = re.compile(r"static|solve|segmenter:.*")
"""Values of path options that are no paths."""
BATCH_OPTIONS = frozenset(
    ("video", "out", "resume", "overwrite", "json", "view", "live", "realtime", "idle_seconds")
)
"""Options of ia-ingest that a batch sets itself, or that need a person or a camera."""
COST_OPTIONS = frozenset({"threads"})
"""Options that change the cost of an avatar; changing them does not train it again."""
TRUTH_WORDS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
"""Values of flags in a manifest."""


@dataclass(frozen=True, kw_only=True)
class BatchCapture:
    """A capture to learn.

    Attributes:
        name: Unique; the name of its folder in --out.
        video: Absolute path, or URL, of the video or folder.
        options: Options of ia-ingest by field name.
        sources: URL and size of each file that must be fetched.
        input_key: Fingerprint of the names, sizes and times of its files.
        options_key: Fingerprint of its options.
    """

    name: str
    video: str
    options: dict[str, Any]
    sources: tuple[tuple[str, int], ...]
    input_key: str
    options_key: str

    def paths(self) -> list[Path]:
        """Return the local files and folders that it names."""
        options = [str(self.options[key]) for key in PATH_OPTIONS if key in self.options]
        named = [value for value in options if not KEYWORDS.fullmatch(value)]
        return [Path(place) for place in (self.video, *named) if not is_url(place)]


def find_captures(places: Iterable[str], common: Mapping[str, Any]) -> list[BatchCapture]:
    """Find the captures in folders, files, manifests and URLs.

    Args:
        places: Paths or URLs.
        common: Options for all captures; those of a manifest's row come first.

    Returns:
        Captures in order of their names.

    Raises:
        InputError: If a place holds no capture, or two captures have the same name.
    """
    found: dict[str, BatchCapture] = {}
    for place in places:
        place = place.rstrip("/") if len(place) > 1 else place
        before = len(found)
        rows = (
            _manifest_rows(place)
            if place.lower().endswith(MANIFEST_SUFFIXES)
            else _listed_captures(place, list_files(place))
        )
        for name, video, options, files in rows:
            capture = _make_capture(name, video, {**common, **options}, files)
            other = found.setdefault(capture.name, capture)
            if other != capture:
                raise InputError(
                    f"Two captures would be called {capture.name}: {other.video} and "
                    f"{capture.video}. Rename one, or give names in a manifest (docs/batch.md)."
                )
        if len(found) == before:
            raise InputError(
                f"{place} holds no capture: expected videos, capture folders (a video or images/ "
                "with poses or masks), or a manifest (.csv, .jsonl). See docs/batch.md."
            )
    return [found[name] for name in sorted(found)]


def _make_capture(
    name: str, video: str, options: dict[str, Any], files: Mapping[str, ListedFile]
) -> BatchCapture:
    name = re.sub(r"[^\w.-]+", "-", name).strip("-._") or "capture"
    defaults = {each.name: each.default for each in fields(IngestArguments)}
    options = {key: value for key, value in options.items() if value != defaults[key]}
    content = [(_relative(path, video), *state) for path, state in sorted(files.items())]
    chosen = {
        key: Path(str(value)).name if key in PATH_OPTIONS else value
        for key, value in sorted(options.items())
        if key not in COST_OPTIONS
    }
    return BatchCapture(
        name=name,
        video=video,
        options=options,
        sources=tuple((path, state.size) for path, state in files.items() if is_url(path)),
        input_key=_fingerprint(content),
        options_key=_fingerprint(chosen),
    )


def _fingerprint(content: object) -> str:
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _relative(path: str, video: str) -> str:
    """Return a path relative to the capture's parent folder, so that captures may be moved."""
    above = video.rsplit("/", 1)[0] + "/"
    return path.removeprefix(above)


# --- folders and videos --------------------------------------------------------------------------

Found = tuple[str, str, dict[str, Any], Mapping[str, ListedFile]]
"""Name, video, options and files of a capture."""


def _listed_captures(place: str, files: Mapping[str, ListedFile]) -> Iterator[Found]:
    """Group the files of a folder, or a single video with its parts, into captures."""
    if not is_url(place):
        place = Path(place).absolute().as_posix()
        files = {Path(path).absolute().as_posix(): state for path, state in files.items()}
    if list(files) == [place]:  # a file: its parts lie beside it
        above = place.rsplit("/", 1)[0]
        beside = files if place.startswith("http") else list_files(above)
        kept = _stem_parts(_Tree(above, beside), Path(place).name)
        options = {option: f"{above}/{name}" for option, name in kept.items()}
        yield Path(place).stem, place, options, _below(beside, [place, *options.values()])
        return
    yield from _tree_captures(_Tree(place, files), Path(place).name, is_root=True)


class _Tree:
    """The files directly in a folder, and its subfolders."""

    def __init__(self, place: str, files: Mapping[str, ListedFile]) -> None:
        self.place, self.all, self.files = place, files, set[str]()
        parts: dict[str, dict[str, ListedFile]] = defaultdict(dict)
        for path, state in files.items():
            head, _, rest = path[len(place) + 1 :].partition("/")
            if rest:
                parts[head][path] = state
            else:
                self.files.add(head)
        self.folders = {name: (f"{place}/{name}", below) for name, below in parts.items()}

    def has(self, name: str) -> bool:
        """Whether a file or folder of that name lies here."""
        return name in self.files or name in self.folders

    def videos(self) -> list[str]:
        """Return the videos; masks and previews do not count beside others."""
        seen = sorted(n for n in self.files if Path(n).suffix.lower() in VIDEO_SUFFIXES)
        return [n for n in seen if not n.lower().startswith(SIDE_VIDEO_PREFIXES)] or seen

    def is_capture(self) -> bool:
        """Whether the folder as a whole is a capture: one source of pictures, and its parts."""
        if "images" in self.folders:
            return True
        videos = self.videos()
        if len(videos) == 1:
            return any(self.has(name) for names in PART_NAMES.values() for name in names)
        pictures = sum(Path(name).suffix.lower() in IMAGE_SUFFIXES for name in self.files)
        return not videos and pictures > 1


def _tree_captures(tree: _Tree, name: str, *, is_root: bool = False) -> Iterator[Found]:
    """Yield the captures in a folder and below it; names join the folders' with hyphens."""
    if tree.is_capture():
        yield name, tree.place, {}, tree.all
        return
    before = "" if is_root else f"{name}-"
    used = set[str]()
    for video in tree.videos():
        kept = _stem_parts(tree, video)
        used.update(kept.values())
        options = {option: f"{tree.place}/{part}" for option, part in kept.items()}
        path = f"{tree.place}/{video}"
        yield before + Path(video).stem, path, options, _below(tree.all, [path, *options.values()])
    for folder, (place, below) in sorted(tree.folders.items()):
        if folder not in used:
            yield from _tree_captures(_Tree(place, below), before + folder)


def _stem_parts(tree: _Tree, video: str) -> dict[str, str]:
    """Return the parts that lie beside a video under its name: anna.mp4, anna_poses.npz, …"""
    stem, found = Path(video).stem, {}
    for option, names in PART_NAMES.items():
        candidates = [f"{stem}{mark}{name}" for mark in "._-" for name in names]
        if option == "poses":
            candidates.append(f"{stem}.npz")
        known = [name for name in candidates if tree.has(name)]
        if known:
            found[option] = known[0]
    return found


def _below(files: Mapping[str, ListedFile], roots: Iterable[str]) -> dict[str, ListedFile]:
    """Return the files that are one of the roots, or lie below one."""
    starts = tuple(root.rstrip("/") + "/" for root in roots)
    return {path: state for path, state in files.items() if (path + "/").startswith(starts)}


# --- manifests -----------------------------------------------------------------------------------


def _manifest_rows(manifest: str) -> Iterator[Found]:
    """Yield the captures of a CSV file, or of JSON lines."""
    text = read_text(manifest)
    whole = manifest if is_url(manifest) else Path(manifest).absolute().as_posix()
    base = whole.rsplit("/", 1)[0]
    for number, row in _read_rows(manifest, text):
        given = {str(key).strip(): value for key, value in row.items() if value not in (None, "")}
        video = given.pop("capture", None) or given.pop("video", None)
        if video is None:
            raise InputError(f"{manifest}, row {number}: no capture; expected a column `capture`.")
        where = f"{manifest}, row {number}"
        name = given.pop("name", None)
        video = _resolve(str(video), base)
        options = parse_options(given, where)
        options = {key: resolve_option(key, value, base) for key, value in options.items()}
        files = list_files(video)
        if not files:
            raise InputError(f"{where}: {video} does not exist; check the path.")
        for key in PATH_OPTIONS:
            if key in options and not KEYWORDS.fullmatch(options[key]):
                files |= list_files(options[key])
        yield str(name or Path(video).stem), video, options, files


def _read_rows(manifest: str, text: str) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """Yield the rows, counted from 1."""
    if manifest.lower().endswith(".csv"):
        try:
            yield from enumerate(csv.DictReader(io.StringIO(text), restkey=""), start=1)
        except csv.Error as error:
            raise InputError(f"{manifest} is no CSV file: {error}.") from error
        return
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = json.loads(line)
        except ValueError as error:
            raise InputError(f"{manifest}, line {number} is no JSON: {error}.") from error
        if not isinstance(row, dict):
            raise InputError(f"{manifest}, line {number} is no JSON object.")
        yield number, row


def parse_options(given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return options of ia-ingest by field name, with values of their types.

    Args:
        given: Names with hyphens or underscores; values may be text.
        where: Start of messages.

    Raises:
        InputError: If an option is unknown, set by the batch itself, or has a wrong value.
    """
    known = {each.name for each in fields(IngestArguments)} - BATCH_OPTIONS
    types = get_type_hints(IngestArguments)
    options: dict[str, Any] = {}
    for column, value in given.items():
        name = column.lstrip("-").replace("-", "_")
        if name not in known:
            raise InputError(
                f"{where}: {column!r} is no option of ia-ingest for captures in a batch. Known: "
                f"{', '.join(sorted(known)).replace('_', '-')}."
            )
        kinds = get_args(types[name]) or (types[name],)
        try:
            if bool in kinds:
                options[name] = TRUTH_WORDS[str(value).strip().lower()]
            elif int in kinds or float in kinds:
                options[name] = (int if int in kinds else float)(value)
            else:
                options[name] = str(value)
        except (KeyError, ValueError):
            raise InputError(f"{where}: {column} is {value!r}, which is not of its type.") from None
    return options


def resolve_option(name: str, value: Any, base: str) -> Any:
    """Return the value of an option; paths become absolute.

    Args:
        name: Field name of the option.
        value: As given.
        base: Folder or URL that relative paths start from.
    """
    return _resolve(str(value), base) if name in PATH_OPTIONS else value


def _resolve(value: str, base: str) -> str:
    """Return the absolute path, or URL, of a value in a manifest."""
    if is_url(value) or KEYWORDS.fullmatch(value):
        return value
    if is_url(base):
        return value if value.startswith("/") else f"{base}/{value}"
    return Path(base, value).absolute().as_posix()
