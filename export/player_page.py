"""The files of a page that plays an avatar in a browser: graph, expanded tables, runtime, no CDN.

onnxruntime-web runs the graph: one pinned release, stored with the page.
"""

import base64
import hashlib
import io
import json
import os
import sys
import tarfile
import zlib
from dataclasses import asdict, dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float, Float32, Shaped

from capture.atomic_files import atomic_file
from capture.input_error import InputError, quote_command
from export.package.manifest import GoldenFrame
from export.package.package_file import AvatarPackage, read_package
from export.player_inputs import graph_initializers
from preprocess.body.body_pose import BodyPose

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
MISSING_MESSAGE = (
    "The browser page needs onnxruntime-web, which is not in {folder}. Fetch it once with npm, "
    "which comes with Node.js (33 MB): {command}"
)
"""Message of `runtime_files` for a missing file."""


def install_runtime(tarball: bytes, folder: Path | None = None) -> None:
    """Store what the page needs of npm's tarball in a folder, `RUNTIME_FOLDER` if None.

    Raises:
        InputError: If its checksum is another.
    """
    folder = folder or RUNTIME_FOLDER
    found = "sha512-" + base64.b64encode(hashlib.sha512(tarball).digest()).decode()
    if found != INTEGRITY:
        raise InputError(
            f"The tarball is not onnxruntime-web {ORT_WEB_VERSION}: its checksum is {found}, "
            f"expected {INTEGRITY}. Nothing was kept."
        )
    folder.mkdir(parents=True, exist_ok=True)
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
    """Read the stored files by name; `InputError` says how to fetch a missing one."""
    folder = folder or RUNTIME_FOLDER
    wanted = (*TARBALL_MEMBERS, *LICENCE_FILES)
    missing = [name for name in wanted if not (folder / name).is_file()]
    if missing:
        command = quote_command(sys.executable, "-m", "instant_avatar.animation.web_server")
        raise InputError(MISSING_MESSAGE.format(folder=folder, command=command))
    return {name: (folder / name).read_bytes() for name in wanted}


PAGE_SUFFIXES = (".html", ".css", ".js", ".svg")
"""Suffixes of the page's own files."""
PAGE_SCRIPT = "ort.js"
"""Name of onnxruntime's script on the page: hosts such as nginx serve .mjs as
application/octet-stream, which browsers do not run."""
PAGE_DTYPES = {"float32", "int32", "uint32", "uint16", "uint8", "int8"}
"""Element types that the page reads (arrays.js)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StartView:
    """The page's first camera; it follows the pelvis.

    Attributes:
        axes: The picture's right, down and forward in the world, as rows.
        height_m: Height of the standing person, metres.
        middle_m: Height of the person's middle above the pelvis, metres.
    """

    axes: Float[np.ndarray, "3 3"]
    height_m: float
    middle_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class PageMotion:
    """The motion that the page plays.

    Attributes:
        poses: Root rotation, root translation and 23 joint rotations, one row a pose.
        start_view: View of the first pose from the front.
    """

    poses: Float32[np.ndarray, "poses 75"]
    fps: float
    start_view: StartView


def flatten_pose(pose: BodyPose) -> Float32[np.ndarray, "75"]:
    """Return a pose in the page's order: root rotation, root translation, joint rotations."""
    parts = (pose.root_rotation, pose.root_translation, pose.joint_rotations.ravel())
    return np.concatenate(parts).astype(np.float32)


