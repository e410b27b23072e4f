"""Tests of `preprocess/tracking/blazepose.py`: the real networks on the studio's actors."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.input_error import InputError
from capture.source import Frame
from instant_avatar.studio import painted_surfaces, staging
from instant_avatar.studio.actor import Actor
from preprocess.body.body_pose import BodyPose
from preprocess.body.body_surface import soft_iou
from preprocess.tracking.blazepose import (
    MAX_CLOTHING_M,
    TRUNK,
    BlazePoseSegmenter,
    BlazePoseTracker,
    LastPlace,
    _limit_to_body,
    separate_mask,
)
from preprocess.tracking.blazepose_networks import BlazePoseDetector, PersonDetection, PersonSquare
from preprocess.tracking.first_look import PersonFinder
from preprocess.tracking.keypoints import CroppedMask, PersonKeypoints
from preprocess.tracking.video_tracking import ProblemFinder, TrackingProblem

SIZE = (270, 480)
KEYPOINTS = [11, 12, 13, 14, 15, 16, 23, 24, 25, 26, 27, 28]
JOINTS = [16, 17, 18, 19, 20, 21, 1, 2, 4, 5, 7, 8]
"""The same joints among BlazePose's key points and among the body's joints."""


@dataclass(frozen=True, eq=False)
class Shot:
    """An actor, cut out: colors times alpha, 0 to 255, and alpha; the actor's pose, the camera."""

    actor: Actor
    rgb: np.ndarray
    alpha: np.ndarray
    pose: BodyPose
    camera: Camera

    def paste(self, picture: np.ndarray, left: int) -> None:
        """Put the actor into a picture whose height is the same, before what is there."""
        width = self.alpha.shape[1]
        here = slice(max(0, left), min(left + width, picture.shape[1]))
        there = slice(here.start - left, here.stop - left)
        if here.start < here.stop:
            alpha = self.alpha[:, there, None]
            picture[:, here] = picture[:, here] * (1 - alpha) + self.rgb[:, there] * alpha

    def joints_px(self) -> np.ndarray:
        return self.camera.project(self.actor.shaped.with_pose(self.pose).joints())


@pytest.fixture(scope="module")
def shots() -> list[Shot]:
    """One in stripes and one in a plain shirt, of 270x480 px."""
    found = []
    for subject in (1, 2):
        actor = Actor.of(subject, 0)
        pose = staging.turning_motion(actor, frames=8, fps=30.0, turns=1.0, seed=0)[0]
        camera = staging.portrait_camera(actor, 270)
        rgb, alpha = actor.render_rgb_alpha(pose, camera, supersampling=2)
        rgb = (255 * np.clip(rgb, 0, 1)).astype(np.float32)
        found.append(Shot(actor=actor, rgb=rgb, alpha=alpha, pose=pose, camera=camera))
    return found


@pytest.fixture
def striped(shots):
    return shots[0]


@pytest.fixture
def plain(shots):
    return shots[1]


def scene(*placed, width=SIZE[0]):
    """Actors before a wall that is darker on the right, each at its left."""
    wall = np.linspace(170, 110, width)[None, :, None]
    picture = np.broadcast_to(wall, (480, width, 3)).astype(np.uint8).copy()
    for person, left in placed:
        person.paste(picture, left)
    return picture


def hips(found):
    return float(found.image_px[23:25, 0].mean())


def middle(left):
    """Where the hips of a person are whose picture begins at `left`."""
    return left + SIZE[0] / 2


def iou(alpha: np.ndarray, true: np.ndarray) -> float:
    return soft_iou(true > 0.5, alpha)


# --- one person -------------------------------------------------------------------------------


