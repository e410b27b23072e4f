"""Mesh files from a package: .glb with skeleton and motion, or a static .ply or .obj."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from apps.animation.driving_motion import demo_motion, load_driving_motion, pose_rate
from apps.cli.console import Console
from capture.atomic_files import atomic_file
from export.gltf import SkeletonAnimation, encode_glb
from export.package.manifest import Manifest
from export.package.package_file import read_package
from export.skinned_mesh import SkinnedMesh, extract_mesh
from preprocess.body.body_pose import Motion


def write_mesh(
    package: Path,
    out: Path,
    console: Console,
    *,
    poses: Path | None,
    name: str,
    person: str | None = None,
    triangles: int | None = None,
    replace: bool | None = None,
) -> None:
    """Write a mesh in the format of its suffix, whole or not at all.

    Args:
        package: The .iavatar file.
        out: A .glb, .ply or .obj, in upper or lower case.
        console: Shows progress.
        poses: Motion of the .glb; None for a turn.
        name: Name of the avatar in the .glb.
        person: Person ID in the pose file; None for the longest track.
        triangles: Number of triangles, with a texture in a .glb; None for all, with vertex colors.
        replace: Whether an existing file may be replaced, as in `atomic_file`.

    Raises:
        InputError: If the package is damaged, or no pose is valid.
        OSError: If the disk is full.
    """
    held = read_package(package)
    motion = demo_motion()
    if poses is not None:
        motion = load_driving_motion(poses, held.manifest.rest_joints, console, person=person)
    suffix = out.suffix.lower()
    write = (
        _glb_encoder(held.manifest, motion, name)
        if suffix == ".glb"
        else _static_mesh_encoder(suffix)
    )
    with console.status("extracting the surface"):
        textured = triangles is not None and suffix == ".glb"
        mesh = extract_mesh(held.tables["hq"], triangles=triangles, textured=textured)
        content = write(mesh)
    with atomic_file(out, replace=replace) as part:
        part.write_bytes(content)
    console.info(f"{len(mesh.positions):,} vertices, {len(mesh.faces):,} triangles.")


def _glb_encoder(manifest: Manifest, motion: Motion, name: str) -> Callable[[SkinnedMesh], bytes]:
    rows = tuple(int(row) for row in np.flatnonzero(motion.valid))
    animation = SkeletonAnimation.of(motion, rows, pose_rate(motion), manifest.rest_joints[0])
    return lambda mesh: encode_glb(mesh, manifest, animation, name=name)


def _static_mesh_encoder(suffix: str) -> Callable[[SkinnedMesh], bytes]:
    """Return what encodes the canonical pose; colors are sRGB, as programs take a PLY's to be."""
    import trimesh  # missing in an installation of the player alone

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
