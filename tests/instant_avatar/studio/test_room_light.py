"""Light stays in the room while the actor turns; cloth moves a little, and only cloth."""

import numpy as np
import pytest

from instant_avatar.studio.actor import A_POSE, Actor
from instant_avatar.studio.outfit import SHIRT, SKIN
from instant_avatar.studio.phone_pictures import SHIRT_M, WINDOW_FROM, MovingCloth, RoomLight
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import vertex_normals


@pytest.fixture(scope="module")
def actor():
    return Actor.of(1)


def turned_by(degrees):
    return BodyPose(
        root_rotation=np.array([0.0, np.deg2rad(degrees), 0.0]),
        root_translation=np.zeros(3),
        joint_rotations=A_POSE.reshape(23, 3),
    )


def test_what_faces_the_window_is_brighter_however_the_actor_stands(actor):
    light = RoomLight(actor)
    for degrees in (0.0, 90.0, 200.0):
        pose = turned_by(degrees)
        facing = vertex_normals(actor.vertices(pose), actor.faces) @ WINDOW_FROM
        on = light.on(actor, pose).mean(axis=1)
        assert np.median(on[facing > 0.8]) > np.median(on[facing < -0.2]) + 0.1


def test_the_light_on_the_skin_changes_when_the_actor_turns(actor):
    light = RoomLight(actor)
    change = light.on(actor, turned_by(0.0)) - light.on(actor, turned_by(180.0))
    assert np.abs(change).max() > 0.2
    assert abs(change.mean()) < 0.1


def test_cloth_moves_by_millimetres_and_skin_does_not(actor):
    cloth = MovingCloth(actor, seed=0)
    moved = [np.linalg.norm(cloth.displacement_m(t), axis=1) for t in (0.0, 0.6)]
    skin = np.unique(actor.faces[actor.materials == SKIN])
    shirt = np.unique(actor.faces[actor.materials == SHIRT])
    assert moved[0][skin].max() == 0.0
    assert 0.002 < moved[0][shirt].max() <= SHIRT_M + 1e-9
    difference = cloth.displacement_m(0.6) - cloth.displacement_m(0.57)
    assert np.linalg.norm(difference, axis=1).max() < 0.003  # smooth from frame to frame
