"""Grades of tracked poses: doubtful stretches are reported with their times."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from preprocess.body.body_pose import Motion
from preprocess.tracking.keypoints import KeypointTrack
from preprocess.tracking.tracking_grade import DISAGREE, TrackingGrade, grade_tracking
from preprocess.tracking.video_tracking import PROBLEM_BITS, TrackingProblem
from tests.motions import make_motion, make_track

FRAMES = 60
FPS = 30.0
TIMES = {number: number / FPS for number in range(FRAMES)}


def a_motion(turns: float = 1.0, noise_rad: float = 0.0) -> Motion:
    rng = np.random.default_rng(0)
    angles = np.linspace(0.0, 2.0 * np.pi * turns, FRAMES)
    upright = np.array([np.pi, 0.0, 0.0])  # OpenCV's y points down
    roots = Rotation.from_rotvec(upright) * Rotation.from_rotvec(
        np.column_stack([np.zeros(FRAMES), angles, np.zeros(FRAMES)])
    )
    places, joints = np.tile([0.0, 0.0, 3.0], (FRAMES, 1)), rng.normal(size=(FRAMES, 23, 3))
    return make_motion(roots.as_rotvec(), places, noise_rad * joints, frames=np.arange(FRAMES))


def some_keypoints(**others) -> KeypointTrack:
    image = np.full((FRAMES, 33, 2), 300.0)
    image[:, 0, 1], image[:, 27:33, 1] = 100.0, 500.0
    return make_track(np.arange(FRAMES), (600, 600), **{"image_px": image, **others})


def grade(shaped, keypoints=None, motion=None, iou=0.85, times=TIMES) -> TrackingGrade:
    matrix = np.array([[600.0, 0, 300], [0, 600.0, 300], [0, 0, 1]])
    motion = a_motion() if motion is None else motion
    keypoints = some_keypoints() if keypoints is None else keypoints
    iou = iou if isinstance(iou, dict) else dict.fromkeys(range(0, FRAMES, 4), iou)
    camera = Camera.from_intrinsic(matrix, (600, 600))
    return grade_tracking(motion, keypoints, shaped, camera, times, iou)


def test_good_poses_are_good_enough(shaped):
    found = grade(shaped)
    assert found.is_good_enough
    assert found.stretches == ()
    assert found.directions_seen == 1.0
    assert found.person_px == pytest.approx(400.0)


def test_who_did_not_turn_was_seen_from_few_directions(shaped):
    assert grade(shaped, motion=a_motion(turns=0.0)).directions_seen == pytest.approx(1 / 12)


def test_three_frames_are_too_few(shaped):
    found = replace(grade(shaped), frames=3, jitter_mm=float("nan"))
    assert not found.is_good_enough
    assert "nan" not in found.describe()


def test_jitter_grows_with_noise(shaped):
    calm, noisy = grade(shaped), grade(shaped, motion=a_motion(noise_rad=0.05))
    assert calm.jitter_mm < 5.0
    assert noisy.jitter_mm > 4.0 * calm.jitter_mm


def test_jitter_is_that_of_tracked_frames_not_of_poses_interpolated_between_them(shaped):
    """Of a spin, whose second difference is the same everywhere, every third frame was tracked."""
    third, spin, image = np.arange(0, FRAMES, 3), a_motion(turns=0.5), some_keypoints().image_px
    held = replace(spin, root_rotations=np.repeat(spin.root_rotations[third], 3, axis=0))
    found = grade(shaped, make_track(third, (600, 600), image_px=image[third]), held)
    assert found.jitter_mm == pytest.approx(grade(shaped, motion=spin).jitter_mm, rel=0.1)


def test_disagreeing_masks_are_an_objection(shaped):
    found = grade(shaped, iou=0.4)
    assert not found.is_good_enough
    assert "IoU" in found.objections[-1]
    assert found.stretches[0].reason == DISAGREE


def test_frames_far_below_the_films_usual_iou_are_left_out(shaped):
    """Another person walks by in front in frames 20 to 32, of which every fourth is graded."""
    usual = {number: 0.9 + 0.005 * (-1) ** (number // 4) for number in range(0, FRAMES, 4)}
    assert grade(shaped, iou=usual).left_out == ()
    hidden = grade(shaped, iou=usual | dict.fromkeys(range(20, 33, 4), 0.75))
    assert {20, 23, 26, 29, 32} <= set(hidden.left_out) <= set(range(17, 36))
    assert [each.reason for each in hidden.stretches] == [DISAGREE]
    assert hidden.is_good_enough


def test_a_stretched_film_is_an_objection(shaped):
    joints = shaped.joints * np.array([4 / 3, 1.0, 1.0])
    found = grade(replace(shaped, joints=joints))
    assert "1.33" in found.objections[0]
    assert grade(replace(shaped, joints=shaped.joints * [0.7, 1, 1])).objections


def test_breadth_is_judged_only_as_far_as_the_directions_seen_show_it(shaped):
    """Two seconds of a side view say nothing about it."""
    broad = replace(shaped, joints=shaped.joints * np.array([1.21, 1.0, 1.0]))
    front = a_motion(turns=0.0)
    turned = Rotation.from_rotvec(front.root_rotations) * Rotation.from_rotvec([0, np.pi / 2, 0])
    assert grade(broad, motion=front).objections
    assert not grade(broad, motion=replace(front, root_rotations=turned.as_rotvec())).objections


def test_the_cause_of_most_doubtful_frames_leads_the_verdict(shaped):
    problems = np.zeros(FRAMES, dtype=np.int64)
    problems[10:50] = PROBLEM_BITS[TrackingProblem.BOTTOM]
    problems[5:12] |= PROBLEM_BITS[TrackingProblem.LEFT]
    verdict = grade(shaped, keypoints=some_keypoints(problems=problems)).describe()
    cause = "the person is cut by the picture's lower border in 40 of 60 frames"
    assert verdict.startswith(f"Good enough for an avatar: no, because {cause}")


def test_a_cut_film_is_named_where_it_is_cut(shaped):
    image = some_keypoints().image_px
    image += np.linspace(0.0, 30.0, FRAMES)[:, None, None] * [1.0, 0.0]
    assert grade(shaped, keypoints=some_keypoints(image_px=image)).stretches == ()
    image[31:, :, 0] += 90.0
    (cut,) = grade(shaped, keypoints=some_keypoints(image_px=image)).stretches
    assert (cut.start_s, cut.end_s) == (1.0, round(31 / FPS, 2))


def test_a_refusal_for_several_reasons_counts_them_all(shaped):
    problems = np.zeros(FRAMES, dtype=np.int64)
    problems[:20] = PROBLEM_BITS[TrackingProblem.CROWDED]
    problems[20:35] = PROBLEM_BITS[TrackingProblem.TOP]
    (objection,) = grade(shaped, keypoints=some_keypoints(problems=problems)).objections
    assert objection.endswith("mixed up in 20 of 60 frames, and 15 more are doubtful")


def test_frames_with_another_person_near_are_left_out_unless_they_are_most(shaped):
    problems = np.zeros(FRAMES, dtype=np.int64)
    problems[10:20] = PROBLEM_BITS[TrackingProblem.CROWDED]
    found = grade(shaped, keypoints=some_keypoints(problems=problems))
    assert found.left_out == tuple(range(10, 20))
    problems[:] = PROBLEM_BITS[TrackingProblem.CROWDED]
    assert grade(shaped, keypoints=some_keypoints(problems=problems)).left_out == ()


def keypoints_in(rows) -> KeypointTrack:
    keypoints = some_keypoints()
    names = ("frames", "image_px", "world_m", "visibility", "presence")
    return replace(keypoints, **{name: getattr(keypoints, name)[rows] for name in names})


def test_titles_before_and_after_the_person_are_no_objection(shaped):
    """Ten seconds of titles are not ten seconds of a person who was missed."""
    rows = np.r_[20:40]
    times = {number: number * 10.0 / FPS for number in TIMES}
    found = grade(shaped, keypoints=keypoints_in(rows), times=times)
    assert found.found_share == pytest.approx(20 / 60)
    assert found.missed_share < 0.05
    assert found.is_good_enough


def test_a_person_missed_in_every_other_frame_is_an_objection(shaped):
    found = grade(shaped, keypoints=keypoints_in(np.r_[0:FRAMES:2]))
    assert found.missed_share == pytest.approx(0.5)
    assert "missed in 50% of the frames" in found.describe()


def test_lost_frames_are_reported_by_their_time(shaped):
    found = grade(shaped, keypoints=keypoints_in(np.r_[0:20, 35:FRAMES]))
    assert found.found_share == pytest.approx(45 / 60)
    assert found.stretches[0].describe().startswith("0.7 to 1.1 s")
