"""A package's avatar as 3-D Gaussians in one pose, for splat viewers: .ply and .spz.

Gaussians lie in shells under the surface, at the vertices of meshes (SuGaR, Guédon and Lepetit
2024). Viewers widen each by half a pixel, and where the surface turns away many add up to a rim
that grows with the distance. So the outer shell is thin fog, as soft as the field's own edge, and
what makes the figure opaque lies too deep for a rim.
"""

import gzip
import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from export.package.package_file import AvatarPackage
from export.player import Player, picture_on_white, premultiply
from export.skinned_mesh import LevelSet, SkinnedMesh, extract_mesh
from export.splat_colors import cameras_around, fit_colors
from preprocess.body.body_pose import BodyPose


class Shell(NamedTuple):
    """A layer of Gaussians; lengths in metres.

    Attributes:
        spacing_m: Distance between them, about.
        depth_m: Under the surface, for a film of coarse pixels.
        clear_share: Least distance from the surface, also from that of another side or fold, in
            depths.
        thickness_m: Standard deviation along the normal.
        opacity: At their centers.
    """

    spacing_m: float
    depth_m: float
    clear_share: float
    thickness_m: float
    opacity: float


SHELLS = (
    Shell(0.0055, 0.005, 0.0, 0.003, 0.15),
    Shell(0.008, 0.008, 0.8, 0.0005, 0.5),
    Shell(0.012, 0.02, 0.8, 0.0005, 0.95),
)
"""From the outermost, chosen by pictures from 1.4 to 7 mm a pixel (dev/log/player.md)."""
FIRM_DENSITY = 25.0
"""Density at the surface under which they lie, 1/m."""
MAX_CROSSED_M2 = 3.85
"""Area of the voxels' faces between in and out, square metres, from which on Gaussians lie farther
apart, as in wide clothes: a `.ply` has at most 12 MB."""
COARSE_PIXEL_M = 0.0092
"""Size of a film's pixels on the person for which the shells' depths are chosen, metres."""
DEPTH_PER_PIXEL = 0.37
"""Change of the shells' depth by the size of a film's pixels: an avatar filmed in finer pixels is
viewed from nearer, where a viewer's blur of half a pixel is narrower. Chosen on three avatars."""
VIEWS = 8
"""Pictures of the avatar from around it, to which colors are fitted."""
PIXEL_M = 0.005
"""Size of their pixels on the avatar, about, metres."""
SH_BASE = 0.28209479177387814
"""Spherical harmonics' constant function, by which 3DGS divides colors."""
SPZ_MAGIC, SPZ_VERSION = 0x5053474E, 2
"""First numbers of an .spz file; all readers know its second version."""
SPZ_FRACTION_BITS = 12
"""Bits of a position behind the point: a quarter of a millimetre."""


@dataclass(frozen=True, eq=False, kw_only=True)
class GaussianSplats:
    """Gaussians, metres, y up.

    Attributes:
        colors: sRGB in [0, 1].
        opacities: In (0, 1), at the centers.
        scales: Standard deviations along the Gaussians' own axes.
        rotations: World from own axes, as quaternions w, x, y, z with w not negative.
    """

    positions: Float32[np.ndarray, "splats 3"]
    colors: Float32[np.ndarray, "splats 3"]
    opacities: Float32[np.ndarray, "splats"]
    scales: Float32[np.ndarray, "splats 3"]
    rotations: Float32[np.ndarray, "splats 4"]


