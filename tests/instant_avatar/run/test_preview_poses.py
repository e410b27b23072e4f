"""The page's scene: where a browser looks, which pose it sees, and what is drawn for it."""

from dataclasses import replace

import numpy as np
import pytest

from avatar.config import TrainConfig
from avatar.correspondence_grid import CorrespondenceGrid
from avatar.render import render
from avatar.training.trainer import Trainer
from instant_avatar.run.live_viewer import (
    BACKGROUND_RGB,
    DANCE,
    NEWEST,
    SHEET_SHARE,
    BrowserCamera,
    PreviewPoses,
    render_preview,
)
from preprocess.body.kinematics import rotation_matrices
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.observation import DroppedFrame
from preprocess.open_capture import open_capture


@pytest.fixture(scope="module")
def recording(film) -> Capture:
    return open_capture(CaptureInputs(video=film))


@pytest.fixture(scope="module")
def observations(recording):
    return [item for item in recording.observations() if not isinstance(item, DroppedFrame)]


def look(**changes) -> BrowserCamera:
    """From 3.7 m before the origin, level."""
    first = BrowserCamera(
        world_from_camera=np.diag([1.0, -1.0, -1.0]),
        position=np.array([0.0, 0.0, 3.7]),
        fov=0.6,
        aspect=1.5,
        moved_at=0.0,
    )
    return replace(first, **changes)


def test_the_camera_looks_where_the_browser_does():
    camera = look().to_camera(100)
    assert camera.size_px == (150, 100)
    assert camera.project(np.zeros(3)) == pytest.approx([75.0, 50.0])
    right, up = camera.project(np.eye(3)[:2])
    assert right[0] > 75.0
    assert up[1] < 50.0
    half = 3.7 * np.tan(0.3)  # what the field of view holds, above and below
    assert camera.project(np.array([0.0, half, 0.0]))[1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("choice", [NEWEST, DANCE])
def test_every_pose_has_its_pelvis_at_the_origin(recording, observations, choice):
    poser = PreviewPoses(recording)
    for seconds in (0.0, 0.3, 100.0):
        pose = poser.pose_at(choice, seconds, observations[3])
        assert recording.shaped.with_pose(pose).joints()[0] == pytest.approx(np.zeros(3), abs=1e-9)


def test_the_first_look_sees_the_newest_frame_as_its_camera_did(recording, observations):
    poser, newest = PreviewPoses(recording), observations[5]
    page = recording.shaped.with_pose(poser.pose_at(NEWEST, 0.0, newest)).joints()
    world = recording.shaped.with_pose(newest.pose).joints()
    rotation = newest.camera.camera_from_world[:3, :3]
    seen_there = (world - world[0]) @ rotation.T
    seen_here = page @ look().to_camera(100).camera_from_world[:3, :3].T
    assert seen_here == pytest.approx(seen_there, abs=1e-6)


def test_on_a_phone_the_person_stands_above_the_sheet():
    camera = look(aspect=360 / 640).to_camera(640)
    person = np.array([[0.0, half, 0.0] for half in (-1.0, 1.0)])
    assert np.ptp(camera.project(person)[:, 1]) > 0.4 * 640
    assert camera.project(person)[:, 1].max() < (1.0 - SHEET_SHARE) * 640


def test_the_dance_goes_on_and_begins_again(recording):
    poser = PreviewPoses(recording)
    first, later = poser.pose_at(DANCE, 0.0, None), poser.pose_at(DANCE, 1.0, None)
    assert not np.allclose(first.joint_rotations, later.joint_rotations)
    assert poser.pose_at(DANCE, 3.0, None).joint_rotations == pytest.approx(first.joint_rotations)


def test_before_the_first_frame_the_person_stands(recording):
    standing = PreviewPoses(recording).pose_at(NEWEST, 0.0, None)
    assert rotation_matrices(standing.root_rotation) == pytest.approx(np.eye(3))


def test_the_avatar_stands_on_paper(recording, rig):
    config = TrainConfig(rays=64, sample_step_m=0.03, finest_m=0.05, levels=2, table_size=1 << 10)
    avatar = Trainer(rig, config).avatar  # nothing learnt: fog all around
    pose = PreviewPoses(recording).pose_at(NEWEST, 0.0, None)
    cells = CorrespondenceGrid.solve(rig, pose.joint_rotations)
    camera = look(aspect=1.2).to_camera(60)
    picture = render_preview(avatar, pose, camera, cells=cells)
    alpha = render(avatar, pose, camera, cells=cells)[..., 3]
    assert np.all(picture[alpha == 0.0] == BACKGROUND_RGB)
    fog = alpha > 0.02
    assert np.all((picture[fog] != BACKGROUND_RGB).any(axis=1))
    rows = np.flatnonzero(fog.any(axis=1))
    assert 0.7 < len(rows) / 60.0 <= 1.0  # the first look shows the whole person