def test_key_points_and_mask_of_an_actor_are_where_the_actor_is(plain):
    found = BlazePoseTracker()(scene((plain, 0)))
    assert found is not None
    assert found.presence > 0.9
    assert not found.crowded
    height = np.ptp(plain.joints_px()[:, 1])
    apart = np.linalg.norm(found.image_px[KEYPOINTS] - plain.joints_px()[JOINTS], axis=1)
    assert apart.max() < 0.07 * height  # the two sets mean slightly different places
    assert np.median(apart) < 0.04 * height
    assert iou(found.mask.resample(SIZE, SIZE), plain.alpha) > 0.93
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
    assert tracker(scene()) is None
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
    picture = np.full((480, 600, 3), 140, np.uint8)
    picture[:, 330:] = scene((plain, 0))
    picture[160:400, 60:195] = cv2.resize(scene((striped, 0)), (135, 240))
    found = BlazePoseTracker()(picture)
    assert found is not None
    assert abs(hips(found) - middle(330)) < 15


@pytest.mark.parametrize("is_in_front", [False, pytest.param(True, marks=pytest.mark.slow)])
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
    x, y = plain.joints_px()[18]
    square = PersonSquare(x=x, y=y, side=60.0, angle=0.0)
    sleeve = PersonDetection(square=square, box=np.array([x, y, x, y]), score=0.9)
    monkeypatch.setattr(tracker, "_detect_some", lambda rgb: [sleeve])
    found = [tracker(picture) for _ in range(6)]
    assert not any(each is None or each.crowded for each in found)


@pytest.mark.parametrize("person", [pytest.param(1, marks=pytest.mark.slow), 2])
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


def test_after_a_cut_to_other_light_and_another_distance_the_person_is_found_again(plain):
    """For a while it is taken for another one, who stands in front."""
    near = scene((plain, 0))
    shrink = np.array([[0.6, 0.0, 0.2 * SIZE[0]], [0.0, 0.6, 0.2 * SIZE[1]]])
    far = cv2.warpAffine(near, shrink, SIZE, borderMode=cv2.BORDER_REPLICATE)
    tracker = BlazePoseTracker()
    assert all(tracker(near) is not None for _ in range(6))
    dark = (0.35 * far).astype(np.uint8)
    assert any(tracker(dark) is not None for _ in range(24))


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


# --- the posed person alone -----------------------------------------------------------------------


def segmented(shot, picture, pose=None, camera=None):
    frame = Frame(index=0, time_s=0.0, rgb=picture)
    return BlazePoseSegmenter(shot.actor.shaped)(frame, pose or shot.pose, camera or shot.camera)


def test_an_actor_is_cut_out(plain):
    segment, frame = BlazePoseSegmenter(plain.actor.shaped), scene((plain, 0))
    alpha = segment(Frame(index=0, time_s=0.0, rgb=frame), plain.pose, plain.camera)
    assert iou(alpha, plain.alpha) > 0.95
    assert segment.mask_count == 1
    assert 0.7 < segment.agreement < 0.95  # clothes and hair are wider than the body
    off_by_a_hand = plain.pose.root_translation + np.array([0.08, 0.0, 0.0])
    moved = replace(plain.pose, root_translation=off_by_a_hand)
    assert iou(segmented(plain, frame, moved), plain.alpha) > 0.95


@pytest.mark.parametrize("wanted", [0, 1])
def test_of_two_persons_it_is_the_posed_one(shots, wanted):
    shot, shift = shots[wanted], 170
    picture = scene((shots[0], 0), (shots[1], shift), width=440)
    x, y = shot.camera.center_px
    camera = replace(shot.camera, center_px=(x + wanted * shift, y), size_px=(440, SIZE[1]))
    alpha = segmented(shot, picture, camera=camera)
    assert iou(alpha[:, wanted * shift :][:, : SIZE[0]], shot.alpha) > 0.85


def test_the_person_is_found_in_a_twentieth_of_the_light(plain, rng):
    picture = scene((plain, 0))
    dark = np.clip(picture / 20.0 + rng.normal(0.0, 1.0, picture.shape), 0, 255)
    assert iou(segmented(plain, dark.astype(np.uint8)), plain.alpha) > 0.9


