"""Fits of given poses and of poses that were tracked here; a capture with the changes of a fit."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.input_error import InputError
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.body.body_pose import BodyPose, RelativeFocalLength
from preprocess.body.kinematics import axis_angles_from_matrices, rotation_matrices
from preprocess.body.proportion_space import ProportionSpace
from preprocess.cameras.camera_file import CameraTrack, write_cameras
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture, CaptureFit, load_capture_fit
from preprocess.fitting import capture_fitting, tracked_frames
from preprocess.fitting.capture_fitting import (
    HEAD_JOINTS,
    NOISE_DEG_PER_CM,
    apply_fit,
    fit_capture,
    fitted_motion,
    make_fitter,
    share_beyond_noise,
    weigh_joints,
)
from preprocess.fitting.clip_fitting import USUAL_WEIGHTS, FitParameters
from preprocess.fitting.tracked_frames import SeenPerson, StreamPoseFitter, fit_first_frames
from preprocess.masks.mask_sources import EstimatedMasks
from preprocess.open_capture import open_capture
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses
from preprocess.tracking.keypoints import CroppedMask, KeypointTrack, PersonKeypoints
from preprocess.tracking.pose_lift import lift_keypoints
from tests.motions import angles_deg, perfect_track, posed_joints


@pytest.fixture(scope="module")
def capture(small_capture):
    return open_capture(CaptureInputs(video=small_capture))


@pytest.fixture(scope="module")
def unmasked(small_capture):
    return open_capture(CaptureInputs(video=small_capture, masks=Path("segmenter:blazepose")))


@pytest.fixture
def fit(capture) -> CaptureFit:
    coefficients = np.zeros(ProportionSpace.around(capture.shaped).count)
    coefficients[[0, 11, 17]] = 0.5, 1.0, -1.0  # size, thighs, forearms
    corrections = np.zeros((len(capture.motion), 75))
    corrections[:, 1] = 0.1
    return CaptureFit(
        coefficients=coefficients, focal_factor=1.1, corrections=corrections, error_before_cm=2.0,
        error_after_cm=1.0, share=1.0, keypoint_share=0.0, fits_body=True,
    )  # fmt: skip


def size_of(shaped, like) -> float:
    a, b = shaped.joints - shaped.joints[0], like.joints - like.joints[0]
    return float((a * b).sum() / (b * b).sum())


def test_proportions_and_focal_length_change_but_not_the_size(capture, fit):
    fitted = apply_fit(capture, fit)
    raw = fit.shape(capture.shaped)
    assert abs(size_of(raw, capture.shaped) - 1.0) > 0.02
    assert size_of(capture.shaped, fitted.shaped) == pytest.approx(1.0, abs=1e-9)
    assert fitted.cameras[0].focal_px[0] == pytest.approx(1.1 * capture.cameras[0].focal_px[0])
    assert fitted.fits == (fit,)
    assert fitted.pose_uncertainty == 1.0
    assert capture.pose_uncertainty == 0.0
    tall = apply_fit(capture, fit, height_m=1.9)
    assert np.ptp(tall.shaped.vertices[:, 1]) == pytest.approx(1.9)


def test_the_person_of_a_finished_avatar_does_not_change(capture, fit):
    fitted = apply_fit(capture, replace(fit, fits_body=False), height_m=1.9)
    assert fitted.shaped is capture.shaped
    assert not np.allclose(fitted.motion.root_rotations, capture.motion.root_rotations)


def test_a_fit_is_read_as_it_was_written_and_that_of_another_video_is_not(fit, tmp_path):
    path, fit = tmp_path / "fit.npz", replace(fit, fits_body=False)
    fit.save(path, "/a/video.mp4")
    read = load_capture_fit(path, "/a/video.mp4")
    assert np.array_equal(read.corrections, fit.corrections)
    assert read.as_json() == fit.as_json()
    assert read.fits_body is False
    assert load_capture_fit(path, "/another/video.mp4") is None
    assert load_capture_fit(tmp_path / "none.npz", "/a/video.mp4") is None
    path.write_bytes(b"damaged")
    assert load_capture_fit(path, "/a/video.mp4") is None


def test_the_description_names_quantities_and_units_and_key_points_where_they_count(fit):
    assert "1.0 cm" in fit.describe()
    assert "5.7 degrees" in fit.describe()
    assert "key points" not in fit.describe()
    assert "count by 60%" in replace(fit, keypoint_share=0.4).describe()


def test_changes_count_as_far_as_they_exceed_the_noise_of_the_fit():
    def share(degrees):
        turned = np.zeros((10, 75))
        turned[:, :72:3] = np.radians(degrees) / np.sqrt(2.0)
        return share_beyond_noise(turned, 2.0)

    noise_deg = 2.0 * NOISE_DEG_PER_CM
    assert share(0.0) == share(0.9 * noise_deg) == 0.0
    assert 0.0 < share(1.01 * noise_deg) < 0.05  # no step
    assert share(2.0 * noise_deg) == pytest.approx(0.75)
    assert share(5.0 * noise_deg) > 0.95


def test_a_fit_that_is_not_taken_changes_nothing(capture, fit):
    kept = apply_fit(capture, replace(fit, share=0.0))
    assert kept.pose_uncertainty == 0.0
    assert kept.motion is capture.motion
    assert kept.shaped is capture.shaped


def test_without_masks_poses_are_fitted_to_estimated_ones_unless_they_are_exact(
    unmasked, monkeypatch
):
    monkeypatch.setattr(capture_fitting, "_take_keypoints", lambda *evidence: 0.0)
    assert fit_capture(unmasked).share < 0.2
    motion, angle = unmasked.motion, np.radians(6.0)
    lean = rotation_matrices(np.array([0.0, 0.0, angle]))
    leaning = axis_angles_from_matrices(lean @ rotation_matrices(motion.root_rotations))
    found = fit_capture(replace(unmasked, motion=replace(motion, root_rotations=leaning)))
    assert found is not None
    assert found.share > 0.5
    assert found.error_after_cm < 0.7 * found.error_before_cm
    turned = np.linalg.norm(found.corrections[:, :3], axis=1)
    assert 0.3 * angle < turned.mean() < 1.2 * angle  # priors and coarse masks hold it back


def test_poses_are_fitted_to_refined_masks(tmp_path):
    """Of masks that are two pixels too wide, most of the error does not reach the fit."""
    folder = tmp_path / "capture"
    film_capture(folder, ShootConfig(frames=8, size=160))
    for path in (folder / "masks").iterdir():
        grown = cv2.dilate(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.ones((5, 5), np.uint8))
        cv2.imwrite(str(path), grown)
    errors_px = []
    for refines in (False, True):
        inputs = CaptureInputs(video=folder, refine_masks=refines)
        fitter = make_fitter(open_capture(inputs, skip_checks=True))
        errors_px.append(fitter.iterate(FitParameters()))
    as_given, refined = errors_px
    assert refined < 0.7 * as_given


# --- key points beside given poses ---------------------------------------------------------------


@pytest.fixture(scope="module")
def coarse(tmp_path_factory):
    """A film whose given poses err 2.5 times as far as a good tracker's; opened, and its truth."""
    folder = tmp_path_factory.mktemp("coarse") / "capture"
    error = {"like_a_phone": True, "tracker_error": 2.5}
    film_capture(folder, ShootConfig(frames=24, size=112, fps=8.0, **error))
    return open_capture(CaptureInputs(video=folder)), read_poses(folder / "truth" / "poses.npz")


