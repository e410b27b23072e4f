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
from jaxtyping import Float, Float32, Int
from scipy.sparse import csr_array
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from export.package.player_tables import PlayerTables
from export.skinned_mesh import LevelSet, SkinnedMesh, extract_mesh


class Shell(NamedTuple):
    """A layer of Gaussians; lengths in metres.

    Attributes:
        spacing_m: Distance between them, about.
        depth_m: Under the surface.
        clear_m: Least distance from the surface, also from that of another side or fold.
        thickness_m: Standard deviation along the normal.
        opacity: At their centers.
    """

    spacing_m: float
    depth_m: float
    clear_m: float
    thickness_m: float
    opacity: float


SHELLS = (
    Shell(0.0055, 0.005, 0.0, 0.003, 0.15),
    Shell(0.008, 0.008, 0.0064, 0.0005, 0.5),
    Shell(0.012, 0.02, 0.016, 0.0005, 0.95),
)
"""From the outermost, chosen by pictures from 1.4 to 7 mm a pixel (dev/log/player.md)."""
MAX_CROSSED_M2 = 3.85
"""Area of the voxels' faces between in and out, square metres, from which on Gaussians lie farther
apart, as in wide clothes: a `.ply` has at most 12 MB."""
MIN_SCALE_M = 1e-6
"""Least standard deviation, where a pose flattens one."""
SPREAD = 0.6
"""Standard deviation along the surface, in distances of neighbors: less shows gaps."""
VIEWER_BLUR_M = 0.003
"""Standard deviation of viewers' blur on a figure of some 400 px, metres."""
NEAREST, NEIGHBORS = 6, 24
"""Neighbors whose mean distance sets a Gaussian's size; neighbors that blend with it."""
MIN_FACING = 0.3
"""Least cosine between the normals of Gaussians that blend."""
SHARPENINGS = 5
"""Iterations by which colors are sharpened."""
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


def build_splats(
    tables: PlayerTables, bones: Float[np.ndarray, "24 4 4"] | None = None
) -> GaussianSplats:
    """Lay Gaussians under the surface of baked bricks, moved by world-from-canonical matrices."""
    level = LevelSet.of(tables.bricks)
    crossings = sum(np.count_nonzero(np.diff(level.heights > 0.0, axis=axis)) for axis in range(3))
    wider = max(1.0, np.sqrt(crossings * tables.bricks.voxel_m**2 / MAX_CROSSED_M2))
    meshes = [extract_mesh(tables, level, spacing_m=wider * shell.spacing_m) for shell in SHELLS]
    surface = KDTree(meshes[0].positions)
    parts = [
        _lay_shell(mesh, shell, surface, bones) for mesh, shell in zip(meshes, SHELLS, strict=True)
    ]
    positions, axes, colors, opacities = (np.concatenate(each) for each in zip(*parts, strict=True))
    squares, turned = np.linalg.eigh(axes @ axes.swapaxes(1, 2))
    scales = np.sqrt(np.maximum(squares, MIN_SCALE_M**2))
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
    mesh: SkinnedMesh, shell: Shell, surface: KDTree, bones: Float[np.ndarray, "24 4 4"] | None
) -> tuple[np.ndarray, ...]:
    """Positions, axes times standard deviations, colors and opacities of a shell's Gaussians."""
    found = KDTree(mesh.positions).query(mesh.positions, 1 + NEIGHBORS)
    distances, neighbors = np.asarray(found[0]), np.asarray(found[1])
    sizes = SPREAD * distances[:, 1 : 1 + NEAREST].mean(axis=1)
    shares = np.exp(-0.5 * (distances / np.hypot(sizes, VIEWER_BLUR_M)[neighbors]) ** 2)
    facing = np.einsum("vnx,vx->vn", mesh.normals[neighbors], mesh.normals)
    shares *= facing > MIN_FACING
    axes = _tangents(mesh.normals)
    axes[..., :2] *= sizes[:, None, None]
    axes[..., 2] *= shell.thickness_m
    positions = mesh.positions - shell.depth_m * mesh.normals.astype(np.float64)
    clear = np.asarray(surface.query(positions)[0]) >= shell.clear_m
    if bones is not None:
        moved = np.einsum("vi,viab->vab", mesh.weights / 255.0, bones[mesh.joints])
        positions = np.einsum("vab,vb->va", moved[:, :3, :3], positions) + moved[:, :3, 3]
        axes = moved[:, :3, :3] @ axes
    colors = _sharpen(mesh.colors / 255.0, neighbors, shares)
    opacities = np.full(len(positions), shell.opacity)
    return tuple(each[clear] for each in (positions, axes, colors, opacities))


def _sharpen(
    colors: Float[np.ndarray, "splats 3"],
    neighbors: Int[np.ndarray, "splats neighbors"],
    shares: Float[np.ndarray, "splats neighbors"],
) -> Float[np.ndarray, "splats 3"]:
    """Find colors that become the given ones where Gaussians overlap (Van Cittert's iteration)."""
    starts = np.arange(0, neighbors.size + 1, neighbors.shape[1])
    blur = csr_array(
        ((shares / shares.sum(axis=1, keepdims=True)).ravel(), neighbors.ravel(), starts)
    )
    found = colors
    for _ in range(SHARPENINGS):
        found = np.clip(found + colors - blur @ found, 0.0, 1.0)
    return found


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