@cache
def pack_runtime(compression_level: int) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Pack the WebAssembly module: the entry by which pages read it, and its file by its path."""
    draft = _ArrayFiles(compression_level)
    return draft.array(_byte_array(runtime_files()[WASM_FILE])), draft.files


def build_page(
    path: Path,
    clip: PageMotion,
    *,
    name: str,
    compression_level: int = 6,
    module: dict[str, Any] | None = None,
) -> dict[str, bytes]:
    """Build all files of the page by relative path; index.html is the one to open.

    The page has all tiers of the package.

    Args:
        compression_level: zlib's: 1 for a local browser, 6 for a host.
        module: Entry of a WebAssembly module that is stored elsewhere (`pack_runtime`); None packs
            it into the page.
    """
    runtime = runtime_files()
    draft = _ArrayFiles(compression_level)
    package, wasm = read_package(path, tier=None), runtime.pop(WASM_FILE)
    manifest = package.manifest
    content = {
        "name": name,
        "licence": manifest.licence,
        "rest_joints": manifest.rest_joints.tolist(),
        "parents": manifest.parents.tolist(),
        "canonical_rotations": manifest.canonical_rotations.tolist(),
        "look": {
            "axes": clip.start_view.axes.tolist(),
            "pelvis": manifest.rest_joints[0].tolist(),
            "height_m": clip.start_view.height_m,
            "middle_m": clip.start_view.middle_m,
        },
        "motion": {"fps": clip.fps, "poses": draft.array(clip.poses)},
        "runtime": module or draft.array(_byte_array(wasm)),
        "tiers": {tier: _tier_content(draft, package, tier) for tier in manifest.tiers},
        "golden": [
            _golden_content(draft, frame, picture)
            for frame, picture in zip(manifest.golden, package.golden, strict=True)
        ],
    }
    draft.files["avatar.json"] = json.dumps(content, allow_nan=False).encode()
    runtime[PAGE_SCRIPT] = runtime.pop(SCRIPT_FILE)
    draft.files.update({f"runtime/{file}": held for file, held in runtime.items()})
    return {**static_page_files(), **draft.files}


def static_page_files() -> dict[str, bytes]:
    """Read the page's own files, the same for every avatar."""
    files = sorted(file for file in (WEB / "page").iterdir() if file.suffix in PAGE_SUFFIXES)
    return {file.name: file.read_bytes() for file in files}


@final
class _ArrayFiles:
    """Files named by a hash of their content, so that what tiers share is stored once."""

    def __init__(self, level: int) -> None:
        self.files: dict[str, bytes] = {}
        self._level = level

    def array(self, array: Shaped[np.ndarray, "..."]) -> dict[str, Any]:
        """Store an array; return the entry by which the page reads it."""
        assert array.dtype.name in PAGE_DTYPES
        plain = np.ascontiguousarray(array).astype(array.dtype.newbyteorder("<"))
        planes = plain.reshape(-1).view(np.uint8).reshape(-1, array.dtype.itemsize).T
        content = np.ascontiguousarray(planes).tobytes()
        file = f"data/{hashlib.sha256(content).hexdigest()[:16]}.bin"
        if file not in self.files:
            self.files[file] = zlib.compress(content, self._level)
        shape = list(array.shape)
        return {
            "file": file,
            "dtype": array.dtype.name,
            "shape": shape,
            "bytes": len(self.files[file]),
        }


def _byte_array(content: bytes) -> Shaped[np.ndarray, "bytes"]:
    return np.frombuffer(content, dtype=np.uint8)


def _tier_content(draft: _ArrayFiles, package: AvatarPackage, tier: str) -> dict[str, Any]:
    note = package.manifest.tiers[tier]
    tables = graph_initializers(package.tables[tier], note.settings)
    return {
        "settings": asdict(note.settings),
        "layout": asdict(note.layout),
        "graph": draft.array(_byte_array(package.graphs[tier])),
        "tables": [{"name": name, **draft.array(array)} for name, array in tables.items()],
    }


def _golden_content(
    draft: _ArrayFiles, frame: GoldenFrame, picture: Shaped[np.ndarray, "height width 4"]
) -> dict[str, Any]:
    camera = frame.camera
    width, height = camera.size_px
    return {
        "pose": [float(number) for number in flatten_pose(frame.pose)],
        "camera": {
            "focal": list(camera.focal_px),
            "center": list(camera.center_px),
            "width": width,
            "height": height,
            "cameraFromWorld": camera.camera_from_world[:3].ravel().tolist(),
        },
        "picture": draft.array(picture),
    }
