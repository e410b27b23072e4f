"""Tracking of a recording: masks and problems of every frame; missing frames are reported."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.tracking import video_tracking
from preprocess.tracking.keypoints import CroppedMask, PersonKeypoints
from preprocess.tracking.video_tracking import (
    ProblemFinder,
    TrackingProblem,
    VideoTracking,
    touched_borders,
)
from tests.motions import make_track

COUNT = 12


@pytest.fixture
def pictures(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for number in range(COUNT):
        cv2.imwrite(str(folder / f"{number:04d}.png"), np.full((48, 32, 3), 10 * number, np.uint8))
    return open_source(folder)


class FakeTracker:
    """Finds a person wherever the picture is bright enough."""

    def __init__(self, darkest: int = 0) -> None:
        self.darkest = darkest

    def __call__(self, rgb):
        if rgb.mean() < self.darkest:
            return None
        place = np.array([[2.0, 0.0, 8.0], [0.0, 2.0, 16.0]])
        return PersonKeypoints(
            image_px=np.full((33, 2), float(rgb.mean())), world_m=np.zeros((33, 3)),
            visibility=np.ones(33), presence=1.0,
            mask=CroppedMask(values=np.full((8, 8), 255, np.uint8), image_from_crop=place),
        )  # fmt: skip


def plain(rgb, mask, size_px):
    return mask.resample((rgb.shape[1], rgb.shape[0]), size_px)


def track(pictures, tracker, refine=plain, masks=None):
    tracking = VideoTracking(pictures, tracker, refine, masks)
    assert list(tracking.run()) == list(range(1, COUNT + 1))
    return tracking.result()


def test_each_frame_has_a_mask_and_found_ones_have_key_points(pictures, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    found = track(pictures, FakeTracker(darkest=25), masks=masks)
    assert found.keypoints.frames.tolist() == list(range(3, COUNT))
    assert list(found.frame_times_s) == list(range(COUNT))
    assert found.keypoints.image_px[0, 0, 0] == 30.0
    files = sorted(masks.iterdir())
    assert [file.stem for file in files] == [f"{number:06d}" for number in range(COUNT)]
    assert cv2.imread(str(files[0]), 0).max() == 0
    drawn = cv2.imread(str(files[5]), 0)
    assert drawn[17:31, 9:23].min() == 255
    assert drawn[:14].max() == drawn[:, 26:].max() == 0


def test_a_video_without_persons_is_bad_input(pictures):
    with pytest.raises(InputError, match="none of 12 frames"):
        track(pictures, FakeTracker(darkest=200))


def test_a_file_that_breaks_off_is_named_with_its_frames(pictures):
    source = open_source(pictures.path, frames=slice(0, 2))
    source.frame_count = 300  # as its header claims
    tracking = VideoTracking(source, FakeTracker(), plain, None)
    assert list(tracking.run()) == [1, 2]
    with pytest.raises(InputError, match="breaks off after 2 of 300 frames"):
        tracking.result()


def test_a_stop_keeps_what_was_found(pictures):
    tracking = VideoTracking(pictures, FakeTracker(), plain, None)
    for done in tracking.run():
        if done == 5:
            break
    found = tracking.result()
    assert found.interrupted
    assert len(found.keypoints) == 5


def test_a_failing_mask_writer_is_not_swallowed(pictures, tmp_path):
    with pytest.raises(OSError, match="gone"):
        track(pictures, FakeTracker(), masks=tmp_path / "gone")


def test_first_masks_are_made_again_once_the_background_is_known(pictures, tmp_path, monkeypatch):
    monkeypatch.setattr(video_tracking, "FRAMES_REFINED_AGAIN", 2)
    refined: list[int] = []

    def refine(rgb, mask, size_px):
        refined.append(round(float(rgb.mean())) // 10)
        share = 1.0 if len(refined) > COUNT else 0.5
        return np.full(size_px[::-1], share, dtype=np.float32)

    track(pictures, FakeTracker(), refine, tmp_path)
    assert refined == [*range(COUNT), 0, 1]
    masks = [cv2.imread(str(file), 0).max() for file in sorted(tmp_path.glob("*.png"))]
    assert masks == [255, 255] + [128] * (COUNT - 2)


SIZE = (200, 100)


def person(x=100.0, *, radius=10.0, crowded=False):
    """A person who is a disc in a square of 64 pixels around it, at half the frame's resolution."""
    rows, columns = np.mgrid[:64, :64] + 0.5
    disc = np.hypot(rows - 32, columns - 32) < radius / 2
    around = np.resize([[-1, 0], [1, 0], [0, -1], [0, 1]], (33, 2))
    values, place = np.where(disc, 255, 0), np.array([[2.0, 0, x - 64], [0, 2.0, 50 - 64]])
    return PersonKeypoints(
        image_px=np.array([x, 50.0]) + radius * around, world_m=np.zeros((33, 3)),
        visibility=np.ones(33), presence=1.0, crowded=crowded,
        mask=CroppedMask(values=values.astype(np.uint8), image_from_crop=place),
    )  # fmt: skip