def error_deg(motion, truth) -> float:
    """Mean angle of the joints that trackers see to the truth's, degrees."""
    one, other = (rotation_matrices(each.joint_rotations[:, :21]) for each in (motion, truth))
    return float(angles_deg(one, other).mean())


@pytest.mark.slow
def test_key_points_bring_coarse_poses_nearer_to_the_truth(coarse, monkeypatch):
    capture, truth = coarse
    with_keypoints = fit_capture(capture)
    monkeypatch.setattr(capture_fitting, "_take_keypoints", lambda *evidence: 0.0)
    without = fit_capture(capture)
    assert with_keypoints.keypoint_share > 0.3
    assert without.keypoint_share == 0.0
    by_both, by_outlines = (
        error_deg(apply_fit(capture, fit).motion, truth) for fit in (with_keypoints, without)
    )
    assert by_both < 0.85 * by_outlines


@pytest.mark.slow
def test_coarse_poses_are_fitted_to_the_masks_of_more_frames(coarse, monkeypatch):
    capture, truth = coarse
    monkeypatch.setattr(capture_fitting, "KEY_FRAMES", 6)
    monkeypatch.setattr(capture_fitting, "MORE_MASKS", 12)
    by_all = error_deg(apply_fit(capture, fit_capture(capture)).motion, truth)
    monkeypatch.setattr(capture_fitting, "_with_more_masks", lambda *evidence: None)
    by_six = error_deg(apply_fit(capture, fit_capture(capture)).motion, truth)
    assert by_all < by_six


