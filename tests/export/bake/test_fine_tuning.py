from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from baselines.reference_player import PlayerInputs, draw_reference
from export import build
from export.bake import fine_tuning
from export.bake.bake_tables import (
    BRICK_BYTES,
    THICK_FAINT_FRACTION,
    VOXEL_FACTORS,
    BakeConfig,
    bake_tables,
    sample_field,
)
from export.bake.compositor import VoxelCodes, back_project, composite_segments
from export.bake.fine_tuning import FineTuningInputs, fine_tune
from export.bake.traced_rays import RayTracer
from export.build import export_field
from export.package.package_file import read_package
from export.package.player_tables import QUALITY_TIERS, THICK_FIELD_TIERS
from export.player import Player, premultiply

SETTINGS = QUALITY_TIERS["hq"]


def inputs_of(rig, pose, camera) -> PlayerInputs:
    bones = camera.camera_from_world @ rig.world_from_body(pose)
    bones = bones @ rig.body_from_canonical(pose.joint_rotations)
    return PlayerInputs.of(bones[:, :3].astype(np.float32), camera, SETTINGS.samples)


@pytest.fixture(scope="module")
def renderer(package):
    """The player itself, by the tables as they were baked: what it shows can be reached."""
    player = Player(package)
    return lambda pose, camera: premultiply(player.render(pose, camera))


@pytest.fixture(scope="module")
def paler(renderer):
    return lambda *view: 0.92 * renderer(*view) + 0.08 * renderer(*view)[..., 3:]


@pytest.fixture(scope="module")
def codes(tables):
    return VoxelCodes.of(tables.bricks)


@pytest.fixture(scope="module")
def segments(stand_in, tables, views):
    inputs = inputs_of(stand_in.rig, *views["bent"])
    return RayTracer(tables, SETTINGS).trace(inputs.bones, views["bent"][1]).segments


@pytest.fixture(scope="module")
def spoilt(tables):
    """The tables, redder and less dense than they were baked."""
    voxels = tables.bricks.voxels.astype(int)
    voxels[..., 0] = np.minimum(voxels[..., 0] + 24, 248)
    voxels[..., 3] = np.where(voxels[..., 3] > 0, np.maximum(voxels[..., 3] - 16, 16), 0)
    voxels[0] = 0
    return replace(tables, bricks=replace(tables.bricks, voxels=voxels.astype(np.uint8)))


@pytest.fixture(scope="module", autouse=True)
def small_pictures():
    """What is learnt from and what judges is no larger than the views."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fine_tuning, "TRAINING_PX", 80)
        patch.setattr(fine_tuning, "VALIDATION_PX", 80)
        yield


@pytest.fixture(scope="module")
def tune(stand_in, views):
    def call(tables, renderer, progress=lambda _: None, **more):
        with ThreadPoolExecutor(1) as executor:
            inputs = FineTuningInputs(
                tables=tables,
                rig=stand_in.rig,
                settings=QUALITY_TIERS,
                renderer=renderer,
                views=list(views.values()),
                executor=executor,
                **more,
            )
            return fine_tune(inputs, max_pictures=6, progress=progress)

    return call


@pytest.fixture(scope="module")
def tuned(tune, renderer, spoilt):
    """The spoilt tables after tuning, the shares of progress, and how many images were drawn."""
    shares, poses = [], []

    def counted(pose, camera):
        poses.append(pose)
        return renderer(pose, camera)

    return tune(spoilt, counted, progress=shares.append), shares, len(poses)


def test_rays_have_segments_of_several_layers(segments):
    further = np.bincount(segments.layer)[1:]
    assert further.sum() > 20
    assert len(further) == SETTINGS.layers - 1


def test_color_updates_are_the_gradient_of_the_error(tables, segments, codes):
    generator = np.random.default_rng(2)
    targets = generator.random((segments.num_rays, 4)).astype(np.float32)
    update = back_project(segments, SETTINGS, tables.bricks, codes, targets)
    direction = generator.normal(size=codes.color.shape).astype(np.float32)

    def loss(size):
        moved = codes._replace(color=codes.color + np.float32(size) * direction)
        return squares(composite_segments(segments, SETTINGS, tables.bricks, moved) - targets)

    slope = (loss(1.0) - loss(-1.0)) / 2.0  # exact: the error is quadratic in colors
    assert (update.color * direction).sum() * 4.0 / 255.0**2 == pytest.approx(slope, rel=1e-2)


def test_density_updates_are_the_gradient_of_the_error(tables, segments, codes):
    generator = np.random.default_rng(3)
    # of one color, as where it is read depends on the density, too
    codes = VoxelCodes(
        density=np.where(codes.density > 0, codes.density - 30.0, 0.0).astype(np.float32),
        color=np.broadcast_to(np.float32([40.0, 120.0, 200.0]), codes.color.shape).copy(),
    )
    endless = replace(SETTINGS, min_transmittance=-1.0)  # a ray that ends would be a jump
    targets = np.zeros((segments.num_rays, 4), dtype=np.float32)
    update = back_project(segments, endless, tables.bricks, codes, targets)
    direction = generator.random(codes.density.shape).astype(np.float32) * (codes.density > 0)

    def loss(size):
        moved = codes._replace(density=codes.density + np.float32(size) * direction)
        return squares(composite_segments(segments, endless, tables.bricks, moved) - targets)

    slope = (loss(0.25) - loss(-0.25)) / 0.5
    assert (update.density * direction).sum() * 2.0 == pytest.approx(slope, rel=2e-2)


def squares(error) -> float:
    """On black and on white."""
    on_white = error[:, :3] - error[:, 3:]
    return float((error[:, :3].astype(float) ** 2).sum() + (on_white.astype(float) ** 2).sum())


@pytest.mark.parametrize("tier", QUALITY_TIERS)
def test_tuning_lowers_the_error_of_each_tier_on_a_view_that_it_did_not_see(
    stand_in, tuned, tables, spoilt, bent, camera, tier
):
    after, shares, images = tuned
    assert shares == sorted(shares)
    assert 0 < shares[0] < shares[-1] <= 1
    assert len(shares) == images + 3  # three rounds
    assert after.psnr[1] > after.psnr[0] + 1.0
    assert images == 10  # four judge, six are learnt from, each for both tiers
    pose = replace(bent, joint_rotations=0.6 * bent.joint_rotations)
    unseen = inputs_of(stand_in.rig, pose, camera(96, 120, distance_m=2.6))
    exact, before, now = (
        draw_reference(each, QUALITY_TIERS[tier], unseen) for each in (tables, spoilt, after.tables)
    )
    assert ((now - exact) ** 2).mean() < 0.8 * ((before - exact) ** 2).mean()
    assert after.tables.surfels is spoilt.surfels
    assert not after.tables.bricks.voxels[0].any()


@pytest.mark.slow
def test_what_is_exact_already_stays(tune, renderer, tables):
    after = tune(tables, renderer)
    assert after.tables is tables
    assert after.psnr[0] == after.psnr[1] > 50.0  # bytes of "hq", which "lite" does not reach


@pytest.mark.slow
def test_bricks_that_became_worse_are_not_kept(tune, renderer, spoilt):
    def lies(pose, camera):
        """True pictures for the judge, which come first; swapped channels for training."""
        lies.asked += 1
        picture = renderer(pose, camera)
        return picture if lies.asked <= 4 else picture[..., [2, 1, 0, 3]]

    lies.asked = 0
    assert tune(spoilt, lies).tables is spoilt
    assert lies.asked == 10


@pytest.fixture
def rewrite(stand_in, renderer, coarse, views, tmp_path):
    """Exports the stand-in, by its player's own pictures unless others are given."""
    field, path = (stand_in.field_at, stand_in.rig, stand_in.occupied), tmp_path / "avatar.iavatar"

    def export(pictures=4, renderer=renderer, **rest):
        rest |= {"config": replace(coarse, fine_tuning_pictures=pictures), "metrics": {}}
        return export_field(*field, path, views=list(views.values()), renderer=renderer, **rest)

    return export


