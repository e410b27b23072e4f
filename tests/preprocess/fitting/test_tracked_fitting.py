"""Poses lifted from key points, fitted to key points and masks, written and read again."""

from dataclasses import replace

import numpy as np
import pytest

from capture.input_error import InputError
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.body.body_pose import BodyPose, Motion, RelativeFocalLength
from preprocess.body.parametric_body import ShapedBody, load_body_model
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.fitting import capture_fitting
from preprocess.fitting.capture_fitting import apply_fit, fit_capture, fitted_motion
from preprocess.fitting.clip_fitting import USUAL_WEIGHTS, FitParameters
from preprocess.fitting.keypoint_rows import KEYPOINT_JOINTS, KEYPOINT_OFFSETS_M
from preprocess.fitting.tracked_frames import (
    CHUNK_FRAMES,
    SeenPerson,
    StreamPoseFitter,
    fit_first_frames,
)
from preprocess.masks.mask_sources import EstimatedMasks
from preprocess.open_capture import open_capture
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses
from preprocess.tracking.keypoints import CroppedMask, KeypointTrack, PersonKeypoints
from preprocess.tracking.pose_lift import lift_keypoints


def track_points(capture: Capture) -> KeypointTrack:
    """The capture's own key points, as a tracker finds them: depth is noisy."""
    generator, camera, points = np.random.default_rng(0), capture.cameras[0], []
    for row in range(len(capture.motion)):
        carried = capture.shaped.with_pose(capture.motion[row]).world_from_rest()[KEYPOINT_JOINTS]
        rest = capture.shaped.joints[KEYPOINT_JOINTS] + KEYPOINT_OFFSETS_M
        points.append(np.einsum("pab,pb->pa", carried[:, :3, :3], rest) + carried[:, :3, 3])
    world = np.stack(points)
    count, view = len(world), camera.camera_from_world
    pixels = camera.project(world.reshape(-1, 3)).reshape(-1, 33, 2)
    seen = world @ view[:3, :3].T + view[:3, 3]
    seen -= seen[:, [23, 24]].mean(axis=1, keepdims=True)
    seen[..., 2] += 0.03 * generator.normal(size=seen.shape[:2])
    return KeypointTrack(
        frames=np.arange(count), image_px=pixels, world_m=0.9 * seen,
        visibility=np.ones((count, 33)), presence=np.ones(count), size_px=camera.size_px,
        times_s=np.arange(count) / 30.0,
    )  # fmt: skip


def joints_in_camera(capture: Capture) -> np.ndarray:
    view = capture.cameras[0].camera_from_world[:3, :3]
    joints = np.stack([capture.shaped.with_pose(capture.motion[row]).joints() for row in range(16)])
    return (joints - joints[:, :1]) @ view.T


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
def lifted(truth, tmp_path_factory) -> Capture:
    """The film with lifted poses and an assumed camera; frame 7 was lost."""
    body: ShapedBody = load_body_model().with_shape()
    size = truth.source.size_px
    camera = replace(
        truth.cameras[0], camera_from_world=np.eye(4),
        focal_px=(RelativeFocalLength(ratio=0.85).intrinsic_matrix(size)[0, 0],) * 2,
    )  # fmt: skip
    poses = tmp_path_factory.mktemp("lifted") / "poses.npz"
    track = track_points(truth)
    track.presence[7] = 0.0
    write_motion(poses, lift_keypoints(track, body, camera))
    paths = {"video": truth.paths.video, "poses": poses, "masks": truth.paths.masks}
    return open_capture(CaptureInputs(**paths, cameras="static"))


@pytest.fixture(scope="module")
def fit(lifted):
    return fit_capture(lifted)


def test_the_fit_brings_lifted_poses_near_the_truth(lifted, truth, fit):
    fitted = apply_fit(lifted, fit)
    assert fit.share == 1.0
    assert fit.error_after_cm < 0.6 * fit.error_before_cm
    assert error_mm(fitted, truth) < 0.85 * error_mm(lifted, truth)
    assert error_mm(fitted, truth) < 40.0