def test_no_key_points_are_looked_for_where_given_poses_are_exact(capture, monkeypatch):
    monkeypatch.delattr(capture_fitting, "_find_keypoints")
    assert fit_capture(capture).share == 0.0


LIMBS = [1, 2, 4, 5, 16, 17, 18, 19]


def steps_apart(joint_deg) -> np.ndarray:
    """Steps of eight frames whose joints turn so far, about any axis, degrees (24)."""
    axes = np.random.default_rng(0).normal(size=(8, 24, 3))
    axes *= np.radians(joint_deg)[:, None] / np.linalg.norm(axes, axis=2, keepdims=True)
    return np.column_stack([axes.reshape(8, 72), np.zeros((8, 3))])


def test_two_estimates_of_a_pose_that_err_alike_count_alike():
    """Of errors of 10 degrees each, independent, the disagreement is 14."""
    weights = weigh_joints(steps_apart(np.full(24, 200.0**0.5)), np.radians(10.0))
    np.testing.assert_allclose(weights[LIMBS], 0.5, atol=1e-6)


def test_a_joint_counts_the_less_the_farther_its_two_estimates_lie_apart():
    turned = np.full(24, 8.0)
    turned[16] = 16.0
    weights = weigh_joints(steps_apart(turned), np.radians(4.0))
    assert weights[16] == pytest.approx(weights[17] / 4.0)
    assert ((weights > 0.0) & (weights < 1.0)).all()
    assert not weigh_joints(steps_apart(turned), 0.0).any()


def test_key_points_of_a_face_hardly_tell_how_a_head_is_turned():
    weights = weigh_joints(steps_apart(np.full(24, 4.0)), np.radians(3.5))
    assert (weights[list(HEAD_JOINTS)] < 0.25 * weights[LIMBS].min()).all()


# --- poses that were lifted from key points -------------------------------------------------------


def track_points(capture: Capture) -> KeypointTrack:
    """The capture's own key points, as a tracker finds them: depth is noisy, and size a guess."""
    track = perfect_track(capture.motion, capture.shaped, capture.cameras[0])
    track.world_m[..., 2] += 0.03 * np.random.default_rng(0).normal(size=track.world_m.shape[:2])
    return replace(track, world_m=0.9 * track.world_m)


def joints_in_camera(capture: Capture) -> np.ndarray:
    joints = posed_joints(capture.motion, capture.shaped)
    return (joints - joints[:, :1]) @ capture.cameras[0].camera_from_world[:3, :3].T


def error_mm(capture: Capture, truth: Capture) -> float:
    """Mean distance of joints, relative to the pelvis and free of scale."""
    ours, theirs = joints_in_camera(capture), joints_in_camera(truth)
    scale = (ours * theirs).sum() / (ours * ours).sum()
    return 1000.0 * float(np.linalg.norm(scale * ours - theirs, axis=2).mean())


@pytest.fixture(scope="module")
def truth(tmp_path_factory) -> Capture:
    folder = tmp_path_factory.mktemp("tracked") / "capture"
    film_capture(folder, ShootConfig(frames=16, size=96, turns=0.4))
    return open_capture(CaptureInputs(video=folder))


