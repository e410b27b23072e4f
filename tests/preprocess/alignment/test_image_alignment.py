"""Tests for the alignment of SMPL's poses to images without masks."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from capture.camera import Camera
from capture.source_opening import open_source
from preprocess.alignment.capture_alignment import NO_PERSON_FOUND, align_body
from preprocess.alignment.capture_evidence import (
    CaptureEvidence,
    ImageSample,
    estimate_silhouettes,
)
from preprocess.alignment.capture_geometry import CaptureGeometry
from preprocess.alignment.mask_alignment import move_pelvis, place_body_on_masks
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import MeshSilhouette, SkinPoints
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.parametric_body import ShapedBody, load_body_model
from preprocess.body.proportion_space import shape_for_motion
from preprocess.cameras.camera_file import CameraTrack

SIZE, FRAMES = (96, 128), 4
CAMERA = Camera(focal_px=(190.0, 190.0), center_px=(48.0, 64.0), size_px=SIZE,
                camera_from_world=np.eye(4))  # fmt: skip
CAMERAS = CameraTrack(cameras=(CAMERA,), source="test")


def turning(yaw: float = np.pi) -> Motion:
    """SMPL's poses of a person who turns half around 3.5 m in front of the camera, limbs moving."""
    rng = np.random.default_rng(3)
    turns = np.linspace(0.0, yaw, FRAMES) / 2.0
    joints = 0.15 * rng.normal(size=(1, 23, 3)) + 0.1 * rng.normal(size=(FRAMES, 23, 3))
    joints[:, [15, 16], 2] += -0.7, 0.7
    return Motion(
        root_rotations=np.pi * np.column_stack([np.cos(turns), 0.0 * turns, np.sin(turns)]),
        root_translations=np.array([[0.05 * row - 0.1, 0.1, 3.5] for row in range(FRAMES)]),
        joint_rotations=joints,
        valid=np.ones(FRAMES, dtype=bool),
        betas=np.ones(10),
        body_model="smpl",
    )


def scaled(shaped: ShapedBody, factor: float) -> ShapedBody:
    pelvis = shaped.joints[0]
    return replace(
        shaped,
        vertices=pelvis + (shaped.vertices - pelvis) * factor,
        joints=pelvis + (shaped.joints - pelvis) * factor,
    )


def filmed(person: ShapedBody, motion: Motion) -> list[np.ndarray]:
    """Images of a person of two colors before a wall of many."""
    rng, outline = np.random.default_rng(5), MeshSilhouette(person)
    wall = cv2.resize(rng.integers(30, 225, (16, 12, 3), dtype=np.uint8), SIZE)
    pictures = []
    for row in range(len(motion)):
        body = outline.draw_pose(motion[row], CAMERA)
        cloth = rng.integers(0, 50, (*SIZE[::-1], 3)) + np.array([30, 40, 180])
        cloth[: SIZE[1] // 2] += np.array([150, 0, -120])
        rgb = np.where(body[..., None], cloth, wall) + rng.normal(0.0, 4.0, (*SIZE[::-1], 3))
        pictures.append(np.clip(rgb, 0, 255).astype(np.uint8))
    return pictures


@pytest.fixture(scope="module")
def own() -> ShapedBody:
    return shape_for_motion(load_body_model(), turning())


def geometry_of(motion: Motion) -> CaptureGeometry:
    return CaptureGeometry(
        motion=motion,
        row_frames=np.arange(FRAMES, dtype=np.float64),
        intrinsics=CAMERA.intrinsic[None],
        extrinsics=np.eye(4)[None],
        size_px=SIZE,
    )


def seen(pictures: list[np.ndarray]) -> list[ImageSample]:
    return [ImageSample(index=i, camera_row=0, rgb=rgb) for i, rgb in enumerate(pictures)]


def pixels_off(own: ShapedBody, motion: Motion, person: ShapedBody, true: Motion) -> float:
    return max(
        float(np.abs(
            CAMERA.project(own.with_pose(motion[row]).joints())
            - CAMERA.project(person.with_pose(true[row]).joints())
        ).max())
        for row in range(len(motion))
    )  # fmt: skip


def test_images_alone_determine_distance_and_pelvis(own):
    """Of SMPL's mean height, 6 cm too high, as poses have it; distances divided and the pelvis
    moved, as told, make the motion that was found ."""
    motion, person = turning(), scaled(own, 0.88)
    pictures = seen(filmed(person, motion))
    off = replace(motion, root_translations=motion.root_translations + np.array([0.0, 0.06, 0.0]))
    skin = SkinPoints.of(own)
    masks = estimate_silhouettes(geometry_of(off), skin, pictures)
    assert masks is not None
    fit = place_body_on_masks(geometry_of(off), masks)
    before = pixels_off(own, off, person, motion)
    assert fit.is_improvement
    assert fit.distance_divisor == pytest.approx(0.88, rel=0.03)
    assert pixels_off(own, fit.motion, person, motion) < 1.5 < 5.0 < before
    there = move_pelvis(
        own.joints[0] + off.root_translations, np.zeros((FRAMES, 3)),
        rotation_matrices(motion.root_rotations), fit.distance_divisor, fit.pelvis_shift_m,
    )  # fmt: skip
    np.testing.assert_allclose(there - own.joints[0], fit.motion.root_translations, atol=1e-9)


def test_no_person_is_found_where_none_stands(tmp_path: Path, own):
    """The person stands half a metre beside the poses."""
    motion = turning()
    beside = replace(motion, root_translations=motion.root_translations + np.array([0.6, 0.0, 0.0]))
    for row, rgb in enumerate(filmed(own, beside)):
        Image.fromarray(rgb).save(tmp_path / f"{row}.png")
    fit = align_body(motion, own, CaptureEvidence(open_source(tmp_path), None, CAMERAS))
    assert fit.placement is None
    assert fit.motion is motion
    assert fit.description == NO_PERSON_FOUND


def test_a_video_without_masks_is_aligned_by_its_images(tmp_path: Path, own):
    motion, person = turning(), scaled(own, 1.12)
    for row, rgb in enumerate(filmed(person, motion)):
        Image.fromarray(rgb).save(tmp_path / f"{row}.png")
    fit = align_body(motion, own, CaptureEvidence(open_source(tmp_path), None, CAMERAS))
    assert fit.placement is not None
    assert fit.placement.distance_divisor == pytest.approx(1.12, rel=0.03)
    assert pixels_off(own, fit.motion, person, motion) < 2.0
    assert fit.description == fit.placement.describe()
