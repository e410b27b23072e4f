"""Corrections that are fitted to key points made from known cameras; masks that are sampled."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.camera import Camera
from capture.source import FrameSelection, FrameSource
from preprocess.alignment.capture_geometry import CaptureGeometry, VideoTransform
from preprocess.alignment.corrections import fit_to_keypoints
from preprocess.alignment.keypoint_objective import KeypointObjective, TrackedImage
from preprocess.alignment.silhouette_objective import sample_masks
from preprocess.body.body_surface import SkinPoints
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_sources import MaskSource
from tests.motions import make_motion, make_track

SIZE, FRAMES = (120, 160), 6


@pytest.fixture(scope="module")
def true() -> CaptureGeometry:
    """A person who walks and turns in front of a static camera."""
    rng, turns = np.random.default_rng(1), np.linspace(0.0, 2.0, FRAMES)
    motion = make_motion(
        np.pi * np.column_stack([np.cos(turns), 0.0 * turns, np.sin(turns)]),
        np.column_stack([turns - 1.0, 0.0 * turns + 0.3, 3.5 + 0.4 * turns]),
        0.3 * rng.normal(size=(FRAMES, 23, 3)),
    )
    return CaptureGeometry(
        motion=motion,
        row_frames=np.arange(FRAMES, dtype=np.float64),
        intrinsics=np.array([[[180.0, 0.0, 60.0], [0.0, 180.0, 80.0], [0.0, 0.0, 1.0]]]),
        extrinsics=np.eye(4)[None],
        size_px=SIZE,
    )


@pytest.fixture(scope="module")
def objective(true, shaped) -> KeypointObjective:
    """What a tracker without errors would find."""
    blank = TrackedImage(
        index=0, thumbnail=np.zeros((1, 1, 3), np.uint8), alpha=None, size_px=SIZE,
        image_px=np.zeros((33, 2)), confidence=np.ones(33),
    )  # fmt: skip
    images = tuple(replace(blank, index=row) for row in range(FRAMES))
    pixels = KeypointObjective(images=images, shaped=shaped).bodies(true).pixels
    found = [replace(each, image_px=px) for each, px in zip(images, pixels, strict=True)]
    return KeypointObjective(images=tuple(found), shaped=shaped)


def score(objective: KeypointObjective, geometry: CaptureGeometry) -> float:
    return float(objective.frame_scores(geometry).mean())


def fitted(objective: KeypointObjective, geometry: CaptureGeometry, cause: str):
    return next(c for c in fit_to_keypoints(geometry, objective) if c.cause == cause)


def test_the_true_geometry_scores_1_and_mirrored_or_turned_images_score_less(true, objective):
    assert score(objective, true) == pytest.approx(1.0)
    for turns, mirrored in ((0, True), (2, False), (2, True)):
        video = VideoTransform(quarter_turns=turns, mirrored=mirrored)
        assert score(objective, replace(true, video_transform=video)) < 0.5
    sideways = replace(true, video_transform=VideoTransform(quarter_turns=1))
    assert np.isnan(objective.frame_scores(sideways)).all()  # another shape


def test_a_frame_without_a_pose_has_no_score(true, objective):
    late = replace(true, row_frames=true.row_frames + 2)
    np.testing.assert_array_equal(np.isnan(objective.frame_scores(late)), np.arange(FRAMES) < 2)


def test_factors_are_found_in_closed_form(true, objective):
    focal, pelvis = true.intrinsics.copy(), objective.shaped.joints[0]
    focal[:, [0, 1], [0, 1]] *= 0.6
    wrong = replace(true, intrinsics=focal)
    assert fitted(objective, wrong, "focal").factor == pytest.approx(1 / 0.6)
    wide = true.intrinsics * np.array([[[0.75, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.0]]])
    wrong = replace(true, intrinsics=wide)
    assert fitted(objective, wrong, "aspect").factor == pytest.approx(1 / 0.75)
    moved = 0.7 * (true.motion.root_translations + pelvis) - pelvis
    wrong = replace(true, motion=replace(true.motion, root_translations=moved))
    scale = fitted(objective, wrong, "body_scale")
    assert scale.factor == pytest.approx(0.7)
    assert score(objective, scale.apply(wrong)) == pytest.approx(1.0)


def test_a_crop_of_the_video_is_its_window(true, objective):
    window = (0.1, 0.05, 0.9, 0.95)
    low, high = np.array(window[:2]) * SIZE, np.array(window[2:]) * SIZE
    images = tuple(
        replace(each, image_px=(each.image_px - low) / (high - low) * SIZE)
        for each in objective.images
    )
    cropped = replace(objective, images=images)
    crop = fitted(cropped, true, "video_crop")
    found = crop.apply(true)
    np.testing.assert_allclose(found.video_transform.window, window, atol=1e-9)
    assert score(cropped, found) == pytest.approx(1.0)
    assert score(cropped, found.in_video_frames(FRAMES)) == pytest.approx(1.0)


def test_a_principal_point_is_found(true, objective):
    shifted = true.intrinsics + np.array([[[0.0, 0.0, 9.0], [0.0, 0.0, -4.0], [0.0, 0.0, 0.0]]])
    wrong = replace(true, intrinsics=shifted)
    point = [c for c in fit_to_keypoints(wrong, objective) if c.cause == "focal"][-1]
    np.testing.assert_allclose(point.apply(wrong).intrinsics, true.intrinsics, atol=1e-6)


class MasksOfFive(MaskSource):
    """Masks of a file that breaks off after five frames."""

    def read(self, index, size_px):
        return np.full(size_px[::-1], float(index < 5), np.float32)


def test_sampled_masks_are_of_frames_with_key_points(shaped):
    source = FrameSource(Path("film.mp4"), FrameSelection())
    source.size_px, source.frame_count = SIZE, 600  # as its header claims
    camera = Camera.at(np.zeros(3), np.eye(3), 60.0, SIZE)
    sampled = sample_masks(
        source, MasksOfFive(), CameraTrack(cameras=(camera,), source=""), SkinPoints.of(shaped),
        count=60, track=make_track(np.arange(5), SIZE),
    )  # fmt: skip
    assert [each.index for each in sampled.samples] == [0, 1, 2, 3, 4]
