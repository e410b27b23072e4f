"""Tests for the detection of a pose file's body model by masks or images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from capture.camera import Camera
from capture.source_opening import open_source
from preprocess.alignment.capture_alignment import place_motion
from preprocess.alignment.capture_evidence import CaptureEvidence
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import SkinPoints, splat_silhouette
from preprocess.body.parametric_body import load_body_model
from preprocess.body.proportion_space import shape_for_motion
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_files import open_masks
from preprocess.masks.mask_sources import StoredMasks

SIZE, FRAMES = (96, 128), 6
CAMERA = Camera(focal_px=(190.0, 190.0), center_px=(48.0, 64.0), size_px=SIZE,
                camera_from_world=np.eye(4))  # fmt: skip
CAMERAS = CameraTrack(cameras=(CAMERA,), source="test")
BETAS = np.array([-0.3, -0.5, 1.4, -1.2, -0.2, 2.5, -2.5, -0.9, 1.0, 2.6])


def unnamed(model: str) -> Motion:
    """A person of strong betas who turns half around; the file does not name the body model."""
    turns = np.linspace(0.0, np.pi, FRAMES) / 2.0
    return Motion(
        root_rotations=np.pi * np.column_stack([np.cos(turns), 0.0 * turns, np.sin(turns)]),
        root_translations=np.array([[0.0, 0.1, 3.5]] * FRAMES),
        joint_rotations=0.15
        * np.random.default_rng(3).normal(size=(1, 23, 3))
        * np.ones((6, 1, 1)),
        valid=np.ones(FRAMES, dtype=bool),
        betas=BETAS,
        body_model=model,
        model_is_stated=False,
    )


@pytest.fixture
def filmed(tmp_path):
    """Masks of the person of a motion; SMPL's betas are unknown here: the mean shape is filmed."""

    def make(motion: Motion) -> Path:
        shaped = shape_for_motion(load_body_model(), motion)
        skin = SkinPoints.of(shaped)
        for folder in ("images", "masks"):
            (tmp_path / folder).mkdir()
        for row in range(FRAMES):
            alpha = splat_silhouette(skin.posed(motion[row]), CAMERA)
            picture = (255.0 * np.asarray(alpha)).astype(np.uint8)
            Image.fromarray(picture).save(tmp_path / "masks" / f"{row}.png")
            Image.fromarray(picture).convert("RGB").save(tmp_path / "images" / f"{row}.png")
        return tmp_path

    return make


@pytest.mark.parametrize("truth", ["smpl", "body24"])
def test_masks_determine_an_unstated_body_model(filmed, truth):
    folder = filmed(unnamed(truth))
    source, masks = open_source(folder / "images"), open_masks(folder / "masks")
    found, _ = place_motion(
        unnamed("body24"),
        load_body_model(),
        CaptureEvidence(source, StoredMasks(masks, source), CAMERAS),
        cameras_given=True,
    )
    assert found.body_model == truth
    assert (found.note is not None) == (truth == "smpl")
    if truth == "smpl":
        assert "taken for SMPL's" in found.note


@pytest.mark.parametrize("truth", ["smpl", "body24"])
def test_a_stated_model_stays_and_without_masks_images_decide(filmed, truth):
    folder = filmed(unnamed(truth))
    source, masks = open_source(folder / "images"), open_masks(folder / "masks")
    stated = replace(unnamed("body24"), model_is_stated=True)
    body = load_body_model()
    assert (
        place_motion(
            stated,
            body,
            CaptureEvidence(source, StoredMasks(masks, source), CAMERAS),
            cameras_given=True,
        )[0]
        is stated
    )
    read = unnamed("body24")
    found, shaped = place_motion(
        read, body, CaptureEvidence(source, None, CAMERAS), cameras_given=True
    )
    assert found.body_model == truth
    assert (found is read) == (truth == "body24")
    assert np.array_equal(shaped.joints, shape_for_motion(body, found).joints)
