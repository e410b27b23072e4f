"""The lift of key points, and stretches with left and right exchanged."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from preprocess.body.body_pose import Motion
from preprocess.tracking.keypoints import MIRRORED_POINTS, KeypointTrack
from preprocess.tracking.pose_lift import find_swaps, lift_keypoints, repair_swaps
from tests.motions import make_track, posed_joints

LEFT, RIGHT = [1, 2, 3, *range(7, 33, 2)], [4, 5, 6, *range(8, 33, 2)]


def turning_track(count: int, degrees_per_frame: float, frame_step: int = 1) -> KeypointTrack:
    """Points of a person who turns about the y axis."""
    generator = np.random.default_rng(0)
    rest = generator.normal(size=(33, 3))
    rest[LEFT, 0], rest[RIGHT, 0] = 0.2, -0.2
    rest[LEFT, 1:] = rest[RIGHT, 1:]
    angle = np.deg2rad(degrees_per_frame) * np.arange(count)
    turn = np.zeros((count, 3, 3))
    turn[:, 1, 1] = 1.0
    turn[:, 0, 0] = turn[:, 2, 2] = np.cos(angle)
    turn[:, 0, 2], turn[:, 2, 0] = np.sin(angle), -np.sin(angle)
    world = rest @ turn.swapaxes(1, 2)
    image_px = 200.0 + 100.0 * world[..., :2]
    return make_track(frame_step * np.arange(count), (400, 400), image_px=image_px, world_m=world)


def swap(track: KeypointTrack, rows: slice | list[int]) -> KeypointTrack:
    image, world = track.image_px.copy(), track.world_m.copy()
    for array in (image, world):
        array[rows] = array[rows][:, MIRRORED_POINTS]
    return replace(track, image_px=image, world_m=world)


@pytest.mark.parametrize(
    "rows",
    [[20], range(20, 55), range(52, 56), range(25), [10, 11, *range(40, 49)]],
    ids=["one", "long", "short", "from the start", "two stretches"],
)
def test_the_shorter_part_is_exchanged_back(rows):
    whole = turning_track(80, 4.0)
    swapped = swap(whole, list(rows))
    repaired = repair_swaps(swapped)
    assert np.flatnonzero(find_swaps(swapped)).tolist() == list(rows)
    np.testing.assert_allclose(repaired.image_px, whole.image_px)
    np.testing.assert_allclose(repaired.world_m, whole.world_m)


def test_the_last_frames_before_a_gap_are_exchanged_back():
    """A person who fades out is turned round."""
    whole = turning_track(80, 4.0)
    whole = replace(whole, frames=whole.frames + 16 * (whole.frames >= 50))
    repaired = repair_swaps(swap(whole, slice(48, 50)))
    np.testing.assert_allclose(repaired.world_m, whole.world_m)


def test_key_points_between_two_guesses_hide_no_exchange():
    """On the way from one guess to another, both sides lie in the middle."""
    whole = turning_track(80, 4.0)
    swapped = swap(whole, slice(30, 60))
    middle = 0.5 * (whole.world_m[60] + whole.world_m[60][MIRRORED_POINTS])
    swapped.world_m[60] = middle + 0.2 * (swapped.world_m[59] - middle)
    assert np.flatnonzero(find_swaps(swapped)).tolist() == list(range(30, 61))


def test_a_cut_to_the_other_side_is_no_exchange():
    front = turning_track(80, 1.0)
    back = swap(front, slice(0, 80))
    shift = np.where(np.arange(80) >= 60, 30.0, 0.0)[:, None, None]
    film = replace(
        front,
        image_px=np.concatenate([front.image_px[:60], back.image_px[60:]]) + shift,
        world_m=np.concatenate([front.world_m[:60], back.world_m[60:]]),
    )
    assert not find_swaps(film).any()
    assert find_swaps(replace(film, image_px=film.image_px - shift)).any()


@pytest.mark.parametrize(
    "track",
    [
        turning_track(30, 20.0),  # fast, but right
        turning_track(8, 45.0),  # photographs
        swap(turning_track(12, 10.0, 10), slice(5, 6)),  # too far apart in time to tell
        swap(turning_track(60, 4.0), slice(30, 60)),  # which half is wrong?
    ],
)
def test_nothing_else_is_touched(track):
    assert not find_swaps(track).any()
    np.testing.assert_array_equal(repair_swaps(track).world_m, track.world_m)


@pytest.fixture
def walker(turning_person) -> Motion:
    return turning_person(12)


def relative_joints(shaped, motion):
    joints = posed_joints(motion, shaped)
    return joints - joints[:, :1]


def test_bent_limbs_and_the_roots_turn_come_back(walker, shaped, keypoint_camera, track_motion):
    lifted = lift_keypoints(track_motion(walker), shaped, keypoint_camera)
    off = relative_joints(shaped, lifted) - relative_joints(shaped, walker)
    assert np.linalg.norm(off, axis=2).mean() < 0.03
    true, found = (Rotation.from_rotvec(each.root_rotations) for each in (walker, lifted))
    turned = found.inv() * true
    assert np.degrees(turned.magnitude()).max() < 6.0
    assert np.abs(lifted.root_translations - walker.root_translations).max() < 0.15
    assert lifted.intrinsic[0, 0] == keypoint_camera.focal_px[0]
    assert lifted.keypoints is not None


def test_a_bent_elbow_tells_the_twist_of_the_upper_arm(
    walker, shaped, keypoint_camera, track_motion
):
    """By hinges, not by the smallest swing: elbows and knees bend about their own axes alone."""
    lifted = lift_keypoints(track_motion(walker), shaped, keypoint_camera)
    bends = lifted.joint_rotations[:, [17, 18, 3, 4]]
    assert (bends[:, 0, 1] < -0.3).all()
    assert (bends[:, 1, 1] > 0.3).all()
    assert (bends[:, 2:, 0] > 0.1).all()
    assert np.abs(bends[:, :2, 2]).max() < 0.25


def test_short_gaps_are_bridged_and_long_ones_stay(
    turning_person, shaped, keypoint_camera, track_motion
):
    track = track_motion(turning_person(60))
    seen = ~np.isin(np.arange(60), [5, 6, 7, *range(20, 50)])
    rows = np.flatnonzero(seen)
    fields = ("frames", "image_px", "world_m", "visibility", "presence", "times_s")
    partial = replace(track, **{name: getattr(track, name)[rows] for name in fields})
    partial.presence[10] = 0.1
    lifted = lift_keypoints(partial, shaped, keypoint_camera)
    assert lifted.frames.tolist() == [*range(20), *range(50, 60)]
    assert lifted.valid.all()