@pytest.mark.usefixtures("baked_already")
@pytest.mark.parametrize("baked_first", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_ctrl_c_while_tuning_leaves_the_package_as_baked(rewrite, tables, baked_first):
    def interrupted(share):
        raise KeyboardInterrupt

    (report,) = rewrite(progress=interrupted, baked_first=baked_first)
    assert any("interrupted" in warning for warning in report.warnings) is not baked_first
    package = read_package(report.path)
    assert np.array_equal(package.tables["hq"].bricks.voxels, tables.bricks.voxels)


@pytest.mark.usefixtures("baked_already")
def test_the_fine_tuned_package_has_the_graphs_that_were_checked_as_baked(
    rewrite, paler, tables, monkeypatch
):
    checked, check = [], build.check_graph
    monkeypatch.setattr(build, "check_graph", lambda *given: checked.append(0) or check(*given))
    monkeypatch.setattr(build, "is_below_target", lambda inputs: False)
    first, tuned = rewrite(2, paler, baked_first=True)
    assert len(checked) == len(QUALITY_TIERS)  # each once
    assert tuned.largest_difference == first.largest_difference
    voxels = read_package(tuned.path).tables["hq"].bricks.voxels
    assert (voxels != tables.bricks.voxels).mean() > 0.2


def test_voxels_follow_from_the_bytes_of_a_thick_field():
    config = BakeConfig(voxel_m=0.004)
    for brick_bytes, factor in (
        (BRICK_BYTES, 1.0),
        (1.3**2.5 * BRICK_BYTES, 1.3),
        (1e9, VOXEL_FACTORS[1]),
        (1e3, VOXEL_FACTORS[0]),
    ):
        assert config.for_thick_field(brick_bytes).voxel_m == pytest.approx(factor * 0.004)


def test_haze_about_a_faint_core_is_inside_the_surface_of_a_thick_field(stand_in):
    def hazy(points):
        rgb, density = stand_in.field_at(points)
        return rgb, 120.0 * (density > 0) * (1.0 - 0.93 * (density < 0.5 * density.max()))

    usual = BakeConfig(voxel_m=0.008, surfel_spacing_m=0.012)

    def surfels(config):
        grid = sample_field(hazy, stand_in.rig, occupied=stand_in.occupied, config=config)
        return bake_tables(grid, stand_in.rig, config).surfels

    surfaces = [
        surfels(config) for config in (usual, replace(usual, faint_fraction=THICK_FAINT_FRACTION))
    ]
    assert len(surfaces[1]) > 1.01 * len(surfaces[0])


@pytest.mark.slow
def test_where_the_player_is_far_from_the_renderer_bytes_choose_the_voxels(
    rewrite, renderer, paler, tables
):
    usual, thick = (
        read_package([*rewrite(2, each, baked_first=True)][-1].path) for each in (renderer, paler)
    )
    voxel_m = tables.bricks.voxel_m
    assert usual.tables["hq"].bricks.voxel_m == pytest.approx(voxel_m)
    assert usual.manifest.tiers["hq"].settings == SETTINGS
    assert thick.tables["hq"].bricks.voxel_m == pytest.approx(VOXEL_FACTORS[0] * voxel_m)
    assert {tier: each.settings for tier, each in thick.manifest.tiers.items()} == (
        {tier: THICK_FIELD_TIERS[tier] for tier in thick.manifest.tiers}
    )
    assert thick.graphs["hq"] == build.serialize_graph(thick, "hq")