@pytest.fixture(scope="module")
def lifted(truth, shaped, tmp_path_factory) -> Capture:
    """The film with lifted poses and an assumed camera; frame 7 was lost."""
    size = truth.source.size_px
    camera = replace(
        truth.cameras[0], camera_from_world=np.eye(4),
        focal_px=(RelativeFocalLength(ratio=0.85).intrinsic_matrix(size)[0, 0],) * 2,
    )  # fmt: skip
    poses = tmp_path_factory.mktemp("lifted") / "poses.npz"
    track = track_points(truth)
    track.presence[7] = 0.0
    write_motion(poses, lift_keypoints(track, shaped, camera))
    paths = {"video": truth.paths.video, "poses": poses, "masks": truth.paths.masks}
    return open_capture(CaptureInputs(**paths, cameras="static"))


@pytest.fixture(scope="module")
def tracked_fit(lifted) -> CaptureFit:
    return fit_capture(lifted)


def test_the_fit_brings_lifted_poses_near_the_truth(lifted, truth, tracked_fit):
    fitted = apply_fit(lifted, tracked_fit)
    assert tracked_fit.share == 1.0
    assert tracked_fit.error_after_cm < 0.6 * tracked_fit.error_before_cm
    assert error_mm(fitted, truth) < 0.85 * error_mm(lifted, truth)
    assert error_mm(fitted, truth) < 40.0


def with_fitted_poses(lifted, fit, path, cameras="static") -> Capture:
    """The film once more, with its fitted poses from a file."""
    write_motion(path, fitted_motion(lifted, fit))
    paths = {"video": lifted.paths.video, "poses": path, "masks": lifted.paths.masks}
    return open_capture(CaptureInputs(**paths, cameras=cameras))


def test_fitted_poses_are_read_as_they_were_written(lifted, tracked_fit, tmp_path):
    again = with_fitted_poses(lifted, tracked_fit, tmp_path / "poses.npz")
    fitted = apply_fit(lifted, tracked_fit)
    np.testing.assert_allclose(again.shaped.joints, tracked_fit.shape(lifted.shaped).joints)
    ours, theirs = joints_in_camera(again), joints_in_camera(fitted)
    scale = (ours * theirs).sum() / (ours * ours).sum()
    np.testing.assert_allclose(scale * ours, theirs, atol=1e-6)
    assert again.cameras[0].focal_px == pytest.approx(fitted.cameras[0].focal_px)
    assert again.motion.keypoints is not None
    assert fit_capture(again) is None  # its proportions say that it was fitted


def test_fitted_poses_keep_their_focal_length_beside_a_camera_file(
    lifted, tracked_fit, truth, tmp_path
):
    stated, file = truth.cameras[0], tmp_path / "cameras.npz"
    write_cameras(file, CameraTrack(cameras=(stated.scale_focal(1.3),), source="file"))
    again = with_fitted_poses(lifted, tracked_fit, tmp_path / "poses.npz", str(file))
    fitted = apply_fit(lifted, tracked_fit)
    assert again.cameras[0].focal_px == pytest.approx(fitted.cameras[0].focal_px)
    np.testing.assert_allclose(again.cameras[0].camera_from_world, stated.camera_from_world)


def test_a_fit_without_masks_takes_the_key_points_alone(lifted, truth):
    def find_none(frame, pose, camera):
        raise InputError("no person is there")

    alone = fit_capture(replace(lifted, masks=EstimatedMasks(find_none)))
    assert alone.share == 1.0
    assert error_mm(apply_fit(lifted, alone), truth) < 0.95 * error_mm(lifted, truth)


@pytest.mark.slow
def test_key_points_that_are_off_in_all_frames_give_way_to_outlines(lifted, truth, monkeypatch):
    track = lifted.motion.keypoints
    aside_px = 0.04 * truth.source.size_px[1] / 2.0  # about 4 cm
    shifted = track.image_px.copy()
    shifted[:, [13, 15, 25, 27]] += aside_px
    shifted[:, [14, 16, 26, 28]] -= aside_px
    off = replace(lifted, motion=replace(lifted.motion, keypoints=replace(track, image_px=shifted)))
    error = {}
    for weights in (capture_fitting.TRACKED_WEIGHTS, USUAL_WEIGHTS):
        monkeypatch.setattr(capture_fitting, "TRACKED_WEIGHTS", weights)
        ours, true = joints_in_camera(apply_fit(off, fit_capture(off))), joints_in_camera(truth)
        away = ours * (ours * true).sum() / (ours * ours).sum() - true
        error[weights] = float(np.linalg.norm(away[..., :2], axis=2).mean())
    tracked, usual = error.values()
    assert tracked < 0.95 * usual


