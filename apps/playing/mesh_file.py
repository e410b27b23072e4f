"""An avatar's package as a mesh file: .glb with skeleton and motion, or a still .ply or .obj."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from apps.playing.driving import driving_motion
from apps.playing.novel import novel_motion
from apps.playing.rate import poses_a_second
from apps.terminal.console import Console
from capture.atomic_files import whole_file
from export.gltf import Animation, glb
from export.manifest import Manifest
from export.mesh import SkinnedMesh, mesh_of
from export.package import read_package
from preprocess.pose import Motion


def write_mesh(
    package: Path,
    out: Path,
    console: Console,
    *,
    poses: Path | None,
    name: str,
    person: str | None = None,
    replace: bool | None = None,
) -> None:
    """Writes the mesh by the suffix of its name, whole or not at all.

    Args:
        package: The avatar.
        out: A .glb, a .ply or an .obj, in letters of either case.
        console: Where it says how far it is.
        poses: What the .glb does; without it, a turn.
        name: Of the avatar.
        person: Whose poses, where the file holds several people's.
        replace: Whether a file that is there already may go, as of `whole_file`.

    Raises:
        BadInput: If the package is not sound, or no pose is valid.
        OSError: If the disk is full.
    """
    held = read_package(package)
    motion = novel_motion()
    if poses is not None:
        motion = driving_motion(poses, held.manifest.rest_joints, console, person=person)
    suffix = out.suffix.lower()
    write = _glb(held.manifest, motion, name) if suffix == ".glb" else _still(suffix)
    with console.waiting("taking the surface"):
        mesh = mesh_of(held.tables["hq"])
        content = write(mesh)
    with whole_file(out, replace=replace) as part:
        part.write_bytes(content)
    console.say(f"{len(mesh.positions):,} vertices, {len(mesh.faces):,} triangles.")


def _glb(manifest: Manifest, motion: Motion, name: str) -> Callable[[SkinnedMesh], bytes]:
    rows = tuple(int(row) for row in np.flatnonzero(motion.valid))
    animation = Animation.of(motion, rows, poses_a_second(motion), manifest.rest_joints[0])
    return lambda mesh: glb(mesh, manifest, animation, name=name)


def _still(suffix: str) -> Callable[[SkinnedMesh], bytes]:
    """Return what encodes the canonical pose; colors are sRGB, as programs take a PLY's to be."""
    import trimesh  # an installation of the player alone has none, and is told what to install

    options: dict[str, Any] = {
        ".ply": {"vertex_normal": True},
        ".obj": {"include_normals": True},
    }[suffix]

    def encoded(mesh: SkinnedMesh) -> bytes:
        solid = trimesh.Trimesh(
            vertices=mesh.positions,
            faces=mesh.faces,
            vertex_normals=mesh.normals,
            vertex_colors=mesh.colors,
            process=False,
        )
        content = solid.export(file_type=suffix[1:], **options)
        return content if isinstance(content, bytes) else str(content).encode()

    return encoded
