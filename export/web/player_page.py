"""An avatar and a motion as the files of a page: the package's graph, unpacked tables, no CDN."""

import hashlib
import json
import zlib
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float, Float32, Shaped

from export.package.graph_tables import graph_initializers
from export.package.manifest import GoldenFrame
from export.package.package_file import AvatarPackage, read_package
from export.web.onnxruntime_web import SCRIPT_FILE, WASM_FILE, runtime_files
from preprocess.body.body_pose import BodyPose

PAGE_SUFFIXES = (".html", ".css", ".js", ".svg")
PAGE_SCRIPT = "ort.js"
"""Hosts such as nginx serve .mjs as a stream of bytes, which browsers do not run as a script."""
PAGE_DTYPES = {"float32", "int32", "uint32", "uint16", "uint8", "int8"}
"""Element types that the page reads (arrays.js)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StartView:
    """Where the page's camera stands at first; it follows the pelvis.

    Attributes:
        axes: Rows: the picture's right, down and forward in the world.
        height_m: Of the person standing.
        middle_m: How far the person's middle is above the pelvis.
    """

    axes: Float[np.ndarray, "3 3"]
    height_m: float
    middle_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class PageMotion:
    """The motion that the page plays.

    Attributes:
        poses: Root rotation, root translation and 23 joint rotations, one row a pose.
        fps: Poses a second.
        look: At the first pose, from the front.
    """

    poses: Float32[np.ndarray, "poses 75"]
    fps: float
    start_view: StartView


def flatten_pose(pose: BodyPose) -> Float32[np.ndarray, "75"]:
    """A pose as the page takes it."""
    parts = (pose.root_rotation, pose.root_translation, pose.joint_rotations.ravel())
    return np.concatenate(parts).astype(np.float32)


def build_page(
    path: Path, clip: PageMotion, *, name: str, compression_level: int = 6
) -> dict[str, bytes]:
    """All files of the page by their relative paths; index.html is the one to open.

    Args:
        path: The `.iavatar` package; every tier of it goes in.
        clip: What it plays.
        name: Of the avatar, for people.
        level: How hard arrays are deflated: 1 on the way to one's own browser, 6 for a host.

    Raises:
        InputError: If the package is not sound, or onnxruntime-web is not there.
    """
    runtime = runtime_files()
    draft = _ArrayFiles(compression_level)
    package = read_package(path)
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
        "runtime": draft.array(_byte_array(runtime.pop(WASM_FILE))),
        "tiers": {
            tier: _tier_content(
                draft, package if tier == "hq" else read_package(path, tier=tier), tier
            )
            for tier in manifest.tiers
        },
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
    """The page itself, the same for every avatar."""
    folder = resources.files("export.web").joinpath("page")
    files = [file for file in folder.iterdir() if file.name.endswith(PAGE_SUFFIXES)]
    return {file.name: file.read_bytes() for file in sorted(files, key=lambda file: file.name)}


@final
class _ArrayFiles:
    """Files that name themselves after their content: what two tiers share is stored once."""

    def __init__(self, level: int) -> None:
        self.files: dict[str, bytes] = {}
        self._level = level

    def array(self, array: Shaped[np.ndarray, "..."]) -> dict[str, Any]:
        """Stores an array; returns what the page must know to read it."""
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
