"""Exact rendering: closed forms of a fog, invariants of cameras and poses, and no holes."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar import render as render_module
from avatar.config import TrainConfig
from avatar.correspondence_grid import CorrespondenceCheck
from avatar.kernels import operations
from avatar.kernels.operands import MarchSettings
from avatar.render import MIN_TRANSMITTANCE, body_frame_rays, correspondence_tables, render
from avatar.training.trainer import Trainer
from capture.camera import Camera
from preprocess.body.body_pose import BodyPose


@pytest.fixture(scope="module")
def avatar(learnt):
    return learnt.trainer.avatar


@pytest.fixture(scope="module")
def shot(learnt) -> tuple[BodyPose, Camera]:
    return learnt.novel.observation.pose, learnt.novel.observation.camera


@pytest.fixture(scope="module")
def picture(avatar, shot):
    return render(avatar, *shot)


def rigid(turn, shift) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    transform[:3, 3] = shift
    return transform


def moved(rig, pose: BodyPose, motion: np.ndarray) -> BodyPose:
    """The pose after a rigid motion of the world."""
    world_from_body = motion @ rig.world_from_body(pose)
    pelvis, turn = rig.rest_joints[0], world_from_body[:3, :3]
    return dataclasses.replace(
        pose,
        root_rotation=Rotation.from_matrix(turn).as_rotvec(),
        root_translation=world_from_body[:3, 3] - pelvis + turn @ pelvis,
    )


def decibels(a, b):
    return -10.0 * np.log10(np.mean((a.astype(np.float64) - b) ** 2) + 1e-12)


# --- what it is -------------------------------------------------------------------------------


def test_a_fog_is_as_opaque_as_its_length_says(rig, shot):
    """Constant density σ and color c: alpha = 1 - exp(-σ · step · samples), color = c · alpha.

    Of samples that skinning carries to the ray: the others hold nothing.
    """
    config = TrainConfig(levels=2, table_size=1 << 10, sample_step_m=0.03)
    avatar = Trainer(rig, config).avatar
    weights, bias = avatar.field.layers[2:]
    pose, camera = shot
    with torch.no_grad():
        weights.zero_()
        bias.copy_(torch.tensor([-1.0, 0.0, 2.0, 1.5]))
    got = render(avatar, pose, camera)
    cells = render_module.CorrespondenceGrid.solve(rig, pose.joint_rotations)
    pixels = camera.pixel_centers().reshape(-1, 2)
    batch = body_frame_rays(pixels, camera, rig.world_from_body(pose))
    how = MarchSettings(config.sample_step_m, np.inf, 512)
    tables = correspondence_tables(cells)
    samples = operations.march(batch, tables, avatar.rendering_grid(), how)
    strays = CorrespondenceCheck.for_pose(rig, pose.joint_rotations, cells)
    rays_of_strays = (
        torch.searchsorted(samples.offsets, strays.find_spurious(samples, batch), right=True) - 1
    )
    count = samples.counts.numpy() - np.bincount(rays_of_strays, minlength=len(pixels))
    alpha = 1.0 - np.exp(-np.exp(1.5) * config.sample_step_m * count.reshape(camera.size_px[::-1]))
    color = 1.0 / (1.0 + np.exp(-np.array([-1.0, 0.0, 2.0])))
    assert alpha.max() > 0.5
    np.testing.assert_allclose(got[..., 3], alpha, atol=1e-5)
    np.testing.assert_allclose(got[..., :3], alpha[..., None] * color, atol=1e-5)


def test_pictures_are_premultiplied_and_within_range(picture):
    assert picture.min() >= 0.0
    assert picture[..., 3].max() <= 1.0
    assert (picture[..., :3] <= picture[..., 3:] + 1e-6).all()
    assert picture[..., 3].max() > 0.99
    assert (picture[0] == 0.0).all()


def test_the_image_is_empty_where_the_camera_looks_past_the_person(rig, avatar, shot):
    pose, camera = shot
    turned_round = rigid([0.0, np.pi, 0.0], np.zeros(3)) @ camera.camera_from_world
    away = dataclasses.replace(camera, camera_from_world=turned_round)
    assert (render(avatar, pose, away) == 0.0).all()


def test_the_person_has_no_holes(learnt, avatar):
    """Two pixels inside the true silhouette everything is opaque."""
    for held in [*learnt.held, learnt.novel]:
        seen = held.observation
        inside = cv2.erode((seen.alpha > 0.99).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        alpha = render(avatar, seen.pose, seen.camera, cells=held.correspondences)[..., 3]
        assert inside.sum() > 80
        assert alpha[inside].min() > 0.9


def test_nothing_floats_beside_the_person(learnt, avatar):
    """Four pixels outside the true silhouette everything is clear."""
    for held in [*learnt.held, learnt.novel]:
        seen = held.observation
        near = cv2.dilate((seen.alpha > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        alpha = render(avatar, seen.pose, seen.camera, cells=held.correspondences)[..., 3]
        assert alpha[~near].max() < 0.1


# --- what does not change it ------------------------------------------------------------------


def test_only_where_camera_and_person_stand_to_each_other_matters(rig, avatar, shot, picture):
    pose, camera = shot
    motion = rigid([0.4, -1.1, 2.0], [3.0, -2.0, 5.0])
    elsewhere = dataclasses.replace(
        camera, camera_from_world=camera.camera_from_world @ np.linalg.inv(motion)
    )
    again = render(avatar, moved(rig, pose, motion), elsewhere)
    assert np.quantile(np.abs(again - picture), 0.999) < 2e-3
    assert decibels(again, picture) > 60.0


def test_how_many_rays_go_at_once_changes_nothing(avatar, shot, picture, monkeypatch):
    monkeypatch.setattr(render_module, "RAYS_PER_CHUNK", 700)
    np.testing.assert_allclose(render(avatar, *shot), picture, atol=2 * MIN_TRANSMITTANCE)


def test_a_warp_solved_before_gives_the_same_picture(learnt, avatar, shot, picture):
    np.testing.assert_array_equal(
        render(avatar, *shot, cells=learnt.novel.correspondences), picture
    )


def test_rendering_leaves_the_avatar_as_it_was(avatar, shot):
    grid = avatar.occupancy.density_grid
    before = [t.clone() for t in (*avatar.field.parameters(), grid.density, grid.occupied)]
    render(avatar, *shot)
    after = (*avatar.field.parameters(), grid.density, grid.occupied)
    assert all(torch.equal(a, b) for a, b in zip(after, before, strict=True))


# --- what changes it, and how -----------------------------------------------------------------


def test_a_principal_point_that_moves_by_pixels_shifts_the_picture(avatar, shot, picture):
    pose, camera = shot
    center = camera.center_px[0] + 3.0, camera.center_px[1] - 2.0
    shifted = render(avatar, pose, dataclasses.replace(camera, center_px=center))
    np.testing.assert_allclose(shifted[:-2, 3:], picture[2:, :-3], atol=1e-5)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_person_who_moves_by_a_pixel_is_seen_a_pixel_farther(rig, avatar, shot, picture, axis):
    """Perspective moves what is nearer a little more: by a twentieth of a pixel here."""
    pose, camera = shot
    world_from_camera = np.linalg.inv(camera.camera_from_world)
    pelvis = rig.rest_joints[0] + pose.root_translation
    depth = (camera.camera_from_world @ np.append(pelvis, 1.0))[2]
    step = world_from_camera[:3, axis] * depth / camera.focal_px[axis] * 2.0
    beside = render(avatar, moved(rig, pose, rigid(np.zeros(3), step)), camera)
    shifted = np.roll(picture, 2, axis=1 - axis)
    assert decibels(beside, shifted) > decibels(beside, picture) + 8.0
    assert decibels(beside, shifted) > 30.0


def test_a_larger_picture_shows_the_same_person(avatar, shot, picture):
    pose, camera = shot
    width, height = camera.size_px
    large = render(avatar, pose, camera.resize((2 * width, 2 * height)))
    small = large.reshape(height, 2, width, 2, 4).mean(axis=(1, 3))
    assert decibels(small, picture) > 30.0
    assert small[..., 3].sum() == pytest.approx(picture[..., 3].sum(), rel=0.01)


def test_a_bent_knee_moves_the_leg_alone(avatar, shot, picture):
    pose, camera = shot
    rotations = pose.joint_rotations.copy()
    rotations[3, 0] += 0.8
    bent = render(avatar, dataclasses.replace(pose, joint_rotations=rotations), camera)
    above, below = np.split(np.abs(bent - picture).max(axis=2), 2)
    assert below.max() > 0.5
    # a longer leg makes a longer box, and rays that enter it elsewhere are sampled elsewhere
    assert above.mean() < 0.05 * below.mean()


# --- the field behind it ----------------------------------------------------------------------


def test_there_is_nothing_outside_the_occupied_cells(rig, avatar, rng):
    grid = avatar.rendering_grid()
    low, high = rig.box_low - 0.3, rig.box_high + 0.3
    points = torch.from_numpy(rng.uniform(low, high, (20_000, 3)).astype(np.float32))
    color, density = avatar.color_and_density_at(points)
    cell = torch.floor((points - grid.low) * grid.cells_per_m).long().numpy()
    inside = ((cell >= 0) & (cell < grid.occupied.shape)).all(axis=1)
    held = np.zeros(len(points), dtype=bool)
    held[inside] = grid.occupied.numpy()[tuple(cell[inside].T)] != 0
    assert 100 < held.sum() < len(points)
    assert (density.numpy()[~held] == 0.0).all()
    assert (color.numpy()[~held] == 0.0).all()
    raw = avatar.field.raw_outputs_at(points[torch.from_numpy(held)].contiguous())
    np.testing.assert_allclose(color[held], torch.sigmoid(raw[:, :3]), atol=1e-6)
    np.testing.assert_allclose(density[held], raw[:, 3].clamp(max=9.0).exp(), rtol=1e-5)
