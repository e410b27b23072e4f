"""The picture of the head: the film's own pixels, where the camera saw them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from avatar.config import MAX_HEAD_PX
from avatar.evaluation.held_out import HeldOutFrame
from avatar.training import training_pixels
from avatar.training.frame_stream import separate_held_out
from avatar.training.training_pixels import picture_head


def filmed(observation, factor):
    """The observation as reduced from a film whose pixels are `factor` times as many a side.

    The film's green says at which column a pixel lies, its blue in which row, and it has stripes
    of one pixel in its red, which no reduced picture has.
    """
    width, height = (factor * side for side in observation.frame.size_px)
    rows, columns = np.mgrid[:height, :width]
    rgb = np.stack([columns % 2 * 255, 255 * columns / width, 255 * rows / height], axis=-1)
    return replace(observation, filmed_rgb=np.rint(rgb).astype(np.uint8))


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_each_pixel_has_the_color_at_its_place_in_the_film(rig, clip, factor):
    observation = filmed(clip.observations[0], factor)
    observation = replace(observation, alpha=np.ones_like(observation.alpha))  # no mixed pixels
    head = picture_head(observation, rig)
    camera, (width, height) = head.view.camera, observation.frame.size_px
    row, column = np.divmod(head.runs.flat_indices(), camera.size_px[0])
    sights = camera.ray_directions(np.stack([column, row], axis=-1) + 0.5)
    seen = sights @ camera.camera_from_world[:3, :3].T
    across, down = replace(observation.camera, camera_from_world=np.eye(4)).project(seen).T
    solid = head.colors[:, 3] == 255
    assert solid.sum() > 25
    red, green, blue = 255.0 * (head.colors[solid, :3] / head.colors[solid, 3:]).T
    np.testing.assert_allclose(green, 255 * (across[solid] - 0.5 / factor) / width, atol=1.5)
    np.testing.assert_allclose(blue, 255 * (down[solid] - 0.5 / factor) / height, atol=1.5)
    assert np.minimum(red, 255.0 - red).max() < 1.5


def test_a_head_of_many_pixels_is_reduced_to_a_bound(rig, clip, monkeypatch):
    whole = picture_head(filmed(clip.observations[0], 3), rig)
    monkeypatch.setattr(training_pixels, "MAX_HEAD_PX", 20)
    head = picture_head(filmed(clip.observations[0], 3), rig)
    assert max(head.view.camera.size_px) == 20 < max(whole.view.camera.size_px) <= MAX_HEAD_PX


def test_an_enlarged_mask_follows_the_edges_of_the_film(rig, clip):
    """Where the mask is reduced, and the film shows the person sharp before black."""
    observation, factor = clip.observations[0], 4
    large = tuple(factor * side for side in observation.frame.size_px)
    smooth = cv2.resize(observation.alpha, large, interpolation=cv2.INTER_CUBIC)
    person = np.repeat(np.uint8(200) * (smooth > 0.5)[..., None], 3, axis=-1)
    errors = []
    for rgb in (person, np.full_like(person, 200)):  # the second has no edge to follow
        head = picture_head(replace(observation, filmed_rgb=rgb), rig)
        places = np.divmod(head.runs.flat_indices(), head.view.camera.size_px[0])
        camera = observation.camera.resize(large)
        left, top = np.rint(np.subtract(camera.center_px, head.view.camera.center_px)).astype(int)
        truth = person[places[0] + top, places[1] + left, 0] > 0
        errors.append(np.abs(head.colors[:, 3] / 255.0 - truth).mean())
    assert errors[0] < 0.7 * errors[1]


def test_behind_the_camera_there_is_no_head(rig, clip):
    observation = clip.observations[0]
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ observation.camera.camera_from_world
    camera = replace(observation.camera, camera_from_world=turned)
    assert picture_head(replace(observation, camera=camera), rig) is None


def test_held_out_frames_do_not_keep_the_film(clip):
    items = separate_held_out([filmed(o, 2) for o in clip.observations], stride=5, total=None)
    held = [item.observation for item in items if isinstance(item, HeldOutFrame)]
    assert held
    assert all(observation.filmed_rgb is None for observation in held)
