"""The joint alignment of a clip: what comes back of body, poses and focal length."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import SkinPoints, splat_silhouette
from preprocess.body.proportion_space import ProportionSpace
from preprocess.fitting.clip_fitting import ClipFitter, ClipFrame, FitParameters
from preprocess.fitting.clip_poses import ClipPoses
from preprocess.fitting.outlines import OUTLINE_SKIN_POINTS, OutlineDistances
from tests.motions import make_motion, posed_joints

VIEW = np.diag([1.0, -1.0, -1.0, 1.0])
VIEW[2, 3] = 2.6
CAMERA = Camera(
    focal_px=(200.0, 200.0), center_px=(48.0, 80.0), size_px=(96, 160), camera_from_world=VIEW
)
FRAMES = 10


def turning_motion() -> Motion:
    """A full turn with the arms held off the body."""
    joints = np.zeros((FRAMES, 23, 3))
    joints[:, [0, 1], 2] = 0.2, -0.2
    joints[:, [15, 16], 2] = -0.8, 0.8
    roots = np.zeros((FRAMES, 3))
    roots[:, 1] = 2.0 * np.pi * np.arange(FRAMES) / FRAMES
    return make_motion(roots, joints=joints)


def err_like_a_tracker(motion: Motion) -> Motion:
    """The motion leaning by 4 degrees, 5 cm farther off, with arms and legs off by 5 degrees."""
    lean = Rotation.from_rotvec([np.deg2rad(4.0), 0.0, 0.0])
    joints = motion.joint_rotations.copy()
    joints[:, [15, 16, 0, 1], 2] += np.deg2rad([5.0, 5.0, -5.0, 4.0])
    return replace(
        motion,
        root_rotations=(lean * Rotation.from_rotvec(motion.root_rotations)).as_rotvec(),
        root_translations=motion.root_translations + np.array([0.02, 0.0, -0.05]),
        joint_rotations=joints,
    )


@pytest.fixture(scope="module")
def space(shaped) -> ProportionSpace:
    return ProportionSpace.around(shaped)


def outlines(space: ProportionSpace, coefficients, motion: Motion) -> list[ClipFrame]:
    skin = SkinPoints.of(space.shape(coefficients), OUTLINE_SKIN_POINTS)
    frames = []
    for row in range(len(motion)):
        mask = splat_silhouette(skin.posed(motion[row]), CAMERA).astype(np.float32)
        outline = OutlineDistances.of(mask, CAMERA)
        frames.append(ClipFrame(number=float(row), camera=CAMERA, mask=outline))
    return frames


def fitter_of(motion: Motion, space: ProportionSpace, frames: list[ClipFrame]) -> ClipFitter:
    return ClipFitter(ClipPoses.of(motion, range(len(frames))), space, frames)


def joint_error_cm(fitter: ClipFitter, person, truth: Motion) -> float:
    """Mean distance of joints from the truth, relative to the pelvis."""
    shaped = fitter.model.space.shape(fitter.coefficients)
    ours, theirs = posed_joints(fitter.poses.replace_in(truth), shaped), posed_joints(truth, person)
    apart = (ours - ours[:, :1]) - (theirs - theirs[:, :1])
    return 100.0 * float(np.linalg.norm(apart, axis=2).mean())


def turn_error_deg(fitter: ClipFitter, truth: Motion) -> float:
    """Mean angle between the joints' rotations and the truth's: of hips and shoulders."""

    ours, theirs = (
        Rotation.from_rotvec(motion.joint_rotations[:, [0, 1, 15, 16]].reshape(-1, 3))
        for motion in (fitter.poses.replace_in(truth), truth)
    )
    return float(np.degrees((ours * theirs.inv()).magnitude().mean()))


def test_poses_and_proportions_come_back(space):
    coefficients = np.zeros(space.count)
    coefficients[[11, 17, 20, 25]] = 1.5, -1.5, 1.5, 1.0  # thighs, forearms, girths
    truth, person = turning_motion(), space.shape(coefficients)
    fitter = fitter_of(err_like_a_tracker(truth), space, outlines(space, coefficients, truth))
    off, turned = joint_error_cm(fitter, person, truth), turn_error_deg(fitter, truth)
    errors_px = [fitter.iterate(FitParameters()) for _ in range(6)]
    assert errors_px[-1] < 0.4 * errors_px[0]
    assert joint_error_cm(fitter, person, truth) < 0.6 * off
    assert turn_error_deg(fitter, truth) < 0.6 * turned


def test_what_is_not_fitted_stays(space):
    truth = turning_motion()
    fitter = fitter_of(
        err_like_a_tracker(truth), space, outlines(space, np.zeros(space.count), truth)
    )
    fitter.iterate(FitParameters(poses=True, proportions=False, focal=False))
    assert np.abs(fitter.coefficients).max() < 1e-6
    assert abs(fitter.log_focal) < 1e-6
    assert np.abs(fitter.corrections).max() > 1e-3


def test_exact_poses_hardly_move(space):
    truth = turning_motion()
    fitter = fitter_of(truth, space, outlines(space, np.zeros(space.count), truth))
    for _ in range(3):
        fitter.iterate(FitParameters())
    assert np.degrees(np.abs(fitter.corrections[:, :72]).max()) < 2.0
    assert np.degrees(np.linalg.norm(fitter.corrections[:, :3], axis=1).mean()) < 0.5


def test_frames_that_are_alike_count_as_two_at_most(shaped):
    truth, rest = turning_motion(), shaped.joints

    def count(rows: list[int]) -> float:
        views = np.broadcast_to(VIEW[:3, :3], (len(rows), 3, 3))
        return ClipPoses.of(truth, rows).independent_count(rest, views)

    assert count([0]) == pytest.approx(1.0)
    assert 1.9 < count([0] * 100) < 2.0
    turn = list(range(FRAMES))
    assert 0.6 * FRAMES < count(turn) < FRAMES
    assert count(10 * turn) < 2.0 * FRAMES


@pytest.mark.slow
def test_a_still_person_is_believed_no_more_the_longer_the_film(space):
    coefficients, found = np.zeros(space.count), []
    coefficients[17] = 3.0  # outlines of forearms 15 % too long
    for count in (3, 9):
        still = replace(turning_motion(), root_rotations=np.zeros((FRAMES, 3)))
        fitter = fitter_of(still, space, outlines(space, coefficients, still)[:count])
        for _ in range(6):
            fitter.iterate(FitParameters())
        found.append(fitter.coefficients[17])
    assert found[1] == pytest.approx(found[0], abs=0.15)
