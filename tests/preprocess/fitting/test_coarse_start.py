"""Distances, pelvis and focal length that no file states: poses of another body, other persons."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from capture.camera import Camera
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import DENSE_SKIN_POINTS, SkinPoints
from preprocess.body.parametric_body import (
    BodyModel,
    ShapedBody,
    load_body_model,
    write_shaped_body,
)
from preprocess.body.proportion_space import shape_for_motion
from preprocess.cameras.camera_file import CameraTrack, write_cameras
from preprocess.capture_inputs import CaptureInputs
from preprocess.capture_session import Capture
from preprocess.open_capture import open_capture
from preprocess.poses.pose_file import write_motion
from tests.motions import make_motion

SIZE, FRAMES = (96, 128), 5
CAMERA = Camera(focal_px=(190.0, 190.0), center_px=(48.0, 64.0), size_px=SIZE,
                camera_from_world=np.eye(4))  # fmt: skip
SHIFTED_M = np.array([0.0, 0.06, 0.0])


def turning(model: str) -> Motion:
    """A person who turns half round 3.5 m in front of the camera, limbs moving a little."""
    rng = np.random.default_rng(3)
    turns = np.linspace(0.0, np.pi, FRAMES) / 2.0
    joints = 0.15 * rng.normal(size=(1, 23, 3)) + 0.1 * rng.normal(size=(FRAMES, 23, 3))
    joints[:, [15, 16], 2] += -0.7, 0.7
    roots = np.pi * np.column_stack([np.cos(turns), 0.0 * turns, np.sin(turns)])
    places = np.array([[0.05 * row - 0.1, 0.1, 3.5] for row in range(FRAMES)])
    return make_motion(roots, places, joints, model)


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body_model()


def film(folder: Path, person: ShapedBody, motion: Motion, given: str) -> None:
    """Images of a person of two colors before a wall of many; masks, alpha channels, or neither."""
    rng, skin = np.random.default_rng(5), SkinPoints.of(person, DENSE_SKIN_POINTS)
    wall = cv2.resize(rng.integers(30, 225, (16, 12, 3), dtype=np.uint8), SIZE)
    (folder / "images").mkdir(parents=True)
    if given == "masks":
        (folder / "masks").mkdir()
    for row in range(len(motion)):
        seen = skin.draw(motion[row], CAMERA)
        cloth = rng.integers(0, 50, (*SIZE[::-1], 3)) + np.array([30, 40, 180])
        cloth[: SIZE[1] // 2] += np.array([150, 0, -120])
        rgb = np.where(seen[..., None], cloth, wall) + rng.normal(0.0, 4.0, (*SIZE[::-1], 3))
        rgb, alpha = np.clip(rgb, 0, 255).astype(np.uint8), (255 * seen).astype(np.uint8)
        if given == "alpha":
            rgb = np.dstack([rgb, alpha])
        Image.fromarray(rgb).save(folder / "images" / f"{row}.png")
        if given == "masks":
            Image.fromarray(alpha).save(folder / "masks" / f"{row}.png")
    write_cameras(folder / "cameras.npz", CameraTrack(cameras=(CAMERA,), source="test"))


def opened(folder: Path, motion: Motion, avatar_body: Path | None = None) -> Capture:
    write_motion(folder / "poses.npz", motion)
    return open_capture(CaptureInputs(video=folder), skip_checks=True, avatar_body=avatar_body)


def pixels_off(capture: Capture, person: ShapedBody, motion: Motion) -> float:
    """How far a joint lands from where the person has it, pixels of 2 cm."""
    return max(
        float(np.abs(
            CAMERA.project(capture.shaped.with_pose(capture.motion[row]).joints())
            - CAMERA.project(person.with_pose(motion[row]).joints())
        ).max())
        for row in range(len(motion))
    )  # fmt: skip


@pytest.mark.parametrize(
    ("factor", "given"),
    [(2.0, "masks"), (0.88, "neither"), pytest.param(1.12, "alpha", marks=pytest.mark.slow)],
)
def test_the_distance_of_strangers_poses_is_found(tmp_path, body, factor, given):
    """Their tracker assumes a person of another size, and has the pelvis 6 cm lower."""
    motion = turning("smpl")
    person = shape_for_motion(body, motion)
    film(tmp_path, person, motion, given)
    pelves = person.joints[0] + motion.root_translations
    off = replace(motion, root_translations=factor * (pelves + SHIFTED_M) - person.joints[0])
    capture = opened(tmp_path, off)
    figures = capture.figures("body")
    assert figures["taken"]
    assert figures["distances_divided_by"] == pytest.approx(factor, rel=0.03)
    assert figures["agreement_after"] > (0.8 if given == "neither" else 0.9)
    assert pixels_off(capture, person, motion) < 1.5
    np.testing.assert_array_equal(capture.motion.joint_rotations, motion.joint_rotations)


def test_poses_of_the_bodys_own_model_and_of_the_same_person_stay(tmp_path, body):
    motion = turning("body24")
    film(tmp_path, body.with_shape(), motion, "masks")
    write_shaped_body(tmp_path / "person.npz", body.with_shape())
    first, again = opened(tmp_path, motion), opened(tmp_path, motion, tmp_path / "person.npz")
    for capture in (first, again):
        np.testing.assert_array_equal(capture.motion.root_translations, motion.root_translations)
        assert capture.figures("body") is None
    assert again.notes == first.notes


def test_where_no_person_is_found_distances_stay_with_a_note(tmp_path, body):
    motion = turning("smpl")
    beside = replace(motion, root_translations=motion.root_translations + np.array([0.6, 0.0, 0.0]))
    film(tmp_path, shape_for_motion(body, motion), beside, "neither")
    capture = opened(tmp_path, motion)
    np.testing.assert_array_equal(capture.motion.root_translations, motion.root_translations)
    assert any("stay as they are" in note for note in capture.notes)


# --- a finished avatar's person ------------------------------------------------------------------


def betas_of(body: BodyModel, amount: float) -> np.ndarray:
    """Betas that make this body taller, or smaller."""
    mean = body.with_shape().height_m
    heights = np.array([body.with_shape(row).height_m for row in np.eye(10)])
    chosen = int(np.argmax(np.abs(heights - mean)))
    return amount * np.sign(heights[chosen] - mean) * np.eye(10)[chosen]


@pytest.mark.parametrize(
    ("amount", "given"),
    [(-1.5, "masks"), (1.5, "neither"), pytest.param(1.5, "alpha", marks=pytest.mark.slow)],
)
def test_an_added_video_is_aligned_to_the_avatars_person(tmp_path, body, amount, given):
    """Its tracker assumed a larger person farther away, or a smaller one nearer."""
    person, betas, motion = body.with_shape(), betas_of(body, amount), turning("body24")
    other = body.with_shape(betas)
    film(tmp_path, person, motion, given)
    write_shaped_body(tmp_path / "person.npz", person)
    ratio = other.height_m / person.height_m
    assert abs(ratio - 1.0) > 0.02
    pelves = person.joints[0] + motion.root_translations
    claimed = replace(motion, betas=betas, root_translations=ratio * pelves - other.joints[0])
    capture = opened(tmp_path, claimed, tmp_path / "person.npz")
    np.testing.assert_allclose(capture.shaped.joints, person.joints, atol=1e-6)
    assert any(f"{100 * other.height_m:.0f} cm" in note for note in capture.notes)
    assert pixels_off(capture, person, motion) < 1.2


def test_an_added_video_with_smpls_poses_fits_the_avatars_proportions(tmp_path, body):
    person, motion = body.with_shape().scaled_to(1.1 * body.with_shape().height_m), turning("smpl")
    film(tmp_path, person, motion, "masks")
    write_shaped_body(tmp_path / "person.npz", person)
    own = shape_for_motion(body, motion)
    nearer = (person.joints[0] + motion.root_translations) / 1.12 - own.joints[0]
    claimed = replace(motion, root_translations=nearer)
    assert pixels_off(opened(tmp_path, claimed, tmp_path / "person.npz"), person, motion) < 1.2
