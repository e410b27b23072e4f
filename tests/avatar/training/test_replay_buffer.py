"""Replay: rays and the picture of the head are the film's, and frames that stay are worth it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from avatar.config import MAX_HEAD_PX
from avatar.evaluation.held_out import HeldOutFrame
from avatar.training import training_pixels
from avatar.training.frame_stream import prepare_frame, separate_held_out
from avatar.training.replay_buffer import (
    HEAD_SIDE_RAY_SHARE,
    MAX_HEAD_RAY_SHARE,
    NEAR_PERSON_RAY_SHARE,
    ReplayBuffer,
)
from avatar.training.training_pixels import PixelRuns, picture_head
from preprocess.body.body_pose import BodyPose
from preprocess.masks.matting import person_colors


@pytest.fixture(scope="module")
def frames(rig, clip):
    """Four prepared frames, from four sides."""
    return [prepare_frame(clip.observations[i], rig) for i in (0, 5, 11, 18)]


def store(frames, capacity=8) -> ReplayBuffer:
    replay = ReplayBuffer(capacity)
    for frame in frames:
        replay.add(frame)
    return replay


def cut(frame, near, far):
    """The same frame with fewer pixels."""
    width, height = frame.view.camera.size_px
    masks = np.zeros((2, height * width), dtype=bool)
    places, count = frame.pixels.flat_indices(), frame.pixels.near_count
    masks[0, places[:near]] = masks[1, places[count : count + far]] = True
    pixels = PixelRuns.of(*masks.reshape(2, height, width))
    return replace(frame, pixels=pixels, colors=frame.colors[:near], head=None)


def posed(frame, index, *, knee):
    """The frame under another index, with a knee bent by `knee` radians."""
    rotations = np.zeros((23, 3))
    rotations[3, 0] = knee
    pose = replace(BodyPose.rest(), joint_rotations=rotations)
    return replace(frame, index=index, pose=pose)


def places(batch, frames):
    """Number of each ray's pixel in its frame; fails if it is none of them."""
    found = np.empty(len(batch.rays.slots), dtype=int)
    for slot, frame in enumerate(frames):
        mine, camera = (batch.rays.slots == slot).numpy(), frame.view.camera
        sights = batch.rays.directions.numpy()[mine] @ frame.body_from_camera
        pixels = sights[:, :2] / sights[:, 2:] * camera.focal_px + camera.center_px
        column, row = np.floor(pixels).astype(int).T
        np.testing.assert_allclose(pixels, np.stack([column, row], axis=1) + 0.5, atol=1e-3)
        numbers = {place: number for number, place in enumerate(frame.pixels.flat_indices())}
        found[mine] = [numbers[place] for place in row * camera.size_px[0] + column]
    return found


BORDER_LEVELS = 12.0
"""Difference of a border pixel's color in the head's picture: it is cut out before its background
is taken away."""


def colors_of(frame):
    """Colors of all training pixels of a frame."""
    far = np.zeros((frame.pixels.count - frame.pixels.near_count, 4), dtype=np.uint8)
    return np.concatenate([frame.colors, far])


def drawn_from(replay, generator, count=40_000):
    """The share of the rays that each slot gets."""
    slots = replay.sample_rays(count, generator).rays.slots.long()
    return torch.bincount(slots, minlength=len(replay)).numpy() / count


def test_targets_are_the_videos_colors_along_exactly_those_rays(rig, clip, frames, generator):
    """From the ray back through the root's motion and the camera to a pixel of the picture."""
    batch = store(frames).sample_rays(4000, generator)
    for slot, index in enumerate((0, 5, 11, 18)):
        seen, mine = clip.observations[index], (batch.rays.slots == slot).numpy()
        world = rig.world_from_body(seen.pose)
        origin = batch.rays.origins.numpy()[mine].astype(np.float64)
        along = origin + 3.0 * batch.rays.directions.numpy()[mine]
        for point in (origin, along):
            point[:] = point @ world[:3, :3].T + world[:3, 3]
        np.testing.assert_allclose(origin - seen.camera.center_world, 0.0, atol=1e-5)
        pixels = seen.camera.project(along)
        column, row = np.floor(pixels).astype(int).T
        np.testing.assert_allclose(pixels, np.stack([column, row], axis=1) + 0.5, atol=1e-3)
        alpha = seen.alpha[row, column][:, None]
        color = person_colors(seen.frame.rgb, seen.alpha)[row, column] / 255.0
        shown = np.concatenate([color * alpha, alpha], axis=1)
        np.testing.assert_allclose(batch.target.numpy()[mine], shown, atol=BORDER_LEVELS / 255)


