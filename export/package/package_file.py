"""The `.iavatar` file: manifest, graphs and compact streams in a zip, written atomically."""

import hashlib
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import UInt8

from capture.atomic_files import AtomicFile
from capture.input_error import InputError
from export.package.manifest import Manifest
from export.package.player_tables import PlayerTables
from export.package.table_codec import decode_tables, encode_tables

MANIFEST_ENTRY = "manifest.json"
"""Entry of the manifest."""
PREVIEW_ENTRY = "preview.png"
"""Entry of the preview."""
COARSE_GRAPH = "coarse"
"""Name of the graph that draws one depth layer in one block: a page's session of it is made in half
the time, and draws the first picture. Older packages lack it."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AvatarPackage:
    """Content of a package, from which an avatar is drawn without torch.

    Attributes:
        graphs: ONNX model of each tier, and the coarse one (`COARSE_GRAPH`); tables are external.
        tables: Tables of each tier, the same object for all.
        golden: Pictures of `manifest.golden`, straight alpha.
        preview: A PNG.
    """

    manifest: Manifest
    graphs: Mapping[str, bytes]
    tables: Mapping[str, PlayerTables]
    golden: tuple[UInt8[np.ndarray, "_ _ 4"], ...]
    preview: bytes


def graph_entry(tier: str) -> str:
    """Return the entry of a tier's graph, or of the coarse one; "hq" has player.onnx."""
    return "player.onnx" if tier == "hq" else f"{tier}/player.onnx"


def stream_entry(stream: str) -> str:
    """Return the entry of a stream, which all tiers share."""
    return f"hq/{stream}.bin"


def golden_entry(number: int) -> str:
    """Return the entry of a golden frame, raw RGBA bytes."""
    return f"golden/{number}.rgba"


def write_package(package: AvatarPackage, path: Path) -> int:
    """Write a package under a temporary name, flush it to the disk, rename it; return its bytes."""
    with PackageWriter(path) as draft:
        draft.add_tables(package.tables["hq"])
        return draft.finish(package)


def update_metrics(path: Path, metrics: Mapping[str, Any]) -> int:
    """Add or replace metrics in a package that was just written; return its new size in bytes."""
    with zipfile.ZipFile(path) as old, PackageWriter(path) as draft:
        manifest = Manifest.from_json(old.read(MANIFEST_ENTRY))
        draft.copy_entries(old)
        return draft.close(replace(manifest, metrics={**manifest.metrics, **metrics}))


@final
class PackageWriter:
    """Writes a package under a temporary name, and removes it unless it is finished.

    Tables can be added and compressed while the player that draws them is still being checked.
    """

    def __init__(self, path: Path, *, level: int = 6) -> None:
        """Open nothing yet; `level` is zlib's, 1 for a package that another one soon replaces."""
        self._path, self._level = path, level
        self._sums: dict[str, str] = {}

    def __enter__(self) -> "PackageWriter":
        """Open the temporary file."""
        self._draft = AtomicFile(self._path)
        self._file = self._draft.temporary_path.open("wb")
        self._archive = zipfile.ZipFile(self._file, "w")
        return self

    def add_tables(self, tables: PlayerTables) -> None:
        """Add the streams of all tiers' tables."""
        for name, stream in encode_tables(tables).items():
            self._add(stream_entry(name), stream)

    def finish(self, package: AvatarPackage) -> int:
        """Add graphs, golden frames, preview and manifest; rename it; return its size in bytes."""
        for tier, graph in package.graphs.items():
            self._add(graph_entry(tier), graph)
        self._add(PREVIEW_ENTRY, package.preview)
        for number, frame in enumerate(package.golden):
            self._add(golden_entry(number), frame.tobytes())
        return self.close(package.manifest)

    def copy_entries(self, archive: zipfile.ZipFile) -> None:
        """Add all entries of an older package but its manifest."""
        for name in archive.namelist():
            if name != MANIFEST_ENTRY:
                self._add(name, archive.read(name))

    def close(self, manifest: Manifest) -> int:
        """Add the manifest with checksums of all entries; rename it; return its size in bytes."""
        manifest = replace(manifest, sha256=dict(self._sums))
        self._add(MANIFEST_ENTRY, manifest.to_json().encode())
        self._archive.close()
        size = self._file.tell()
        self._file.close()
        self._draft.commit()
        return size

    def __exit__(self, *_: object) -> None:
        """Remove an unfinished package."""
        with suppress(OSError, ValueError):  # a full disk fails again when the rest is flushed
            self._archive.close()
        with suppress(OSError):
            self._file.close()
        self._draft.discard()

    def _add(self, name: str, content: bytes) -> None:
        self._sums[name] = hashlib.sha256(content).hexdigest()
        # one time stamp, so that equal avatars give equal bytes
        info = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
        self._archive.writestr(info, content, zipfile.ZIP_DEFLATED, self._level)


