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
from capture.video_writer import FFV1, write_video
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
def source(images):
    return open_source(images / "images")


@pytest.fixture
def masks(images):
    return open_masks(images / "masks")


def builder(source, motion, masks, cameras=None, **options):
    """A function from a frame to its observation; a static camera unless others are given."""
    given = AlphaChannelMasks(source) if masks is None else StoredMasks(masks, source)
    cameras = cameras or assume_static_camera(moving(1), source.size_px)
    return observation_builder(source, motion, given, cameras, **options)


def observe(*parts, **options) -> tuple[dict[int, Observation], dict[int, str]]:
    """Observations of frames by their number, and why other frames were dropped."""
    results = list(map(builder(*parts, **options), parts[0].frames()))
    seen = {r.frame.index: r for r in results if isinstance(r, Observation)}
    return seen, {r.index: r.reason for r in results if isinstance(r, DroppedFrame)}


def rows_of(seen: dict[int, Observation]) -> dict[int, int]:
    """The row of the poses that each frame has."""
    return {index: int(o.pose.root_translation[0]) for index, o in seen.items()}


def test_everything_of_one_frame_comes_together(source, masks):
    seen, _ = observe(source, moving(COUNT), masks)
    assert rows_of(seen) == {number: number for number in range(COUNT)}
    for index, o in seen.items():
        assert index == o.frame.rgb[0, 0, 0]
        assert round(float(o.alpha.max()) * 255) == 200 + index
        assert o.camera.size_px == SIZE


def test_pictures_masks_and_cameras_shrink_together_and_never_grow(source, masks):
    small, full, large = (
        observe(source, moving(COUNT), masks, size_px=size)[0][0] for size in (32, 64, 500)
    )
    assert small.alpha.shape == (32, 24)
    assert small.frame.rgb.shape == (32, 24, 3)
    assert small.camera.focal_px[0] == full.camera.focal_px[0] / 2
    np.testing.assert_allclose(small.alpha[8:24, 8:16], 200 / 255, atol=1e-6)
    assert large.alpha.shape == (64, 48)


@pytest.mark.parametrize("rows", [COUNT, 3])
def test_with_a_selection_rows_may_count_all_frames_or_the_chosen_ones(images, masks, rows):
    source = open_source(images / "images", frames=slice(1, None, 3))
    seen, _ = observe(source, moving(rows), masks)
    assert rows_of(seen) == ({1: 1, 4: 4, 7: 7} if rows == COUNT else {1: 0, 4: 1, 7: 2})
    assert [round(float(o.alpha.max()) * 255) - 200 for o in seen.values()] == [1, 4, 7]


def test_rows_belong_to_the_frames_that_they_name(source, masks):
    seen, dropped = observe(source, moving(5, frames=np.array([7, 5, 3, 1, 100])), masks)
    assert rows_of(seen) == {1: 3, 3: 2, 5: 1, 7: 0}
    assert dropped == dict.fromkeys((0, 2, 4, 6), "no pose")


def test_rows_belong_to_the_frames_of_their_time(source, masks):
    times = np.array([5, 3, 4, 1, np.nan]) / 30 + 0.004
    seen, _ = observe(source, moving(5, times_s=times, valid=np.isfinite(times)), masks)
    assert rows_of(seen) == {1: 3, 3: 1, 4: 2, 5: 0}


@pytest.mark.parametrize("rows", [1, COUNT - 1, COUNT + 1])
def test_more_or_fewer_rows_than_frames_are_refused_with_both_counts(source, masks, rows):
    with pytest.raises(InputError, match=rf"{rows} poses, but {COUNT} frames"):
        builder(source, moving(rows), masks)


def test_poses_for_other_frames_are_refused(images, masks):
    source = open_source(images / "images", frames=slice(4, None))
    with pytest.raises(InputError, match="0 to 3"):
        builder(source, moving(4, frames=np.arange(4)), masks)


def test_invalid_poses_are_dropped_unless_they_are_most(source, masks):
    _, dropped = observe(source, moving(COUNT, valid=np.arange(COUNT) % 2 == 0), masks)
    assert dropped == dict.fromkeys((1, 3, 5, 7), "pose invalid")
    with pytest.raises(InputError, match=f"3 of {COUNT}"):
        builder(source, moving(COUNT, valid=np.arange(COUNT) < 3), masks)


def test_tracked_frames_are_dropped_for_what_was_seen_in_them(source, masks):
    found = np.array([0, 1, 2, 3, 4, 6, 7])
    problems = np.where(found == 1, PROBLEM_BITS[TrackingProblem.CROWDED], 0)
    track = make_track(found, SIZE, problems=problems)
    valid = ~np.isin(np.arange(COUNT), [1, 3, 5])
    motion = moving(COUNT, valid=valid, frames=np.arange(COUNT), keypoints=track)
    assert observe(source, motion, masks)[1] == {1: ANOTHER_NEAR, 3: DISAGREEING, 5: NOT_FOUND}


