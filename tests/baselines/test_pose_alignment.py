"""Poses fitted to scored pictures: found again where a renderer is exact, and never worse."""

from dataclasses import replace

import numpy as np
import pytest

from baselines.systems.pose_alignment import align_pose
from instant_avatar.studio.actor import Actor
from preprocess.fitting.clip_poses import POSE_SIGMA, ClipPoses


@pytest.fixture(scope="module")
def actor():
    return Actor.of(1, 0)


@pytest.fixture
def draws(actor):
    """An exact renderer, and the poses that it was asked for."""
    asked = []

    def render(seen):
        asked.append(seen)
        color, alpha = actor.render_rgb_alpha(seen.pose, seen.camera)
        return np.dstack([color * alpha[..., None], alpha]).astype(np.float32)

    return render, asked


def joint_error_px(actor, one, other):
    """Distance of the joints across the view; a single picture does not tell depths."""
    camera = other.camera
    places = [camera.project(actor.shaped.with_pose(each.pose).joints()) for each in (one, other)]
    return float(np.linalg.norm(places[0] - places[1], axis=1).mean())


def test_a_wrong_pose_is_found_again(actor, clip, draws):
    true, noise = clip.novel, 0.5 * POSE_SIGMA * np.random.default_rng(1).standard_normal(75)
    view = true.camera.camera_from_world[None, :3, :3]
    begin = replace(true, pose=ClipPoses.stack([true.pose]).moved(noise[None], view)[0])
    render, asked = draws
    found = align_pose(render, begin, actor.shaped)
    assert len(asked) == 6
    assert joint_error_px(actor, found, true) < 0.4 * joint_error_px(actor, begin, true)