def test_key_points_alone_count_fully_so_that_a_fast_walk_is_followed(lifted):
    found = []
    for share in (0.1, 1.0):
        fitter = make_fitter(lifted)
        fitter.weights = capture_fitting.TRACKED_WEIGHTS._replace(keypoints=share)
        fitter.iterate(FitParameters(outlines=False))
        found.append(fitter.poses.translations)
    np.testing.assert_allclose(*found)


@pytest.mark.slow
def test_poses_follow_outlines_closer_than_proportions_do(lifted, monkeypatch):
    monkeypatch.setattr(capture_fitting, "POSE_ITERATIONS", 2)  # errors are those before the last
    fit = fit_capture(lifted)
    monkeypatch.setattr(capture_fitting, "TRACKED_POSE_WEIGHTS", capture_fitting.TRACKED_WEIGHTS)
    looser = fit_capture(lifted)
    np.testing.assert_allclose(looser.coefficients, fit.coefficients)
    assert fit.error_after_cm < 0.98 * looser.error_after_cm


def see_people(truth: Capture) -> list[SeenPerson]:
    """The capture's frames as a stream's tracker sees them; key points are not exact."""
    track, generator = track_points(truth), np.random.default_rng(1)
    seen = []
    for row, found in enumerate(truth.observations()):
        keypoints = PersonKeypoints(
            image_px=track.image_px[row] + 2.0 * generator.normal(size=(33, 2)),
            world_m=track.world_m[row], visibility=np.ones(33), presence=1.0,
            mask=CroppedMask(values=np.zeros((2, 2), np.uint8), image_from_crop=np.eye(3)[:2]),
        )  # fmt: skip
        seen.append(SeenPerson(number=row, time_s=row / 8.0, keypoints=keypoints, mask=found.alpha))
    return seen


def test_poses_of_a_stream_are_fitted_with_those_around_them(truth, shaped, monkeypatch):
    seen, camera = see_people(truth)[:12], replace(truth.cameras[0], camera_from_world=np.eye(4))
    motion, person, camera = fit_first_frames(seen[:4], shaped, camera)
    monkeypatch.setattr(tracked_frames, "CHUNK_FRAMES", 5)
    fitter, found = StreamPoseFitter(person, camera), {}
    for place, each in enumerate(seen):
        found |= fitter.add(each, motion[place] if place < 4 else None)
        assert all(number <= place - 5 for number in found)
    assert found
    found |= fitter.finish()
    assert list(found) == list(range(len(seen)))
    alone = {}
    for each in seen[4:9]:
        fitter = StreamPoseFitter(person, camera)
        alone |= fitter.add(each) | fitter.finish()

    def errors_m(poses: dict[int, BodyPose]) -> tuple[float, float]:
        """Mean distance to the truth, and second difference, of joints in the poses of `alone`."""
        ours = np.stack([person.with_pose(poses[number]).joints() for number in alone])
        ours, true = ours - ours[:, :1], joints_in_camera(truth)[list(alone)]
        ours *= (ours * true).sum() / (ours * ours).sum()
        bent = np.linalg.norm(np.diff(ours, 2, axis=0), axis=2)
        return float(np.linalg.norm(ours - true, axis=2).mean()), float(bent.mean())

    before, after = errors_m(alone), errors_m(found)
    assert after[0] < before[0]
    assert after[1] < 0.5 * before[1]


@pytest.mark.usefixtures("one_iteration")
def test_first_poses_do_not_hang_on_frames_that_a_slow_machine_leaves_out(truth, shaped):
    camera = replace(truth.cameras[0], camera_from_world=np.eye(4))
    every = see_people(truth)[:4]
    third = [replace(each, number=3 * each.number) for each in every]
    found = [fit_first_frames(seen, shaped, camera)[0] for seen in (every, third)]
    assert list(found[1].frames) == [0, 3, 6, 9]
    np.testing.assert_allclose(found[0].root_translations, found[1].root_translations)
