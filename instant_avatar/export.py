"""ia-export: write the current state of a run as a package, or an avatar as a mesh."""

import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from tyro.conf import Positional, arg

from capture.atomic_files import atomic_file
from capture.camera import Camera
from capture.input_error import InputError, counted
from export.gltf import SkeletonAnimation, encode_glb, encode_vrm, text_of_glb
from export.package.manifest import Manifest
from export.package.package_file import AvatarPackage, read_package
from export.player import Player
from export.skinned_mesh import SkinnedMesh, extract_mesh
from export.splats import build_splats, encode_ply, encode_spz
from instant_avatar.animation.driving_motion import (
    DISTANCE_HEIGHTS,
    PERSON_HEIGHT_SHARE,
    demo_motion,
    load_driving_motion,
    pose_rate,
)
from instant_avatar.cli.command_line import DONE, NO_AVATAR, CommandExit, run_main
from instant_avatar.cli.console import Console
from instant_avatar.cli.shared_options import (
    Flag,
    OptionalCount,
    OptionalFile,
    OptionalId,
    OptionalName,
    check_output_file,
)
from instant_avatar.run.run_folder import RunFolder
from preprocess.body.body_pose import BodyPose, Motion

if TYPE_CHECKING:  # torch is loaded after --help has been answered
    from avatar.rig import Rig

CHECK_VIEWS = 4
"""Synthetic views that validate a package without frames."""
VIEW_PX = 256
"""Width and height of a synthetic view."""
SPLAT_ENCODERS = {".ply": encode_ply, ".spz": encode_spz}
"""Encoders of splats by the suffix of --out."""
MIN_TRIANGLES = 500
"""Least --triangles; below it a hand is a lump."""


