"""The files of a page that plays an avatar in a browser: package, motion, runtime, no CDN.

onnxruntime-web runs the graph: one pinned release, stored with the page.
"""

import base64
import hashlib
import html
import io
import os
import sys
import tarfile
import zlib
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np

from capture.atomic_files import atomic_file
from capture.input_error import InputError, quote_command
from export.package.package_file import read_package
from preprocess.body.body_pose import Motion

ORT_WEB_VERSION = "1.30.0"
"""Release of the npm package `onnxruntime-web` (MIT)."""
INTEGRITY = (
    "sha512-q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZ"
    "ClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ=="
)
"""npm's checksum of that release's tarball."""
WEB = Path(__file__).with_name("web")
"""Folder of the page's own files."""
CACHE = {"win32": "AppData/Local", "darwin": "Library/Caches"}.get(sys.platform, ".cache")
"""Folder in the user's home for files that can be fetched again."""
RUNTIME_FOLDER = (
    Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser(f"~/{CACHE}"))
    / "instant-avatar-stream"
    / f"onnxruntime-web-{ORT_WEB_VERSION}"
)
"""Folder of the runtime, which is fetched once for all installations."""
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


def install_runtime(tarball: bytes) -> None:
    """Store what the page needs of npm's tarball in `RUNTIME_FOLDER`.

    Raises:
        InputError: If its checksum is another.
    """
    found = "sha512-" + base64.b64encode(hashlib.sha512(tarball).digest()).decode()
    if found != INTEGRITY:
        raise InputError(
            f"The tarball is not onnxruntime-web {ORT_WEB_VERSION}: its checksum is {found}, "
            f"expected {INTEGRITY}. Nothing was kept."
        )
    RUNTIME_FOLDER.mkdir(parents=True, exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(tarball)) as archive:
        for name, member in TARBALL_MEMBERS.items():
            file = archive.extractfile(member)
            assert file is not None
            with atomic_file(RUNTIME_FOLDER / name) as part:
                part.write_bytes(file.read())
    for name in LICENCE_FILES:
        notice = resources.files("onnxruntime").joinpath(name)
        with atomic_file(RUNTIME_FOLDER / name) as part:
            part.write_bytes(notice.read_bytes())


def runtime_files() -> dict[str, bytes]:
    """Read the stored files by name; `InputError` says how to fetch a missing one."""
    wanted = (*TARBALL_MEMBERS, *LICENCE_FILES)
    missing = [name for name in wanted if not (RUNTIME_FOLDER / name).is_file()]
    if missing:
        command = quote_command(sys.executable, "-m", "instant_avatar.animation.web_server")
        raise InputError(
            f"The browser page needs onnxruntime-web, which is not in {RUNTIME_FOLDER}. Fetch it "
            f"once with npm, which comes with Node.js (33 MB): {command}"
        )
    return {name: (RUNTIME_FOLDER / name).read_bytes() for name in wanted}


PAGE_SUFFIXES = (".html", ".css", ".js", ".svg")
"""Suffixes of the page's own files."""
PACKAGE_FILE, MOTION_FILE = "avatar.iavatar", "motion.npz"
"""The package and its motion, as index.html names them."""
PACKED_WASM_FILE = f"{WASM_FILE}.zlib"
"""The WebAssembly module as engine.js reads it: not all hosts compress what they send."""


_compress = lru_cache(maxsize=1)(zlib.compress)
"""Packs the WebAssembly module, once a process."""


def build_page(
    path: Path, motions: Mapping[str, bytes], *, name: str, compression_level: int = 6
) -> dict[str, bytes]:
    """Build all files of the page by relative path; index.html is the one to open.

    The page has all tiers of the package, and motions (`encode_motion`) by the names that it shows,
    of which the first plays at once. zlib's level: 1 for a local browser, 6 for a host.
    """
    pages = player_files(motions, compression_level=compression_level)
    read_package(path)  # every checksum
    pages["index.html"] = titled(pages["index.html"], name)
    return pages | {PACKAGE_FILE: path.read_bytes()}


def player_files(motions: Mapping[str, bytes], *, compression_level: int) -> dict[str, bytes]:
    """Build the page's files but its package, the same for every avatar; arguments as above."""
    files = [MOTION_FILE, *(f"{motion.lower()}.npz" for motion in list(motions)[1:])]
    options = [
        f'<option value="{file}">{motion}</option>'
        for file, motion in zip(files, motions, strict=True)
    ]
    pages, runtime = static_page_files(), runtime_files()
    index = pages["index.html"].replace(b"<!-- motions -->", "".join(options).encode())
    runtime[PACKED_WASM_FILE] = _compress(runtime.pop(WASM_FILE), compression_level)
    # hosts such as nginx serve .mjs as application/octet-stream, which browsers do not run
    runtime["ort.js"] = runtime.pop(SCRIPT_FILE)
    return {
        **pages,
        "index.html": index,
        **dict(zip(files, motions.values(), strict=True)),
        **{f"runtime/{file}": held for file, held in runtime.items()},
    }


def titled(index: bytes, name: str) -> bytes:
    """Name index.html after its avatar."""
    title = f"<title>{html.escape(name)}</title>".encode()
    return index.replace(b"<title>Avatar</title>", title)


def encode_motion(motion: Motion, fps: float) -> bytes:
    """Encode the valid poses as an .npz file with InstantAvatar's keys, and their rate."""
    content = io.BytesIO()
    arrays = {
        "global_orient": motion.root_rotations,
        "body_pose": motion.joint_rotations.reshape(-1, 69),
        "transl": motion.root_translations,
    }
    rows = {name: array[motion.valid].astype(np.float32) for name, array in arrays.items()}
    np.savez_compressed(content, fps=np.float32(fps), **rows)
    return content.getvalue()


def static_page_files() -> dict[str, bytes]:
    """Read the page's own files, the same for every avatar."""
    files = sorted(file for file in (WEB / "page").iterdir() if file.suffix in PAGE_SUFFIXES)
    return {file.name: file.read_bytes() for file in files}
