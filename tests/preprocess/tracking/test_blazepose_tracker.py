"""Tests of `preprocess/tracking/blazepose.py`: the real networks on the studio's actors."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from instant_avatar.studio import painted_surfaces
from preprocess.tracking.blazepose import BlazePoseTracker, LastPlace
from preprocess.tracking.blazepose_networks import (
    BlazePoseDetector,
    PersonDetection,
    PersonSquare,
    anchors,
    is_same_person,
    parts_of_frame,
    refine,
)
from preprocess.tracking.first_look import PersonFinder
from preprocess.tracking.video_tracking import ProblemFinder, TrackingProblem
from tests.preprocess.tracking.conftest import room

SIZE = (270, 480)
KEYPOINTS = [11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
JOINTS = [16, 17, 18, 19, 20, 21, 1, 2, 4, 5, 7, 8]
"""The same joints among BlazePose's key points and among the body's joints."""


@pytest.fixture
def striped(shots):
    return shots[0]


@pytest.fixture
def plain(shots):
    return shots[1]


def joints_of(shot):
    """The true joints, pixels."""
    return shot.camera.project(shot.actor.shaped.with_pose(shot.pose).joints())


def scene(*placed, width=SIZE[0]):
    picture = room(width)
    for person, left in placed:
        person.paste(picture, left)
    return picture


def hips(found):
    return float(found.image_px[23:25, 0].mean())


def middle(left):
    """Where the hips of a person are whose picture begins at `left`."""
    return left + SIZE[0] / 2


# --- one person -------------------------------------------------------------------------------


def test_key_points_and_mask_of_an_actor_are_where_the_actor_is(plain):
    found = BlazePoseTracker()(scene((plain, 0)))
    assert found is not None
    assert found.presence > 0.9
    assert not found.crowded
    height = np.ptp(joints_of(plain)[:, 1])
    apart = np.linalg.norm(found.image_px[KEYPOINTS] - joints_of(plain)[JOINTS], axis=1)
    assert apart.max() < 0.07 * height  # the two sets mean slightly different places
    assert np.median(apart) < 0.04 * height
    mask = found.mask.resample(SIZE, SIZE) > 0.5
    truth = plain.alpha > 0.5
    assert (mask & truth).sum() / (mask | truth).sum() > 0.93
    # In space the left is on the picture's right, and the head is above the feet: y is down.
    assert found.world_m[11, 0] - found.world_m[12, 0] > 0.2
    assert found.world_m[27, 1] - found.world_m[0, 1] > 1.0
    assert np.abs(found.world_m[23] + found.world_m[24]).max() < 0.1


def test_a_turned_picture_turns_the_key_points(plain):
    upright = scene((plain, 0))
    angle = np.pi / 2
    found = BlazePoseTracker()(upright)
    turned = BlazePoseTracker()(np.ascontiguousarray(np.rot90(upright, -1)))
    assert found is not None
    assert turned is not None
    back = np.column_stack([turned.image_px[:, 1], SIZE[1] - turned.image_px[:, 0]])
    assert np.median(np.linalg.norm(back - found.image_px, axis=1)) < 4.0
    clockwise = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    expected = found.world_m[:, :2] @ clockwise.T
    assert np.median(np.linalg.norm(turned.world_m[:, :2] - expected, axis=1)) < 0.04


def test_without_a_person_there_is_none():
    tracker = BlazePoseTracker()
    noise = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    assert tracker(room()) is None
    assert tracker(noise) is None


def test_a_small_person_in_a_wide_frame_is_found(plain):
    picture = scene((plain, 300), width=854)
    small = cv2.resize(picture, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA)
    wide = np.full((480, 854, 3), 140, np.uint8)
    wide[192:336, 500:756] = small
    found = BlazePoseTracker()(wide)
    assert found is not None
    assert abs(hips(found) - (500 + 0.3 * middle(300))) < 5


# --- several persons --------------------------------------------------------------------------


def test_a_person_who_is_not_there_yet_is_awaited(striped, plain):
    tracker = BlazePoseTracker(person=2)
    assert tracker(scene((plain, 300), width=600)) is None
    found = tracker(scene((striped, 0), (plain, 300), width=600))
    assert found is not None
    assert abs(hips(found) - middle(300)) < 15


def test_the_person_in_front_is_followed(striped, plain):
    picture = scene((striped, 0), width=600)
    nearer = scene((plain, 0))
    picture[:, 330:600] = nearer
    picture[:, :330] = 140
    picture[160:400, 60:195] = cv2.resize(scene((striped, 0)), (135, 240))
    found = BlazePoseTracker()(picture)
    assert found is not None
    assert abs(hips(found) - middle(330)) < 15


@pytest.mark.parametrize("is_in_front", [False, True])
def test_a_person_who_walks_past_is_not_followed(striped, plain, is_in_front):
    tracker = BlazePoseTracker(person=1)
    found_frames, crowded = [], []
    for frame in range(9):
        placed = [(striped, 100), (plain, 330 - 55 * frame)]
        found = tracker(scene(*(placed if is_in_front else placed[::-1]), width=600))
        if found is not None:
            assert abs(hips(found) - middle(100)) < 30
            found_frames.append(frame)
            crowded.append(found.crowded)
    assert any(crowded)
    assert found_frames[-1] == 8
    assert len(found_frames) == 9 if not is_in_front else len(found_frames) > 4


def test_persons_side_by_side_are_separated(striped, plain):
    """Their arms reach into each other's square, but hide little of each other."""
    left, beside, width = 40, 190, 480
    tracker = BlazePoseTracker(person=1)
    found = [tracker(scene((striped, left), (plain, beside), width=width)) for _ in range(3)][-1]
    assert found is not None
    assert not found.crowded
    size_px = (width, SIZE[1])
    mask = found.mask.resample(size_px, size_px) > 0.5
    other = np.zeros(mask.shape, dtype=bool)
    other[:, beside : beside + SIZE[0]] = plain.alpha > 0.5
    own = np.zeros(mask.shape, dtype=bool)
    own[:, left : left + SIZE[0]] = striped.alpha > 0.5
    assert (mask & own & ~other).sum() > 0.95 * (own & ~other).sum()
    assert (mask & other).sum() < 0.04 * other.sum()  # 0.053 before they were separated


