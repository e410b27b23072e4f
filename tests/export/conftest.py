"""A person whose field is a formula: capsules about the bones, striped, soft at the rim."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

from avatar.rig import Rig
from capture.camera import Camera
from export import build
from export.bake.bake_tables import BakeConfig
from export.build import ExportReport, export_field
from export.package.package_file import AvatarPackage, read_package
from export.package.player_tables import PlayerTables
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import body_from_rest
from tests.avatar_fixtures import pixel_centers

RADII_CM = [12, 8, 8, 12, 6, 6, 13, 5, 5, 13, 5, 5, 7, 7, 7, 10, 6, 6, 5, 5, 4, 4, 4, 4]
STEP_M = 0.005


@dataclass(frozen=True, eq=False)
class StandIn:
    """What an avatar is, as far as the export knows: a rig, a field and where it is not empty."""

    rig: Rig
    field_at: Callable
    occupied: np.ndarray

    @property
    def canonical(self) -> BodyPose:
        return replace(BodyPose.rest(), joint_rotations=self.rig.canonical_rotations)

    def volume_render(self, pose: BodyPose, camera: Camera) -> np.ndarray:
        """The exact picture: every sample is carried into canonical space by itself."""
        width, height = camera.size_px
        root = self.rig.world_from_body(pose)
        directions = camera.ray_directions(pixel_centers(camera)) @ root[:3, :3]
        origin = (camera.center_world - root[:3, 3]) @ root[:3, :3]
        bones = self.rig.body_from_canonical(pose.joint_rotations)
        skin, nearest = _posed(self.rig, self.rig.seeds, bones), 0.10
        tree = KDTree(skin)
        far = np.linalg.norm(skin - origin, axis=1)
        steps = np.arange(far.min() - nearest, far.max() + nearest, STEP_M)
        picture = np.zeros((width * height, 4))
        for start in range(0, len(steps), 12):  # twelve steps share one look at what is near
            some = steps[start : start + 12]
            near = tree.query(origin + directions * some.mean())[0] < nearest
            rays = np.flatnonzero(near & (picture[:, 3] < 0.999))
            points = origin + some[:, None, None] * directions[rays]
            rgb, density = self._posed_field(points.reshape(-1, 3), bones, tree)
            opacity = -np.expm1(-density * STEP_M).reshape(len(some), len(rays))
            for color, alpha in zip(rgb.reshape(len(some), -1, 3), opacity, strict=True):
                weight = (1 - picture[rays, 3]) * alpha
                picture[rays] += np.column_stack([color * weight[:, None], weight])
        return picture.reshape(height, width, 4).astype(np.float32)

    def _posed_field(self, points, bones, tree):
        """Color and density of the densest of up to three canonical points."""
        best_rgb, best = np.zeros((len(points), 3)), np.zeros(len(points))
        if len(points) == 0:
            return best_rgb, best
        for neighbor in tree.query(points, k=9)[1][:, ::4].T:
            guess = self.rig.seeds[neighbor].astype(np.float64)
            for _ in range(4):
                blended = _blended(self.rig, guess, bones)
                offset = (points - blended[:, :, 3])[..., None]
                guess = np.linalg.solve(blended[:, :, :3], offset)[..., 0]
            error = np.linalg.norm(_posed(self.rig, guess, bones) - points, axis=1)
            with torch.no_grad():
                rgb, density = self.field_at(torch.from_numpy(guess.astype(np.float32)))
            better = (error < 1e-3) & (density.numpy() > best)
            best[better], best_rgb[better] = density.numpy()[better], rgb.numpy()[better]
        return best_rgb, best


def _blended(rig, points, bones):
    """Blended 3×4 matrices: `rig.weights_at` would do, many times slower."""
    last = np.array(rig.weights.shape[:3]) - 1
    place = (points - rig.box_low) / (rig.box_high - rig.box_low) * last
    place = np.clip(place, 0, last - 1e-3)
    base = place.astype(int)
    weights = np.zeros((len(points), 24))
    for corner in np.ndindex(2, 2, 2):
        share = np.abs(1 - np.array(corner) - (place - base)).prod(axis=1)
        weights += rig.weights[tuple((base + corner).T)] * share[:, None]
    return (weights @ bones[:, :3].reshape(24, 12)).reshape(-1, 3, 4)


def _posed(rig, points, bones):
    blended = _blended(rig, points, bones)
    return np.einsum("nab,nb->na", blended[:, :, :3], points) + blended[:, :, 3]


def capsule_field(rig: Rig) -> Callable:
    """Density of a soft union of capsules, thinner than the body, with 8-cm stripes."""
    canonical = body_from_rest(rig.rest_joints, rig.parents, rig.canonical_rotations)
    joints = np.einsum("jab,jb->ja", canonical[:, :3, :3], rig.rest_joints) + canonical[:, :3, 3]
    ends = torch.tensor(joints[1:], dtype=torch.float32)
    starts = torch.tensor(joints[rig.parents[1:]], dtype=torch.float32)
    radii = torch.tensor(RADII_CM[1:]) * 0.0085
    bones = ends - starts

    def field_at(points):
        distances = []
        for start, bone, radius in zip(starts, bones, radii, strict=True):
            from_start = points - start
            share = ((from_start @ bone) / (bone @ bone)).clamp(0, 1)
            distances.append((from_start - share[:, None] * bone).norm(dim=1) - radius)
        distance = -torch.logsumexp(-70.0 * torch.stack(distances), dim=0) / 70.0
        density = 500.0 * torch.sigmoid(-distance / 0.003)
        stripe = torch.sigmoid(6.0 * torch.sin(2 * np.pi / 0.08 * points[:, 1]))
        side = torch.sigmoid(points[:, 0] / 0.02)
        rgb = torch.stack([0.15 + 0.7 * stripe, 0.2 + 0.5 * side, 0.8 - 0.6 * stripe], dim=1)
        return rgb, torch.where(density > 0.05, density, 0.0)

    return field_at


@pytest.fixture(scope="session")
def stand_in(rig) -> StandIn:
    return StandIn(rig, capsule_field(rig), (rig.skin_distance < 0.10).astype(np.uint8))


@pytest.fixture(scope="session")
def bent(stand_in: StandIn) -> BodyPose:
    """A stride with one elbow and one knee bent, seen from the side."""
    rotations = np.zeros((23, 3))
    rotations[0], rotations[1], rotations[3] = [-0.4, 0, 0], [0.4, 0, 0], [0.5, 0, 0]
    rotations[15], rotations[16], rotations[17] = [0.2, 0, -1.0], [-0.2, 0, 1.0], [0, -0.8, 0]
    return BodyPose(
        root_rotation=np.array([0, -0.4, 0]),
        root_translation=np.array([0.05, 0.02, -0.1]),
        joint_rotations=rotations,
    )


def camera_of(width: int, height: int, *, distance_m: float = 3.0) -> Camera:
    """Looks at the pelvis from the front."""
    eye, axes = np.array([0.0, -0.25, distance_m]), np.diag([1.0, -1.0, -1.0])
    return Camera.at(eye, axes, 1.4 * height, (width, height))


@pytest.fixture(scope="session")
def camera() -> Callable[..., Camera]:
    return camera_of


@pytest.fixture(scope="session")
def coarse() -> BakeConfig:
    """Fine enough to judge by, and quick to bake."""
    return BakeConfig(voxel_m=0.006, surfel_spacing_m=0.008)


@pytest.fixture(scope="session")
def views(stand_in: StandIn, bent: BodyPose) -> dict[str, tuple[BodyPose, Camera]]:
    view = camera_of(64, 80)
    return {"canonical": (stand_in.canonical, view), "bent": (bent, view)}


@pytest.fixture(scope="session")
def truth(stand_in: StandIn, views) -> dict[str, np.ndarray]:
    """The exact pictures of `views`."""
    return {name: stand_in.volume_render(*view) for name, view in views.items()}


@pytest.fixture(scope="session")
def exported(stand_in: StandIn, coarse: BakeConfig, views, truth, tmp_path_factory):
    """A package of the stand-in, exported as a trained avatar would be."""

    def renderer(pose, camera):
        return truth["bent" if pose is views["bent"][0] else "canonical"]

    (report,) = export_field(
        stand_in.field_at,
        stand_in.rig,
        stand_in.occupied,
        tmp_path_factory.mktemp("package") / "avatar.iavatar",
        views=list(views.values()),
        metrics={"psnr": 30.0},
        renderer=renderer,
        config=coarse,
    )
    assert isinstance(report, ExportReport)
    return report


@pytest.fixture(scope="session")
def package(exported: ExportReport) -> AvatarPackage:
    return read_package(exported.path)


@pytest.fixture(scope="session")
def tables(package: AvatarPackage) -> PlayerTables:
    return package.tables["hq"]


@pytest.fixture
def baked_already(tables: PlayerTables, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exports of the stand-in take the tables of the package."""
    monkeypatch.setattr(build, "sample_field", lambda *given, **more: None)
    monkeypatch.setattr(build, "bake_tables", lambda *given: tables)