def build_splats(package: AvatarPackage, pose: BodyPose | None) -> GaussianSplats:
    """Lay Gaussians under an avatar's surface, and move them to a pose (None: canonical)."""
    tables, player = package.tables["hq"], Player(package)
    level = LevelSet.of(tables.bricks, FIRM_DENSITY)
    crossings = sum(np.count_nonzero(np.diff(level.heights > 0.0, axis=axis)) for axis in range(3))
    wider = max(1.0, np.sqrt(crossings * tables.bricks.voxel_m**2 / MAX_CROSSED_M2))
    meshes = [extract_mesh(tables, level, spacing_m=wider * shell.spacing_m) for shell in SHELLS]
    surface = KDTree(meshes[0].positions)
    pixel_m = (package.manifest.metrics.get("recipe") or {}).get("finest_m", COARSE_PIXEL_M)
    rise_m = DEPTH_PER_PIXEL * max(0.0, COARSE_PIXEL_M - pixel_m)
    parts = [
        _lay_shell(mesh, shell, surface, rise_m) for mesh, shell in zip(meshes, SHELLS, strict=True)
    ]
    positions, axes, colors, opacities, joints, weights = (
        np.concatenate(each) for each in zip(*parts, strict=True)
    )
    cameras = cameras_around(positions, views=VIEWS, pixel_m=PIXEL_M)
    pictures = [picture_on_white(premultiply(player.render_canonical(each))) for each in cameras]
    colors = fit_colors(positions, axes, opacities, colors, cameras, pictures)
    if pose is not None:
        bones = player.world_from_canonical(pose)
        moved = np.einsum("vi,viab->vab", weights / 255.0, bones[joints])
        positions = np.einsum("vab,vb->va", moved[:, :3, :3], positions) + moved[:, :3, 3]
        axes = moved[:, :3, :3] @ axes
    squares, turned = np.linalg.eigh(axes @ axes.swapaxes(1, 2))
    scales = np.sqrt(np.maximum(squares, 1e-6**2))
    turned[np.linalg.det(turned) < 0.0, :, 2] *= -1.0
    rotations = Rotation.from_matrix(turned).as_quat(canonical=True, scalar_first=True)
    return GaussianSplats(
        positions=positions.astype(np.float32),
        colors=colors.astype(np.float32),
        opacities=opacities.astype(np.float32),
        scales=scales.astype(np.float32),
        rotations=rotations.astype(np.float32),
    )


def _lay_shell(
    mesh: SkinnedMesh, shell: Shell, surface: KDTree, rise_m: float
) -> tuple[np.ndarray, ...]:
    """Positions, axes times standard deviations, colors, opacities and skin of its Gaussians."""
    depth_m = shell.depth_m - rise_m
    distances = np.asarray(KDTree(mesh.positions).query(mesh.positions, 7)[0])
    axes = _tangents(mesh.normals)
    axes[..., :2] *= 0.6 * distances[:, 1:].mean(axis=1)[:, None, None]  # less shows gaps
    axes[..., 2] *= shell.thickness_m
    positions = mesh.positions - depth_m * mesh.normals.astype(np.float64)
    clear = np.asarray(surface.query(positions)[0]) >= shell.clear_share * depth_m
    opacities = np.full(len(positions), shell.opacity)
    columns = positions, axes, mesh.colors / 255.0, opacities, mesh.joints, mesh.weights
    return tuple(each[clear] for each in columns)


def _tangents(normals: Float32[np.ndarray, "splats 3"]) -> Float[np.ndarray, "splats 3 3"]:
    """Return two directions across each normal and the normal itself, as columns."""
    other = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    first = np.cross(normals, other)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=2)


def encode_ply(splats: GaussianSplats) -> bytes:
    """Encode as 3DGS's .ply (Kerbl et al. 2023): x right, y down, z away, as its viewers expect."""
    turned = Rotation.from_quat(splats.rotations, scalar_first=True)
    flip = Rotation.from_rotvec([np.pi, 0.0, 0.0])
    columns = {
        "x y z": splats.positions * np.array([1.0, -1.0, -1.0]),
        "f_dc_0 f_dc_1 f_dc_2": (splats.colors - 0.5) / SH_BASE,
        "opacity": np.log(splats.opacities / (1.0 - splats.opacities))[:, None],
        "scale_0 scale_1 scale_2": np.log(splats.scales),
        "rot_0 rot_1 rot_2 rot_3": (flip * turned).as_quat(scalar_first=True),
    }
    names = "".join(f"property float {name}\n" for key in columns for name in key.split())
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(splats.positions)}\n"
    rows = np.concatenate(list(columns.values()), axis=1).astype("<f4")
    return f"{head}{names}end_header\n".encode() + rows.tobytes()


def encode_spz(splats: GaussianSplats) -> bytes:
    """Encode as Niantic's .spz, version 2 (github.com/nianticlabs/spz), y up."""

    def codes(values: Float[np.ndarray, "..."]) -> bytes:
        return np.clip(np.round(values), 0, 255).astype(np.uint8).tobytes()

    places = np.round(splats.positions.astype(np.float64) * 2**SPZ_FRACTION_BITS).astype("<i4")
    head = struct.pack("<IIIBBBB", SPZ_MAGIC, SPZ_VERSION, len(places), 0, SPZ_FRACTION_BITS, 0, 0)
    parts = [
        head,
        places.reshape(-1, 1).view(np.uint8)[:, :3].tobytes(),
        codes(splats.opacities * 255.0),
        codes(((splats.colors - 0.5) / SH_BASE * 0.15 + 0.5) * 255.0),
        codes((np.log(splats.scales) + 10.0) * 16.0),
        codes(splats.rotations[:, 1:] * 127.5 + 127.5),
    ]
    return gzip.compress(b"".join(parts), mtime=0)