@dataclass(frozen=True, kw_only=True)
class ExportArguments:
    """Write the newest checkpoint of a run, or a package, to a file.

    Try it while ia-ingest is training, or after it was killed:

        ia-export run --out now.iavatar

        ia-play now.iavatar --poses dance.npz

    For Blender, game engines and other programs, a mesh with skeleton, weights and a motion:

        ia-export run/avatar.iavatar --to glb --poses dance.npz --out dance.glb

    For programs that animate VRM avatars:

        ia-export run/avatar.iavatar --to vrm --triangles 20000 --out me.vrm

    For viewers of 3-D Gaussians, in the pose of a file's first row:

        ia-export run/avatar.iavatar --to splats --poses wave.npz --out wave.spz

    The run continues undisturbed; nothing in its folder is changed unless --out names it. A mesh is
    opaque with a hard silhouette: ia-play renders the avatar in full quality.

    Exit codes: 0 done; 1 nothing to draw yet; 2 bad input; 3 disk full; 130 Ctrl-C.
    """

    run: Annotated[Positional[Path], arg(metavar="RUN|AVATAR")]
    """Folder written by ia-ingest (--out), with checkpoint/; for meshes also a package."""
    to: Literal["iavatar", "glb", "vrm", "ply", "obj", "splats"] = "iavatar"
    """Format: package for ia-play; glTF 2.0, binary or as text (.gltf); VRM 1.0 (humanoid bones,
    resting in a T); a static mesh with vertex colors as PLY or OBJ (canonical pose, no skeleton);
    or 3-D Gaussians in one pose, as .ply or .spz."""
    out: Annotated[Path, arg(metavar="FILE", help_behavior_hint="(required)")]
    """File to write, whole or not at all."""
    poses: OptionalFile = None
    """Motion for --to glb, as in ia-play (default: a turn); --to splats takes its first pose
    (default: the canonical pose)."""
    person: OptionalId = None
    """Person ID in the pose file (default: the longest track)."""
    triangles: OptionalCount = None
    """Number of triangles of a mesh, for game engines and phones; a .glb or .vrm then has a texture
    (default: some 300,000, with vertex colors). 20,000 are enough for most."""
    author: OptionalName = None
    """Author that --to vrm states (default: unknown); its licence allows the author's own use
    alone, commercial use only if all that the avatar was made with does."""
    overwrite: Flag = False
    """Replace the file that --out names, if it exists."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    return run_main("ia-export", ExportArguments, export, argv)


def export(arguments: ExportArguments, console: Console) -> int:
    """Write a package or a mesh."""
    several = {"splats": tuple(SPLAT_ENCODERS), "glb": (".glb", ".gltf")}
    suffixes = several.get(arguments.to, (f".{arguments.to}",))
    if arguments.out.suffix.lower() not in suffixes:
        raise InputError(f"--out is {arguments.out}, but must end in {' or '.join(suffixes)}.")
    if not arguments.out.resolve().parent.is_dir():
        raise InputError(
            f"--out is {arguments.out}, but the folder {arguments.out.resolve().parent} does not "
            "exist."
        )
    inputs = [
        path for path in (arguments.run, arguments.poses) if path is not None and path.is_file()
    ]
    check_output_file(arguments.out, "--out", inputs, overwrite=arguments.overwrite)
    if arguments.poses is not None and arguments.to not in ("glb", "splats"):
        raise InputError(f"--poses requires --to glb or splats; a .{arguments.to} holds no motion.")
    if arguments.author is not None and arguments.to != "vrm":
        raise InputError(f"--author requires --to vrm; a .{arguments.to} states none.")
    if arguments.triangles is not None and arguments.to in ("iavatar", "splats"):
        raise InputError("--triangles requires --to glb, vrm, ply or obj; other files have none.")
    if arguments.triangles is not None and arguments.triangles < MIN_TRIANGLES:
        raise InputError(
            f"--triangles is {arguments.triangles}, but must be at least {MIN_TRIANGLES}."
        )
    if arguments.run.is_file() and arguments.to != "iavatar":
        _export_converted(arguments, arguments.run, console)
    else:
        with tempfile.TemporaryDirectory() as folder:
            package = Path(folder) / "avatar.iavatar"
            _export_package(arguments.run, package, console, fine_tune=arguments.to == "iavatar")
            if arguments.to != "iavatar":
                _export_converted(arguments, package, console)
            else:
                with atomic_file(arguments.out, replace=arguments.overwrite) as part:
                    shutil.copyfile(package, part)
    kind = {"iavatar": "package", "splats": "splats"}.get(arguments.to, "mesh")
    console.print_artifact(kind, arguments.out)
    return DONE


def _export_converted(arguments: ExportArguments, package: Path, console: Console) -> None:
    """Write a mesh or splats of a package in the format of --to, whole or not at all."""
    held = read_package(package)
    motion = None
    if arguments.poses is not None:
        joints = held.manifest.rest_joints
        motion = load_driving_motion(arguments.poses, joints, console, person=arguments.person)
    out = arguments.out
    if arguments.to == "splats":
        with console.status("laying Gaussians on the surface"):
            splats = build_splats(held, None if motion is None else _first_pose(motion))
            content = SPLAT_ENCODERS[out.suffix.lower()](splats)
        said = f"{len(splats.positions):,} Gaussians."
    else:
        content, said = _build_mesh(arguments, held, motion or demo_motion(), console)
    with atomic_file(out, replace=arguments.overwrite) as part:
        part.write_bytes(content)
    console.info(said)


def _build_mesh(
    arguments: ExportArguments, package: AvatarPackage, motion: Motion, console: Console
) -> tuple[bytes, str]:
    name = arguments.out.stem
    textured = arguments.to in ("glb", "vrm") and arguments.triangles is not None
    if textured and find_spec("xatlas") is None:
        textured = False
        console.info("note: colors of vertices instead of a texture, which needs xatlas.")
    with console.status("extracting the surface"):
        mesh = extract_mesh(
            package.tables["hq"],
            triangles=arguments.triangles,
            picture_by=Player(package).render_canonical if textured else None,
        )
        if arguments.to == "glb":
            content = _encode_animated(mesh, package.manifest, motion, name)
            if arguments.out.suffix.lower() == ".gltf":
                content = text_of_glb(content)
        elif arguments.to == "vrm":
            author = arguments.author or "unknown"  # a VRM must state one
            content = encode_vrm(mesh, package.manifest, name=name, author=author)
        else:
            content = _encode_static(mesh, arguments.to)
    return content, f"{len(mesh.positions):,} vertices, {len(mesh.faces):,} triangles."


def _first_pose(motion: Motion) -> BodyPose:
    """Return a motion's first pose, upright at the origin."""
    pose = motion[int(np.flatnonzero(motion.valid)[0])]
    return replace(pose, root_rotation=np.zeros(3), root_translation=np.zeros(3))