def test_a_small_person_is_not_another_one(striped):
    """The detector's square lies beside so small a person."""
    tracker, size = BlazePoseTracker(), (67, 120)
    picture = np.full((480, 480, 3), 130, np.uint8)
    picture[200:320, 200:267] = cv2.resize(scene((striped, 0)), size, interpolation=cv2.INTER_AREA)
    found = [tracker(picture) for _ in range(12)]
    assert not any(each is None or each.crowded for each in found)


def test_a_sleeve_that_the_detector_takes_for_a_person_is_not_another_one(plain, monkeypatch):
    tracker, picture = BlazePoseTracker(), scene((plain, 0))
    x, y = joints_of(plain)[18]
    square = PersonSquare(x=x, y=y, side=60.0, angle=0.0)
    sleeve = PersonDetection(square=square, box=np.array([x, y, x, y]), score=0.9)
    monkeypatch.setattr(tracker, "_detect_some", lambda rgb: [sleeve])
    found = [tracker(picture) for _ in range(6)]
    assert not any(each is None or each.crowded for each in found)


@pytest.mark.parametrize("person", [1, 2])
def test_each_of_two_persons_in_a_wide_picture_can_be_followed(striped, plain, person):
    """In this room the detector sees only the one on the right, of the whole picture."""
    center_px = 350.0, striped.camera.center_px[1]
    camera = replace(striped.camera, size_px=(700, 480), center_px=center_px)
    picture = painted_surfaces.paint_backdrop("clutter", camera, np.random.default_rng([0, 4]))
    striped.paste(picture, 0)
    plain.paste(picture, 430)
    found = BlazePoseTracker(person=person)(picture)
    assert found is not None
    assert abs(hips(found) - middle(430 * (person - 1))) < 30
    assert len(PersonFinder().persons(picture)) == 2