def test_a_video_whose_lens_changes_is_seen_through_each_frames_own(frames, generator):
    """One lens zooms, another bends."""
    own = []
    for frame, change in zip(
        frames, ({}, {"focal_px": (90.0, 91.0)}, {"distortion": (0.1, 0.0, 0.0, 0.0)}), strict=False
    ):
        view = frame.view._replace(camera=replace(frame.view.camera, **change))
        own.append(replace(frame, view=view, head=None))
    batch = store(own).sample_rays(600, generator)
    for slot, frame in enumerate(own):
        mine = batch.rays.directions.numpy()[(batch.rays.slots == slot).numpy()]
        nearest = (mine @ frame.directions().T).max(axis=1)
        np.testing.assert_allclose(nearest, 1.0, atol=1e-6)


def test_a_frame_takes_five_bytes_a_pixel_near_the_person(frames):
    """Rays are found from runs of pixels; colors are kept where they are not zero."""
    for frame in frames:
        runs = frame.pixels
        held = frame.colors.nbytes + runs.ends.nbytes + runs.shifts.nbytes
        held += frame.view.near_person_bits.nbytes
        assert held < 8.0 * runs.near_count  # of a small picture; larger ones have longer runs
        assert len(frame.colors) == runs.near_count < runs.count


def test_rays_begin_anywhere_within_a_step(frames, generator):
    jitter = store(frames).sample_rays(20_000, generator).rays.jitter
    assert 0.0 <= float(jitter.min()) < float(jitter.max()) < 1.0
    assert float(jitter.mean()) == pytest.approx(0.5, abs=0.01)
    assert float(jitter.std()) == pytest.approx(12**-0.5, abs=0.01)


def test_nine_rays_in_ten_go_near_the_person(frames, generator):
    batch = store(frames).sample_rays(20_000, generator)
    near = np.array([frame.pixels.near_count for frame in frames])[batch.rays.slots.numpy()]
    share = float((places(batch, frames) < near).mean())
    assert share == pytest.approx(NEAR_PERSON_RAY_SHARE, abs=0.01)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.too_slow])
@given(sizes=st.lists(st.tuples(st.integers(1, 60), st.integers(0, 60)), min_size=1, max_size=4))
def test_whatever_the_frames_hold_rays_stay_within_it(frames, sizes):
    """Frames without far pixels, with a single pixel, later ones larger than earlier ones."""
    small = [cut(f, near, far) for f, (near, far) in zip(frames, sizes, strict=False)]
    batch = store(small).sample_rays(400, torch.Generator().manual_seed(1))
    colors = [colors_of(small[slot]) for slot in batch.rays.slots.tolist()]
    place = places(batch, small)
    expected = np.stack([c[p] for c, p in zip(colors, place, strict=True)]) / np.float32(255.0)
    np.testing.assert_array_equal(batch.target.numpy(), expected.astype(np.float32))


def test_stores_that_grow_keep_what_they_hold(frames):
    replay = store([cut(frames[0], 3, 2), cut(frames[1], 40, 0), frames[2]])
    for slot, frame in enumerate(frames[:3]):
        index, roots = frame.correspondences.packed_cells.reshape(-1), frame.correspondences.roots
        tables = replay.correspondences
        np.testing.assert_array_equal(tables.packed_cells[slot, : len(index)], index)
        np.testing.assert_array_equal(tables.roots[slot, : len(roots)], roots)
        np.testing.assert_array_equal(tables.low[slot], frame.correspondences.low)
        assert tuple(tables.shape[slot].tolist()) == frame.correspondences.packed_cells.shape
    assert replay.correspondences.cell_m == frames[0].correspondences.cell_m


def test_frames_can_be_saved_after_their_correspondences_are_cleared(frames):
    replay = store(frames)
    before = replay.replay_frames()
    replay.clear_correspondences()
    tables = replay.correspondences
    assert sum(table.nbytes for table in (tables.packed_cells, tables.roots)) < 1000
    assert not tables.packed_cells.any()
    for one, other in zip(before, replay.replay_frames(), strict=True):
        assert one.pose is other.pose
        assert np.array_equal(one.colors, other.colors)


def test_rays_are_drawn_uniformly_from_all_frames(frames, generator):
    replay = store(frames[:2])
    np.testing.assert_allclose(drawn_from(replay, generator), [0.5, 0.5], atol=0.01)
    replay.add(frames[2])
    np.testing.assert_allclose(drawn_from(replay, generator), [1 / 3] * 3, atol=0.01)


def test_when_full_the_more_replaceable_of_the_two_most_alike_goes(frames):
    knees = {10: 0.0, 11: 0.3, 12: 1.5, 13: 2.5}
    replay = store([posed(frames[0], i, knee=k) for i, k in knees.items()], capacity=4)
    replay.add(posed(frames[0], 20, knee=9.0))  # 11 is nearer to 12 than 10 is
    assert sorted(replay.frame_indices) == [10, 12, 13, 20]
    replay.add(posed(frames[0], 21, knee=5.0))  # then 12 and 13 are most alike; 12 is nearer to 10
    assert sorted(replay.frame_indices) == [10, 13, 20, 21]


