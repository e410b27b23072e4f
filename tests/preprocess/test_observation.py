"""Frames, poses, masks and cameras joined by order, time or name, or refused for a reason."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.input_error import InputError
from capture.live_sources import silence_opencv
from capture.source_opening import open_source
from preprocess.body.body_pose import Motion
from preprocess.cameras.camera_file import CameraTrack, assume_static_camera
from preprocess.frame_association import associate_by_name
from preprocess.masks.mask_files import open_masks
from preprocess.masks.mask_sources import AlphaChannelMasks, StoredMasks
from preprocess.observation import (
    DroppedFrame,
    Observation,
    associate_poses,
    observation_builder,
)
from preprocess.tracking.video_tracking import (
    ANOTHER_NEAR,
    DISAGREEING,
    NOT_FOUND,
    PROBLEM_BITS,
    TrackingProblem,
)
from tests.motions import make_motion, make_track

SIZE = (48, 64)
COUNT = 8


def moving(rows: int, **changes) -> Motion:
    """Poses that carry their row in x."""
    translations = np.zeros((rows, 3))
    translations[:, 0] = np.arange(rows)
    return make_motion(np.zeros((rows, 3)), translations, **changes)


@pytest.fixture
def images(tmp_path):
    """Pictures, and masks with a person, that carry their number in their brightness."""
    (tmp_path / "images").mkdir()
    (tmp_path / "masks").mkdir()
    for index in range(COUNT):
        mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        mask[16:48, 16:32] = 200 + index
        cv2.imwrite(str(tmp_path / "masks" / f"{index}.png"), mask)
        cv2.imwrite(str(tmp_path / "images" / f"{index}.png"), np.full((*mask.shape, 3), index))
    return tmp_path


@pytest.fixture
def parts(images):
    def parts(frames=None):
        source = open_source(images / "images", frames=frames)
        masks = open_masks(images / "masks")
        return source, masks, assume_static_camera(moving(1), source.size_px)

    return parts


def observe(source, motion, masks, cameras, **options):
    """Observations of the wanted frames in order, lazily."""
    given = AlphaChannelMasks(source) if masks is None else StoredMasks(masks, source)
    return map(observation_builder(source, motion, given, cameras, **options), source.frames())


def rows_of(observations) -> list[int]:
    return [int(o.pose.root_translation[0]) for o in observations]


def test_everything_of_one_frame_comes_together(parts):
    source, masks, cameras = parts()
    observations = list(observe(source, moving(COUNT), masks, cameras))
    assert all(isinstance(o, Observation) for o in observations)
    assert rows_of(observations) == list(range(COUNT))
    for index, o in enumerate(observations):
        assert o.frame.index == index == o.frame.rgb[0, 0, 0]
        assert round(float(o.alpha.max()) * 255) == 200 + index
        assert o.camera.size_px == SIZE


def test_pictures_masks_and_cameras_shrink_together_and_never_grow(parts):
    source, masks, cameras = parts()
    (small, *_), (large, *_) = (
        observe(source, moving(COUNT), masks, cameras, size_px=size) for size in (32, 500)
    )
    assert small.alpha.shape == (32, 24)
    assert small.frame.rgb.shape == (32, 24, 3)
    assert small.camera.focal_px[0] == cameras[0].focal_px[0] / 2
    np.testing.assert_allclose(small.alpha[8:24, 8:16], 200 / 255, atol=1e-6)
    assert large.alpha.shape == (64, 48)


@pytest.mark.parametrize("rows", [COUNT, 3])
def test_with_a_selection_rows_may_count_all_frames_or_the_chosen_ones(parts, rows):
    source, masks, cameras = parts(slice(1, None, 3))
    observations = list(observe(source, moving(rows), masks, cameras))
    assert [o.frame.index for o in observations] == [1, 4, 7]
    assert rows_of(observations) == ([1, 4, 7] if rows == COUNT else [0, 1, 2])
    assert [round(float(o.alpha.max()) * 255) - 200 for o in observations] == [1, 4, 7]


def test_rows_belong_to_the_frames_that_they_name(parts):
    source, masks, cameras = parts()
    motion = moving(5, frames=np.array([7, 5, 3, 1, 100]))
    results = list(observe(source, motion, masks, cameras))
    assert rows_of(r for r in results if isinstance(r, Observation)) == [3, 2, 1, 0]
    dropped = [(r.index, r.reason) for r in results if isinstance(r, DroppedFrame)]
    assert dropped == [(0, "no pose"), (2, "no pose"), (4, "no pose"), (6, "no pose")]


def test_rows_belong_to_the_frames_of_their_time(parts):
    source, masks, cameras = parts()
    times = np.array([5, 3, 4, 1, np.nan]) / 30 + 0.004
    motion = moving(5, times_s=times, valid=np.isfinite(times))
    results = list(observe(source, motion, masks, cameras))
    taken = [(r.frame.index, *rows_of([r])) for r in results if isinstance(r, Observation)]
    assert taken == [(1, 3), (3, 1), (4, 2), (5, 0)]


@pytest.mark.parametrize("rows", [1, COUNT - 1, COUNT + 1])
def test_more_or_fewer_rows_than_frames_are_refused_with_both_counts(parts, rows):
    source, masks, cameras = parts()
    with pytest.raises(InputError, match=rf"{rows} poses, but {COUNT} frames"):
        observe(source, moving(rows), masks, cameras)


def test_poses_for_other_frames_are_refused(parts):
    source, masks, cameras = parts(slice(4, None))
    with pytest.raises(InputError, match="0 to 3"):
        observe(source, moving(4, frames=np.arange(4)), masks, cameras)


def test_invalid_poses_are_dropped_and_listed(parts):
    source, masks, cameras = parts()
    valid = np.arange(COUNT) % 2 == 0
    results = list(observe(source, moving(COUNT, valid=valid), masks, cameras))
    dropped = [(r.index, r.reason) for r in results if isinstance(r, DroppedFrame)]
    assert dropped == [(i, "pose invalid") for i in (1, 3, 5, 7)]


def test_tracked_frames_are_dropped_for_what_was_seen_in_them(parts):
    source, masks, cameras = parts()
    found = [0, 1, 2, 3, 4, 6, 7]
    crowded = PROBLEM_BITS[TrackingProblem.CROWDED]
    problems = np.where(np.array(found) == 1, crowded, 0)
    track = make_track(np.array(found), SIZE, problems=problems)
    valid = ~np.isin(np.arange(COUNT), [1, 3, 5])
    motion = moving(COUNT, valid=valid, frames=np.arange(COUNT), keypoints=track)
    results = list(observe(source, motion, masks, cameras))
    dropped = {r.index: r.reason for r in results if isinstance(r, DroppedFrame)}
    assert dropped == {1: ANOTHER_NEAR, 3: DISAGREEING, 5: NOT_FOUND}


def test_more_than_half_of_the_poses_invalid_is_refused_at_once(parts):
    source, masks, cameras = parts()
    with pytest.raises(InputError, match=f"3 of {COUNT}"):
        observe(source, moving(COUNT, valid=np.arange(COUNT) < 3), masks, cameras)


def test_empty_and_unreadable_masks_are_dropped_and_listed(parts, images):
    (images / "masks" / "3.png").write_bytes(b"damaged")
    cv2.imwrite(str(images / "masks" / "5.png"), np.zeros((64, 48), np.uint8))
    cv2.imwrite(str(images / "masks" / "6.png"), np.full((48, 64), 255, np.uint8))
    source, _, cameras = parts()
    masks = open_masks(images / "masks", invert=False)
    results = list(observe(source, moving(COUNT), masks, cameras))
    reasons = {r.index: r.reason for r in results if isinstance(r, DroppedFrame)}
    assert set(reasons) == {3, 5, 6}
    assert "mask unusable" in reasons[3]
    assert reasons[5] == "mask empty"
    assert "64x48 px, its image 48x64" in reasons[6]


def test_the_alpha_channel_of_the_pictures_serves_as_mask(tmp_path):
    rgba = np.zeros((64, 48, 4), np.uint8)
    rgba[16:48, 16:32, 3] = 128
    for index in range(2):
        cv2.imwrite(str(tmp_path / f"{index}.png"), rgba)
    source = open_source(tmp_path)
    cameras = assume_static_camera(moving(1), source.size_px)
    first, _ = observe(source, moving(2), None, cameras, size_px=32)
    np.testing.assert_allclose(first.alpha[8:24, 8:16], 128 / 255, atol=0.5 / 255)
    assert first.frame.alpha.shape == first.alpha.shape


def test_masks_must_be_one_per_frame_and_of_the_frames_shape(parts, images):
    source, _, cameras = parts()
    stack = [open_masks(images / "masks").alpha(row, source.size_px) for row in range(7)]
    np.savez(images / "short.npz", np.stack(stack))
    with pytest.raises(InputError, match=rf"7 masks in .* {COUNT} frames"):
        observe(source, moving(COUNT), open_masks(images / "short.npz"), cameras)
    np.savez(images / "turned.npz", np.rot90(cv2.imread(str(images / "masks/0.png"))[..., 0])[None])
    with pytest.raises(InputError, match="64x48 px, the frames 48x64"):
        observe(source, moving(COUNT), open_masks(images / "turned.npz"), cameras)


def test_frames_whose_mask_is_missing_are_left_out_where_names_tell(parts, images):
    for number in (2, 7):
        (images / "masks" / f"{number}.png").unlink()
    source, masks, cameras = parts()
    results = list(observe(source, moving(COUNT), masks, cameras))
    reasons = {r.index: r.reason for r in results if isinstance(r, DroppedFrame)}
    assert set(reasons) == {2, 7}
    assert "holds none for frame 2" in reasons[2]
    seen = {r.frame.index: r.alpha.max() for r in results if isinstance(r, Observation)}
    assert seen == {n: pytest.approx((200 + n) / 255) for n in (0, 1, 3, 4, 5, 6)}


def test_tracked_masks_of_few_frames_belong_to_these_while_they_are_being_written(parts, images):
    """Most pictures may be of another size, or damaged."""
    source, _, cameras = parts()
    (unfinished := images / ".instant-avatar-masks.part").mkdir()
    for number in (2, 5):
        shutil.copyfile(images / "masks" / f"{number}.png", unfinished / f"{number:06d}.png")
    results = observe(source, moving(COUNT), open_masks(unfinished), cameras)
    assert [r.frame.index for r in results if isinstance(r, Observation)] == [2, 5]


def test_masks_that_are_turned_among_others_are_left_out_and_obeyed_where_told(parts, images):
    path = images / "masks" / "4.png"
    cv2.imwrite(str(path), 255 - cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    source, masks, cameras = parts()
    results = list(observe(source, moving(COUNT), masks, cameras))
    assert [r.index for r in results if isinstance(r, DroppedFrame)] == [4]
    told = observe(source, moving(COUNT), open_masks(images / "masks", invert=False), cameras)
    assert not any(isinstance(r, DroppedFrame) for r in told)


@pytest.mark.parametrize(("scale", "shift"), [(1000.0, 0.0), (1.0, 1.7e9), (1e-3, 0.0)])
def test_times_by_another_clock_are_refused_and_never_taken_for_the_nearest(parts, scale, shift):
    source, masks, cameras = parts(frames=slice(0, None))
    times = np.arange(20) / 30 * scale + shift
    motion = moving(20, times_s=times)
    with pytest.raises(InputError, match=r"frames of .* those of 0 to 0.267 s; .*milliseconds"):
        observe(source, motion, masks, cameras)


def test_moving_cameras_follow_their_frames(parts):
    source, masks, cameras = parts(slice(2, None, 2))
    track = tuple(replace(cameras[0], focal_px=(100.0 + index, 100.0)) for index in range(COUNT))
    moving_track = CameraTrack(cameras=track, source="cameras.npz")
    observations = list(observe(source, moving(COUNT), masks, moving_track))
    assert [o.camera.focal_px[0] for o in observations] == [102.0, 104.0, 106.0]
    short = CameraTrack(cameras=track[:5], source="cameras.npz")
    with pytest.raises(InputError, match=r"5 cameras in cameras\.npz"):
        observe(source, moving(COUNT), masks, short)


def test_a_truncated_video_is_used_as_far_as_it_goes(tmp_path):
    """The poses fit what the container claims, or what there is; both go on."""
    silence_opencv()
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, SIZE)
    rng = np.random.default_rng(0)
    for _ in range(30):
        writer.write(rng.integers(0, 255, (SIZE[1], SIZE[0], 3), dtype=np.uint8))
    writer.release()
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    source = open_source(path)
    there = source.count_frames()
    assert 5 < there < 30
    (tmp_path / "masks").mkdir()
    mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    mask[16:48, 16:32] = 255
    for index in range(30):
        cv2.imwrite(str(tmp_path / "masks" / f"{index:03}.png"), mask)
    masks, cameras = open_masks(tmp_path / "masks"), assume_static_camera(moving(1), source.size_px)
    for rows in (30, there):
        observations = list(observe(source, moving(rows), masks, cameras))
        assert rows_of(observations) == list(range(there))
    assert f"only {there} of 30 frames" in source.warnings[0]
    with pytest.raises(InputError, match=f"{there - 1} poses, but {there} frames"):
        associate_poses(moving(there - 1), source)


@pytest.fixture(scope="module")
def film(tmp_path_factory) -> Path:
    """Five frames."""
    path = tmp_path_factory.mktemp("film") / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (32, 24))
    for _ in range(5):
        writer.write(np.zeros((24, 32, 3), np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize(
    ("names", "rows"),
    [
        (["m_0", "m_1", "m_3"], {0: 0, 1: 1, 3: 2}),  # from 0
        (["000001", "000004", "000005"], {0: 0, 3: 1, 4: 2}),  # from 1: the last is there
        (["a2_0000", "a2_0001", "a2_0004"], {0: 0, 1: 1, 4: 2}),
        (["m_0", "m_4"], None),  # most would have none
        (["m_0", "m_1", "m_2"], None),  # the first three, or a few chosen ones
        (["m_1", "m_2", "m_4"], None),  # from 0 or from 1
        (["m_0", "m_1", "m_5"], None),  # of a longer film
        (["m_0", "n_0", "m_3"], None),
        (["zero", "m_1", "m_3"], None),
    ],
)
def test_numbers_count_the_frames_of_a_film_of_five(names, rows, film):
    assert associate_by_name(names, open_source(film)) == rows


@pytest.mark.parametrize(
    ("names", "rows"),
    [
        (["shot_12", "shot_15"], {0: 0, 2: 1}),
        (["mask_13", "mask_15"], {1: 0, 2: 1}),
        (["mask_13", "mask_14"], None),  # there is no picture 14
        (["a", "b"], None),
    ],
)
def test_masks_of_pictures_belong_to_those_of_their_name_or_number(names, rows, tmp_path):
    for number in (12, 13, 15):
        cv2.imwrite(str(tmp_path / f"shot_{number}.png"), np.zeros((8, 8, 3), np.uint8))
    assert associate_by_name(names, open_source(tmp_path)) == rows