def test_a_person_who_leaves_and_returns_is_found_again(plain):
    tracker, finder, size_px = BlazePoseTracker(), ProblemFinder(), (400, 480)
    lefts = [65, 120, 180, 230, 270, 320, 400, 400, 320, 270, 230, 180]
    found = [tracker(scene((plain, left), width=400)) for left in lefts]
    absent = [row for row, each in enumerate(found) if each is None]
    assert 4 <= absent[0] <= 6
    assert 7 <= absent[-1] <= 9
    problems = set().union(*(finder.problems(each, size_px) for each in found))
    assert TrackingProblem.RIGHT in problems
    assert TrackingProblem.LEFT not in problems
    assert TrackingProblem.ELSEWHERE not in problems


# --- parts ------------------------------------------------------------------------------------


def test_after_a_cut_to_other_light_and_another_distance_the_person_is_found_again(plain):
    """For a while it is taken for another one, who stands in front."""
    near = scene((plain, 0))
    shrink = np.array([[0.6, 0.0, 0.2 * SIZE[0]], [0.0, 0.6, 0.2 * SIZE[1]]])
    far = cv2.warpAffine(near, shrink, SIZE, borderMode=cv2.BORDER_REPLICATE)
    tracker = BlazePoseTracker()
    assert all(tracker(near) is not None for _ in range(6))
    dark = (0.35 * far).astype(np.uint8)
    assert any(tracker(dark) is not None for _ in range(24))


def test_anchors_are_the_middles_of_their_cells():
    places = anchors(224)
    assert places.shape == (2254, 2)
    np.testing.assert_allclose(places[:3] * 224, [[4, 4], [4, 4], [12, 4]])
    np.testing.assert_allclose(places[1568] * 224, [8, 8])
    np.testing.assert_allclose(places[-1] * 224, [208, 208])


def test_a_flat_heat_map_leaves_a_point_where_it_is_and_a_peak_draws_it():
    heatmaps = np.full((2, 64, 64), -9.0, np.float32)
    heatmaps[1, 30:33, 20:23] = 9.0
    points = np.array([[81.0, 122.0], [81.0, 122.0]])
    refined = refine(points, heatmaps, 256)
    np.testing.assert_array_equal(refined[0], points[0])
    np.testing.assert_allclose(refined[1], [84, 124], atol=0.1)
    np.testing.assert_array_equal(refine(points - 300, heatmaps, 256), points - 300)


def test_the_parts_of_a_wide_frame_cover_it():
    wide = parts_of_frame(np.zeros((100, 260, 3), np.uint8))
    assert [part.x for part in wide] == [50.0, 130.0, 210.0]
    assert {(part.y, part.side) for part in wide} == {(50.0, 100.0)}
    tall = parts_of_frame(np.zeros((260, 100, 3), np.uint8))
    assert [part.y for part in tall] == [50.0, 130.0, 210.0]


def test_detections_of_one_head_are_one_person():
    def detection(x, head_x):
        box = np.array([head_x - 20.0, 0, head_x + 20, 40])
        return PersonDetection(square=PersonSquare(x=x, y=100.0, side=200.0), box=box, score=1.0)

    assert is_same_person(detection(100.0, 100.0), detection(110.0, 160.0))
    assert is_same_person(detection(100.0, 100.0), detection(160.0, 105.0))
    assert not is_same_person(detection(100.0, 100.0), detection(160.0, 160.0))


def test_the_longer_a_person_is_lost_the_farther_it_may_be():
    here, there = PersonSquare(x=0.0, y=0.0, side=100.0), PersonSquare(x=50.0, y=0.0, side=100.0)
    assert LastPlace(square=here).strangeness(there) > 1
    assert LastPlace(square=here, frames_ago=5).strangeness(there) < 1
    larger = PersonSquare(x=0.0, y=0.0, side=170.0)
    assert LastPlace(square=here).strangeness(larger) > 1
    assert LastPlace(square=larger).strangeness(here) > 1


def test_a_detector_that_is_given_an_area_looks_only_there(plain):
    picture = scene((plain, 300), width=600)
    detect = BlazePoseDetector()
    assert len(detect(picture)) == 1
    assert detect(picture, PersonSquare(x=100.0, y=240.0, side=200.0)) == []