@given(capacity=st.integers(1, 6), arriving=st.integers(1, 12))
@settings(deadline=None, max_examples=12)
def test_the_capacity_is_kept_and_the_newest_frame_is_in(frames, capacity, arriving):
    replay = ReplayBuffer(capacity)
    for index in range(arriving):
        replay.add(posed(cut(frames[0], 5, 5), index, knee=0.1 * index))
        assert index in replay.frame_indices
    assert len(replay) == len(set(replay.frame_indices)) == min(capacity, arriving)


def test_a_slot_that_is_taken_over_shows_the_new_frame(frames, generator):
    replay = store(frames[:3], capacity=2)
    held = [next(f for f in frames if f.index == index) for index in replay.frame_indices]
    batch = replay.sample_rays(2000, generator)
    place = places(batch, held)
    shown = np.stack([colors_of(held[s])[p] for s, p in zip(batch.rays.slots, place, strict=True)])
    np.testing.assert_array_equal(batch.target.numpy()[:, 3] * 255.0, shown[:, 3])
    np.testing.assert_allclose(batch.target.numpy() * 255.0, shown, atol=BORDER_LEVELS)
    np.testing.assert_array_equal(
        batch.rays.origins, np.stack([held[s].origin for s in batch.rays.slots])
    )


def test_cached_distances_are_those_computed_afresh(frames, rng):
    """What goes is chosen from distances that are updated one row at a time."""
    replay = ReplayBuffer(6)
    for index in range(40):
        turned = replace(frames[0].pose, joint_rotations=rng.normal(size=(23, 3)))
        replay.add(replace(frames[index % 4], index=index, pose=turned))
    likeness = replay._descriptors
    expected = np.linalg.norm(likeness[:, None] - likeness[None], axis=-1)
    np.fill_diagonal(expected, np.inf)
    np.testing.assert_allclose(replay._descriptor_distances, expected)


def test_the_head_gets_more_rays_than_its_pixels(frames):
    """Half of the square root of the shares of pixels: 0.15 where the film is not reduced."""
    batch = store(frames).sample_rays(8000, torch.Generator().manual_seed(0))
    found = places(batch, frames)
    for slot, frame in enumerate(frames):
        natural = frame.head.runs.near_count / frame.pixels.near_count
        drawn = HEAD_SIDE_RAY_SHARE * natural**0.5
        assert natural < 0.12 < drawn < MAX_HEAD_RAY_SHARE
        expected = NEAR_PERSON_RAY_SHARE * (drawn + (1.0 - drawn) * natural)
        inside = np.isin(found, head_numbers(frame))[(batch.rays.slots == slot).numpy()]
        assert np.mean(inside) == pytest.approx(expected, abs=0.04)


def test_a_head_of_more_pixels_gets_more_rays_up_to_a_bound(rig, clip):
    """The film before it is reduced: rays of the head lie between the reduced frame's pixels."""
    observation, shares = clip.observations[0], []
    for factor in (1, 2, 4):
        width, height = observation.frame.size_px
        filmed = cv2.resize(observation.frame.rgb, (factor * width, factor * height))
        frame = prepare_frame(replace(observation, filmed_rgb=filmed), rig)
        batch = store([frame]).sample_rays(8000, torch.Generator().manual_seed(0))
        sights = batch.rays.directions.numpy() @ frame.body_from_camera
        camera = frame.head.view.camera
        pixels = sights[:, :2] / sights[:, 2:] * camera.focal_px + camera.center_px
        off_center = np.abs(pixels - np.floor(pixels) - 0.5).max(axis=1)
        is_inside = ((pixels > 0.0) & (pixels < camera.size_px)).all(axis=1)
        shares.append(np.mean(is_inside & (off_center < 1e-3)))
    assert shares[0] < shares[1] < shares[2]
    assert shares[2] == pytest.approx(NEAR_PERSON_RAY_SHARE * MAX_HEAD_RAY_SHARE, abs=0.02)


def head_numbers(frame):
    """Numbers, among the frame's training pixels, of those that its picture of the head has."""
    shift = np.subtract(frame.view.camera.center_px, frame.head.view.camera.center_px)
    (left, top), width = np.rint(shift).astype(int), frame.view.camera.size_px[0]
    row, column = np.divmod(frame.head.runs.flat_indices(), frame.head.view.camera.size_px[0])
    places = (row + top) * width + column + left
    return np.flatnonzero(np.isin(frame.pixels.flat_indices(), places))


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