def test_empty_and_unreadable_masks_are_dropped_and_listed(source, images):
    (images / "masks" / "3.png").write_bytes(b"damaged")
    cv2.imwrite(str(images / "masks" / "5.png"), np.zeros((64, 48), np.uint8))
    cv2.imwrite(str(images / "masks" / "6.png"), np.full((48, 64), 255, np.uint8))
    _, reasons = observe(source, moving(COUNT), open_masks(images / "masks", invert=False))
    assert set(reasons) == {3, 5, 6}
    assert "mask unusable" in reasons[3]
    assert reasons[5] == "mask empty"
    assert "64x48 px, its image 48x64" in reasons[6]


def test_the_alpha_channel_of_the_pictures_serves_as_mask(tmp_path):
    rgba = np.zeros((64, 48, 4), np.uint8)
    rgba[16:48, 16:32, 3] = 128
    for index in range(2):
        cv2.imwrite(str(tmp_path / f"{index}.png"), rgba)
    first = observe(open_source(tmp_path), moving(2), None, size_px=32)[0][0]
    np.testing.assert_allclose(first.alpha[8:24, 8:16], 128 / 255, atol=0.5 / 255)
    assert first.frame.alpha.shape == first.alpha.shape


def test_masks_must_be_one_per_frame_and_of_the_frames_shape(source, masks, images):
    np.savez(images / "short.npz", np.stack([masks.alpha(row, SIZE) for row in range(7)]))
    with pytest.raises(InputError, match=rf"7 masks in .* {COUNT} frames"):
        builder(source, moving(COUNT), open_masks(images / "short.npz"))
    np.savez(images / "turned.npz", np.rot90(cv2.imread(str(images / "masks/0.png"))[..., 0])[None])
    with pytest.raises(InputError, match="64x48 px, the frames 48x64"):
        builder(source, moving(COUNT), open_masks(images / "turned.npz"))


def test_frames_whose_mask_is_missing_are_left_out_where_names_tell(source, images):
    for number in (2, 7):
        (images / "masks" / f"{number}.png").unlink()
    seen, reasons = observe(source, moving(COUNT), open_masks(images / "masks"))
    assert set(reasons) == {2, 7}
    assert "holds none for frame 2" in reasons[2]
    shown = {number: o.alpha.max() for number, o in seen.items()}
    assert shown == {n: pytest.approx((200 + n) / 255) for n in (0, 1, 3, 4, 5, 6)}


def test_tracked_masks_of_few_frames_belong_to_these_while_they_are_being_written(source, images):
    """Most pictures may be of another size, or damaged."""
    (unfinished := images / ".instant-avatar-masks.part").mkdir()
    for number in (2, 5):
        shutil.copyfile(images / "masks" / f"{number}.png", unfinished / f"{number:06d}.png")
    assert set(observe(source, moving(COUNT), open_masks(unfinished))[0]) == {2, 5}


def test_masks_that_are_turned_among_others_are_left_out_and_obeyed_where_told(source, images):
    path = images / "masks" / "4.png"
    cv2.imwrite(str(path), 255 - cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    assert set(observe(source, moving(COUNT), open_masks(images / "masks"))[1]) == {4}
    assert not observe(source, moving(COUNT), open_masks(images / "masks", invert=False))[1]


@pytest.mark.parametrize(("scale", "shift"), [(1000.0, 0.0), (1.0, 1.7e9), (1e-3, 0.0)])
def test_times_by_another_clock_are_refused_and_never_taken_for_the_nearest(
    images, masks, scale, shift
):
    source = open_source(images / "images", frames=slice(0, None))
    motion = moving(20, times_s=np.arange(20) / 30 * scale + shift)
    with pytest.raises(InputError, match=r"frames of .* those of 0 to 0.267 s; .*milliseconds"):
        builder(source, motion, masks)


def test_moving_cameras_follow_their_frames(images, masks):
    source = open_source(images / "images", frames=slice(2, None, 2))
    still = assume_static_camera(moving(1), SIZE)[0]
    track = tuple(replace(still, focal_px=(100.0 + index, 100.0)) for index in range(COUNT))
    cameras = CameraTrack(cameras=track, source="cameras.npz")
    seen, _ = observe(source, moving(COUNT), masks, cameras)
    assert [o.camera.focal_px[0] for o in seen.values()] == [102.0, 104.0, 106.0]
    with pytest.raises(InputError, match=r"5 cameras in cameras\.npz"):
        builder(source, moving(COUNT), masks, replace(cameras, cameras=track[:5]))


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
    shown = np.zeros((30, SIZE[1], SIZE[0]), np.uint8)
    shown[:, 16:48, 16:32] = 255
    np.savez(tmp_path / "masks.npz", shown)
    masks = open_masks(tmp_path / "masks.npz")
    for rows in (30, there):
        seen, _ = observe(source, moving(rows), masks)
        assert rows_of(seen) == {number: number for number in range(there)}
    assert f"only {there} of 30 frames" in source.warnings[0]
    with pytest.raises(InputError, match=f"{there - 1} poses, but {there} frames"):
        associate_poses(moving(there - 1), source)


@pytest.fixture(scope="module")
def film(tmp_path_factory) -> Path:
    """Five frames."""
    path = tmp_path_factory.mktemp("film") / "film.mp4"
    write_video(path, [np.zeros((24, 32, 3), np.uint8)] * 5, 30.0, FFV1)
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
