"""An avatar's package as a mesh file: .glb with skeleton and motion, or .ply as it stands."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from apps.playing.novel import novel_motion
from apps.playing.rate import poses_a_second
from apps.terminal.console import Console
from apps.terminal.whole import whole_file
from capture.errors import BadInput
from export.gltf import Animation, glb
from export.manifest import Manifest
from export.mesh import SkinnedMesh, mesh_of
from export.package import read_package
from preprocess.pose_file import read_motion


def write_mesh(
    package: Path, out: Path, console: Console, *, poses: Path | None, name: str
) -> None:
    """Writes the mesh by the suffix of its name, whole or not at all.

    Args:
        package: The avatar.
        out: A .glb or a .ply.
        console: Where it says how far it is.
        poses: What the .glb does; without it, a turn.
        name: Of the avatar.

    Raises:
        BadInput: If the package is not sound, or no pose is valid.
        OSError: If the disk is full.
    """
    held = read_package(package)
    write = _ply if out.suffix == ".ply" else _glb(held.manifest, poses, name, console)
    with console.waiting("taking the surface"):
        mesh = mesh_of(held.tables["hq"])
        content = write(mesh)
    with whole_file(out) as part:
        part.write_bytes(content)
    console.say(f"{len(mesh.positions):,} vertices, {len(mesh.faces):,} triangles.")


def _glb(
    manifest: Manifest, poses: Path | None, name: str, console: Console
) -> Callable[[SkinnedMesh], bytes]:
    motion = novel_motion() if poses is None else read_motion(poses)
    rows = tuple(int(row) for row in np.flatnonzero(motion.valid))
    if not rows:
        raise BadInput(f"None of the {len(motion)} poses in {poses} is valid.")
    if len(rows) < len(motion):
        console.warn(f"{len(motion) - len(rows)} of {len(motion)} poses are not valid; left out.")
    fps = poses_a_second(motion)
    animation = Animation.of(motion, rows, fps, manifest.rest_joints[0])
    return lambda mesh: glb(mesh, manifest, animation, name=name)


def _ply(mesh: SkinnedMesh) -> bytes:
    """In the canonical pose; colours are sRGB, as all programs take a PLY's to be."""
    import trimesh

    solid = trimesh.Trimesh(
        vertices=mesh.positions,
        faces=mesh.faces,
        vertex_normals=mesh.normals,
        vertex_colors=mesh.colors,
        process=False,
    )
    content = solid.export(file_type="ply", vertex_normal=True)
    assert isinstance(content, bytes)
    return content
