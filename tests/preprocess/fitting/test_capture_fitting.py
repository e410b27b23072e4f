"""A capture with the changes of a fit."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.body.kinematics import axis_angles_from_matrices, rotation_matrices
from preprocess.body.proportion_space import ProportionSpace
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import CaptureFit
from preprocess.fitting import capture_fitting
from preprocess.fitting.capture_fitting import (
    HEAD_JOINTS,
    NOISE_DEG_PER_CM,
    apply_fit,
    fit_capture,
    make_fitter,
    share_beyond_noise,
    weigh_joints,
)
from preprocess.fitting.clip_fitting import FitParameters
from preprocess.open_capture import open_capture
from preprocess.poses.pose_format_registry import read_poses


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
    vectors = axis_angles_from_matrices(one.swapaxes(-1, -2) @ other)
    return float(np.degrees(np.linalg.norm(vectors, axis=-1)).mean())


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