def read_package(path: Path, *, tier: str | None = "hq") -> AvatarPackage:
    """Read one tier, or all if None; check the size before reading, and every checksum after.

    Raises:
        InputError: If the file is missing, truncated, altered or not a package, or lacks the tier.
    """
    try:
        if path.exists() and not path.is_file():  # a folder; a pipe would never end
            raise InputError(_not_a_file_message(path))
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(info.file_size for info in archive.infolist())
            if unpacked > 512 << 20:  # those of an avatar hold 20 MB
                raise InputError(f"{path} unpacks to {unpacked >> 20} MB; no package does.")
            return _read_archive(archive, path, tier)
    except FileNotFoundError:
        raise InputError(f"There is no package {path}. Make one with ia-ingest.") from None
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError) as error:
        raise InputError(
            f"{path} is not a package, or is truncated or altered ({error}). Copy or export it "
            "again."
        ) from error


def _not_a_file_message(path: Path) -> str:
    found = sorted(path.glob("*.iavatar")) if path.is_dir() else []
    if found:
        return f"{path} is a folder; the package in it is {found[0]}. Give that."
    what = "a folder" if path.is_dir() else "no file"
    return f"{path} is {what}; the .iavatar file that ia-ingest or ia-export wrote was expected."


def _read_archive(archive: zipfile.ZipFile, path: Path, tier: str | None) -> AvatarPackage:
    def read(name: str) -> bytes:
        try:
            return archive.read(name)
        except KeyError:
            raise InputError(f"{path} is incomplete: {name} is missing. Export it again.") from None

    try:
        manifest = Manifest.from_json(read(MANIFEST_ENTRY))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    if tier is not None and tier not in manifest.tiers:
        known = ", ".join(sorted(manifest.tiers))
        raise InputError(f"{path} has no tier {tier!r}; it has: {known}.")

    def checked(name: str) -> bytes:
        content = read(name)
        if hashlib.sha256(content).hexdigest() != manifest.sha256.get(name):
            raise InputError(
                f"{path} was altered: {name} is not what was written. Export it again."
            )
        return content

    layout = manifest.tiers["hq"].layout
    streams = {name: checked(stream_entry(name)) for name in layout.stream_types()}
    tiers = {name: n for name, n in manifest.tiers.items() if tier in (None, name)}
    has_coarse = tier is None and graph_entry(COARSE_GRAPH) in manifest.sha256
    graphs = [*tiers, COARSE_GRAPH] if has_coarse else [*tiers]
    try:
        tables = decode_tables(streams, layout)
        golden = [
            np.frombuffer(checked(golden_entry(number)), dtype=np.uint8).reshape(
                *frame.camera.size_px[::-1], 4
            )
            for number, frame in enumerate(manifest.golden)
        ]
    except ValueError as error:  # sizes that the manifest does not say
        raise InputError(f"{path} is damaged: {error}. Export it again.") from error
    return AvatarPackage(
        manifest=manifest,
        graphs={name: checked(graph_entry(name)) for name in graphs},
        tables=dict.fromkeys(tiers, tables),
        golden=tuple(golden),
        preview=checked(PREVIEW_ENTRY),
    )