def _encode_animated(mesh: SkinnedMesh, manifest: Manifest, motion: Motion, name: str) -> bytes:
    rows = tuple(int(row) for row in np.flatnonzero(motion.valid))
    animation = SkeletonAnimation.of(motion, rows, pose_rate(motion), manifest.rest_joints[0])
    return encode_glb(mesh, manifest, animation, name=name)


def _encode_static(mesh: SkinnedMesh, kind: str) -> bytes:
    """Encode the canonical pose; colors are sRGB, as programs take a PLY's to be."""
    import trimesh  # slow to import

    with_normals = {"ply": "vertex_normal", "obj": "include_normals"}[kind]
    options: dict[str, Any] = {with_normals: True}
    solid = trimesh.Trimesh(
        vertices=mesh.positions,
        faces=mesh.faces,
        vertex_normals=mesh.normals,
        vertex_colors=mesh.colors,
        process=False,
    )
    content = solid.export(file_type=kind, **options)
    return content if isinstance(content, bytes) else str(content).encode()


def _export_package(folder: Path, out: Path, console: Console, *, fine_tune: bool = True) -> None:
    """Write a package of a run's checkpoint, fine-tuned unless it only becomes a mesh."""
    if not folder.is_dir():
        found = "is a file" if folder.is_file() else "does not exist"
        raise InputError(
            f"{folder} {found}; a folder written by ia-ingest was expected, or a package "
            "(.iavatar) with --to glb, vrm, ply, obj or splats."
        )
    run = RunFolder(path=folder)
    if not run.has_checkpoint():
        raise InputError(
            f"No checkpoint in {run.checkpoint}; expected a folder written by ia-ingest, which "
            "saves the first checkpoint five seconds after the first frame."
        )
    with console.status("loading the checkpoint"):
        from avatar.training import checkpoint
        from export.bake.bake_tables import ExportRefused
        from instant_avatar.run.snapshot_writer import write_packages

        trainer, notes = checkpoint.load(run.checkpoint)
    with console.progress("writing the package", 1.0) as bar:
        shots = synthetic_views(trainer.avatar.rig)
        try:
            (exported,) = write_packages(
                trainer,
                out,
                shots,
                curve_point=None,
                made_with=notes.get("made_with", ()),
                fine_tune=fine_tune,
                progress=bar.set_share,
            )
        except ExportRefused as error:
            raise CommandExit(str(error), NO_AVATAR) from error
    for warning in exported.warnings:
        console.warning(warning)
    console.info(
        f"Trained on {counted(trainer.frames_seen, 'frame')} for {trainer.wall_seconds:.1f} s."
    )


def synthetic_views(rig: "Rig") -> list[tuple[BodyPose, Camera]]:
    """Return poses of the built-in motion, seen from the front: a checkpoint holds no frames."""
    motion = demo_motion(frames=CHECK_VIEWS)
    low, high = rig.seeds.min(axis=0).astype(float), rig.seeds.max(axis=0).astype(float)
    distance = DISTANCE_HEIGHTS * (high[1] - low[1])
    # person_px / focal = height / distance, of which the height cancels
    focal = PERSON_HEIGHT_SHARE * VIEW_PX * DISTANCE_HEIGHTS
    eye, axes = 0.5 * (low + high) + [0.0, 0.0, distance], np.diag([1.0, -1.0, -1.0])
    camera = Camera.at(eye, axes, focal, (VIEW_PX, VIEW_PX))
    return [(motion[row], camera) for row in range(CHECK_VIEWS)]


if __name__ == "__main__":
    sys.exit(main())