def test_fitted_poses_are_read_as_they_were_written(lifted, fit, tmp_path):
    motion: Motion = fitted_motion(lifted, fit)
    write_motion(tmp_path / "poses.npz", motion)
    inputs = CaptureInputs(
        video=lifted.paths.video, poses=tmp_path / "poses.npz", masks=lifted.paths.masks,
        cameras="static",
    )  # fmt: skip
    again, fitted = open_capture(inputs), apply_fit(lifted, fit)
    np.testing.assert_allclose(again.shaped.joints, fit.shape(lifted.shaped).joints)
    ours, theirs = joints_in_camera(again), joints_in_camera(fitted)
    scale = (ours * theirs).sum() / (ours * ours).sum()
    np.testing.assert_allclose(scale * ours, theirs, atol=1e-6)
    assert again.cameras[0].focal_px == pytest.approx(fitted.cameras[0].focal_px)
    assert read_poses(tmp_path / "poses.npz").keypoints is not None
    assert fit_capture(again) is None  # its proportions say that it was fitted


def test_fitted_poses_keep_their_focal_length_beside_a_camera_file(lifted, fit, truth, tmp_path):
    write_motion(tmp_path / "poses.npz", fitted_motion(lifted, fit))
    stated, (width, height) = truth.cameras[0], truth.source.size_px
    np.savez(
        tmp_path / "cameras.npz", intrinsic=np.diag([1.3, 1.3, 1.0]) @ stated.intrinsic,
        extrinsic=stated.camera_from_world, width=width, height=height,
    )  # fmt: skip
    inputs = CaptureInputs(
        video=lifted.paths.video, poses=tmp_path / "poses.npz", masks=lifted.paths.masks,
        cameras=str(tmp_path / "cameras.npz"),
    )  # fmt: skip
    again = open_capture(inputs)
    assert again.cameras[0].focal_px == pytest.approx(apply_fit(lifted, fit).cameras[0].focal_px)
    np.testing.assert_allclose(again.cameras[0].camera_from_world, stated.camera_from_world)


def test_a_fit_without_masks_takes_the_key_points_alone(lifted, truth):
    def find_none(frame, pose, camera):
        raise InputError("no person is there")

    alone = fit_capture(replace(lifted, masks=EstimatedMasks(find_none)))
    assert alone.share == 1.0
    assert error_mm(apply_fit(lifted, alone), truth) < 0.95 * error_mm(lifted, truth)


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
    told, usual = error.values()
    assert told < 0.95 * usual


def test_key_points_alone_count_fully_so_that_a_fast_walk_is_followed(lifted):
    found = []
    for share in (0.1, 1.0):
        fitter = capture_fitting.make_fitter(lifted)
        fitter.weights = capture_fitting.TRACKED_WEIGHTS._replace(keypoints=share)
        fitter.iterate(FitParameters(outlines=False))
        found.append(fitter.poses.translations)
    np.testing.assert_allclose(*found)


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


def test_first_poses_do_not_hang_on_frames_that_a_slow_machine_leaves_out(truth):
    camera, body = replace(truth.cameras[0], camera_from_world=np.eye(4)), load_body_model()
    every = see_people(truth)[:4]
    third = [replace(each, number=3 * each.number) for each in every]
    found = [fit_first_frames(seen, body.with_shape(), camera)[0] for seen in (every, third)]
    assert list(found[1].frames) == [0, 3, 6, 9]
    np.testing.assert_allclose(found[0].root_translations, found[1].root_translations)


def test_poses_of_a_stream_are_fitted_with_those_around_them(truth):
    seen, camera = see_people(truth), replace(truth.cameras[0], camera_from_world=np.eye(4))
    motion, person, camera = fit_first_frames(seen[:8], load_body_model().with_shape(), camera)
    fitter, found = StreamPoseFitter(person, camera), {}
    for place, each in enumerate(seen):
        found |= fitter.add(each, motion[place] if place < 8 else None)
        assert all(number <= place - CHUNK_FRAMES for number in found)
    assert found
    found |= fitter.finish()
    assert list(found) == list(range(len(seen)))
    alone = {}
    for each in seen[4:12]:
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
