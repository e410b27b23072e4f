"""onnxruntime-web, which runs the graph in a browser: one pinned release, stored with the page."""

import base64
import hashlib
import io
import shlex
import sys
import tarfile
from importlib import resources
from pathlib import Path

from capture.atomic_files import atomic_file
from capture.input_error import InputError

ORT_WEB_VERSION = "1.30.0"
"""Release of the npm package `onnxruntime-web` (MIT)."""
INTEGRITY = (
    "sha512-q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZ"
    "ClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ=="
)
"""npm's checksum of that release's tarball."""
FOLDER = Path(__file__).with_name("onnxruntime")
"""Folder of the files: ignored by git, but part of wheels built after `make web`."""
SCRIPT_FILE = "ort.mjs"
"""The script, as stored."""
WASM_FILE = "ort.wasm"
"""The WebAssembly module, as stored."""
TARBALL_MEMBERS = {
    SCRIPT_FILE: "package/dist/ort.wasm.bundle.min.mjs",
    WASM_FILE: "package/dist/ort-wasm-simd-threaded.wasm",
}
"""Stored files by name, and the tarball's members they come from."""
LICENCE_FILES = ("LICENSE", "ThirdPartyNotices.txt")
"""Notices, from the Python package of the same project, as the npm package has none."""
MISSING_MESSAGE = (
    "The browser page needs onnxruntime-web, which is not here: {why}. In a checkout, `make web` "
    "fetches it (npm package onnxruntime-web {version}, 33 MB once), anywhere else "
    "{python} -m apps.fetch_runtime"
)
"""Message of `runtime_files` for a missing file."""


def install_runtime(tarball: bytes, folder: Path | None = None) -> None:
    """Store what the page needs of npm's tarball.

    Args:
        tarball: Content of the pinned release's tarball.
        folder: Where to store it; `FOLDER` if None.

    Raises:
        InputError: If its checksum is another.
        OSError: If the disk is full.
    """
    folder = folder or FOLDER
    found = "sha512-" + base64.b64encode(hashlib.sha512(tarball).digest()).decode()
    if found != INTEGRITY:
        raise InputError(
            f"The tarball is not onnxruntime-web {ORT_WEB_VERSION}: its checksum is {found}, "
            f"expected {INTEGRITY}. Nothing was kept."
        )
    folder.mkdir(exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(tarball)) as archive:
        for name, member in TARBALL_MEMBERS.items():
            file = archive.extractfile(member)
            assert file is not None
            with atomic_file(folder / name) as part:
                part.write_bytes(file.read())
    for name in LICENCE_FILES:
        notice = resources.files("onnxruntime").joinpath(name)
        with atomic_file(folder / name) as part:
            part.write_bytes(notice.read_bytes())


def runtime_files(folder: Path | None = None) -> dict[str, bytes]:
    """Read the stored files by name.

    Raises:
        InputError: If one is missing; the message has the command that fetches it.
    """
    folder = folder or FOLDER
    wanted = (*TARBALL_MEMBERS, *LICENCE_FILES)
    missing = [name for name in wanted if not (folder / name).is_file()]
    if missing:
        why, python = f"no {folder / missing[0]}", shlex.quote(sys.executable)
        raise InputError(MISSING_MESSAGE.format(why=why, version=ORT_WEB_VERSION, python=python))
    return {name: (folder / name).read_bytes() for name in wanted}