@pytest.mark.parametrize(
    ("shift_m", "words"), [([9.0, 0, 0], "not in the image"), ([0.9, 0, 0], "agrees by")]
)
def test_where_the_pose_shows_no_person_there_is_no_mask(plain, shift_m, words):
    aside = replace(plain.pose, root_translation=plain.pose.root_translation + shift_m)
    with pytest.raises(InputError, match=words):
        segmented(plain, scene((plain, 0)), aside)


def test_what_is_far_from_the_posed_body_is_cleared():
    everything = CroppedMask(
        values=np.full((64, 64), 255, np.uint8),
        image_from_crop=np.array([[2.0, 0, 10], [0, 2, 20]]),
    )
    body = np.stack(np.meshgrid(np.arange(60.0, 80.0), np.arange(70.0, 90.0)), axis=-1)
    px_per_m = 100.0
    mask, agreed = _limit_to_body(everything, body.reshape(-1, 2), px_per_m)
    rows, columns = np.nonzero(mask.values)
    reach = MAX_CLOTHING_M * px_per_m / 2.0
    assert columns.min() == pytest.approx(25 - reach, abs=1.5)
    assert columns.max() == pytest.approx(34 + reach, abs=1.5)
    assert rows.min() == pytest.approx(25 - reach, abs=1.5)
    assert 0.0 < agreed < 0.3


# --- two persons' pixels --------------------------------------------------------------------------

CROP_PX = 64


def person(at, *, visible=True):
    """A person whose trunk is a square of 8 px around a point, with the left arm to its right."""
    points = np.tile(np.array(at, float), (33, 1))
    points[list(TRUNK)] += [(4, -4), (-4, -4), (-4, 4), (4, 4)]
    points[[13, 15, 19]] = points[11] + [(6, 0), (12, 0), (16, 0)]
    points[[14, 16, 20]] = points[12]
    points[[25, 27, 29, 31]], points[[26, 28, 30, 32]] = points[23], points[24]
    return PersonKeypoints(
        image_px=points, world_m=np.zeros((33, 3)), visibility=np.full(33, float(visible)),
        presence=1.0, mask=CroppedMask(
            values=np.full((CROP_PX, CROP_PX), 255, np.uint8), image_from_crop=np.eye(2, 3)
        ),
    )  # fmt: skip


def test_pixels_belong_to_the_nearer_limbs():
    mask, removed = separate_mask(person((16, 32)), person((48, 32)))
    assert removed == pytest.approx(0.41, abs=0.02)  # half of the square less the arm's part
    assert (mask.values[32, :30] == 255).all()
    assert (mask.values[:, 46:] == 0).all()
    assert mask.values[28, 36] == 255  # the hand that reaches over


def test_limbs_of_the_other_that_are_not_seen_take_nothing():
    mask, removed = separate_mask(person((16, 32)), person((48, 32), visible=False))
    assert removed == 0.0
    assert (mask.values == 255).all()


def test_the_mask_may_be_of_other_pixels_than_the_frame():
    """A crop twice as fine, that begins elsewhere."""
    one, other = person((16, 32)), person((48, 32))
    coarse, removed = separate_mask(one, other)
    fine = CroppedMask(
        values=np.full((2 * CROP_PX, 2 * CROP_PX), 255, np.uint8),
        image_from_crop=np.array([[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]]),
    )
    of_fine, removed_of_fine = separate_mask(PersonKeypoints(**(vars(one) | {"mask": fine})), other)
    assert removed_of_fine == pytest.approx(removed, abs=0.02)
    assert (of_fine.values[1::2, 1::2] == coarse.values).mean() > 0.97


def test_a_hand_before_the_others_chest_stays():
    one, other = person((16, 32)), person((36, 28))
    mask, _ = separate_mask(one, other)
    assert (mask.values[28, 20:36] == 255).all()  # the arm, which ends in the other's trunk
    assert mask.values[24, 36] == 0
