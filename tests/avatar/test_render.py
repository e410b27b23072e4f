"""Exact rendering: closed forms of a fog, invariants of cameras and poses, and no holes."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from avatar import render as render_module
from avatar.render import MIN_TRANSMITTANCE, render
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


def test_the_image_is_empty_where_the_camera_looks_past_the_person(rig, avatar, shot):
    pose, camera = shot
    turned_round = rigid([0.0, np.pi, 0.0], np.zeros(3)) @ camera.camera_from_world
    away = dataclasses.replace(camera, camera_from_world=turned_round)
    assert (render(avatar, pose, away) == 0.0).all()


def test_the_person_has_no_holes_and_nothing_floats_beside_it(learnt, avatar):
    """Opaque two pixels inside the true silhouette, clear four pixels outside of it."""
    for held in [*learnt.held, learnt.novel]:
        seen = held.observation
        inside = cv2.erode((seen.alpha > 0.99).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        near = cv2.dilate((seen.alpha > 0).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        alpha = render(avatar, seen.pose, seen.camera, cells=held.correspondences)[..., 3]
        assert inside.sum() > 80
        assert alpha[inside].min() > 0.9
        assert alpha[~near].max() < 0.1


# --- what changes it, and what does not ------------------------------------------------------


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