def problems_of(*found):
    finder = ProblemFinder()
    return [set(finder.problems(each, SIZE)) for each in found]


def test_a_person_well_inside_the_frame_is_no_problem_and_another_one_nearby_is():
    assert problems_of(*[person()] * 3) == [set()] * 3
    assert problems_of(person(crowded=True)) == [{TrackingProblem.CROWDED}]


@pytest.mark.parametrize(
    ("x", "problem"), [(6.0, TrackingProblem.LEFT), (194.0, TrackingProblem.RIGHT)]
)
def test_a_mask_that_reaches_a_border_touches_it(x, problem):
    assert touched_borders(person(x), SIZE) == {problem}
    inside = 100 + 0.85 * (x - 100)
    assert touched_borders(person(inside), SIZE) == set()
    both = {TrackingProblem.TOP, TrackingProblem.BOTTOM}
    assert touched_borders(person(radius=51.0), SIZE) == both


def test_shoes_that_touch_the_border_cut_nothing_off():
    standing = person(radius=51.0)
    ankles = np.clip(standing.image_px, None, [np.inf, 85.0])  # 15 px above the lower border
    touched = touched_borders(replace(standing, image_px=ankles), SIZE)
    assert touched == {TrackingProblem.TOP}


def test_a_person_found_far_from_the_last_place_may_be_another():
    far = problems_of(person(40.0), None, person(150.0), person(150.0))
    assert far == [set(), set(), {TrackingProblem.ELSEWHERE}, set()]
    assert problems_of(person(40.0), None, person(80.0)) == [set()] * 3
    assert problems_of(None, person(150.0)) == [set()] * 2


def walking_track(hips_x, crowded):
    """A person 200 px tall whose hips are at some places, and frames with another one near."""
    image = np.zeros((len(hips_x), 33, 2))
    image[:, 0, 1], image[:, 31:, 1] = 100.0, 300.0
    image[..., 0] = np.asarray(hips_x)[:, None]
    image += np.random.default_rng(0).normal(0.0, 1.0, image.shape)
    problems = np.zeros(len(hips_x), np.int64)
    problems[crowded] = video_tracking.PROBLEM_BITS[TrackingProblem.CROWDED]
    rows = np.arange(len(hips_x))
    parts = {"image_px": image, "times_s": rows / 30.0, "problems": problems}
    return make_track(rows, (640, 400), **parts)


def frames_with_another(track):
    bit = video_tracking.PROBLEM_BITS[TrackingProblem.CROWDED]
    return np.flatnonzero(video_tracking.mark_passers_by(track).problems & bit).tolist()


def test_a_passer_by_who_is_taken_over_is_left_out_until_the_hips_jump_back():
    """The other runs 16 px a frame; that a person is near is seen in two frames alone."""
    hips = np.full(90, 300.0)
    hips[40:52] -= 16.0 * np.arange(1, 13)
    found = frames_with_another(walking_track(hips, slice(41, 43)))
    assert set(range(40, 52)) <= set(found)
    assert set(found) <= set(range(40, 54))


@pytest.mark.parametrize("speed_px", [0.0, 12.0])
def test_a_person_who_walks_past_another_one_is_no_other(speed_px):
    track = walking_track(speed_px * np.arange(90), slice(40, 50))
    assert frames_with_another(track) == list(range(40, 50))


def test_of_few_frames_a_second_a_person_moves_farther_from_one_to_the_next():
    hips = 300.0 + 60.0 * np.sin(0.4 * np.arange(90))  # 1 m to and fro in 3 s
    track = walking_track(hips, slice(40, 50))
    slow = replace(track, times_s=np.arange(90) / 5.0)
    assert frames_with_another(slow) == list(range(40, 50))
