"""Tests for poses on a body that is not their tracker's: with masks, alpha channels, live."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from capture.camera import Camera
from capture.source_opening import open_source
from preprocess.alignment.capture_alignment import BodyAlignment, align_body, align_to_person
from preprocess.alignment.capture_evidence import CaptureEvidence
from preprocess.alignment.mask_alignment import body_height_m, scale_to_height
from preprocess.body.body_pose import Motion
from preprocess.body.body_surface import SkinPoints, splat_silhouette
from preprocess.body.parametric_body import (
    BodyModel,
    ShapedBody,
    load_body_model,
    read_shaped_body,
    write_shaped_body,
)
from preprocess.body.proportion_space import shape_for_motion
from preprocess.cameras.camera_file import CameraTrack
from preprocess.masks.mask_files import open_masks
from preprocess.masks.mask_sources import AlphaChannelMasks, StoredMasks

SIZE = (96, 128)
FRAMES = 8
CAMERA = Camera(focal_px=(190.0, 190.0), center_px=(48.0, 64.0), size_px=SIZE,
                camera_from_world=np.eye(4))  # fmt: skip
CAMERAS = CameraTrack(cameras=(CAMERA,), source="test")


def motion_of(model: str, count: int = FRAMES) -> Motion:
    """A person who turns half round 3.5 m in front of the camera, in the camera's axes."""
    rng = np.random.default_rng(3)
    waves = np.sin(np.linspace(0.0, 3.0, count))[:, None, None]
    roots = [
        np.pi * np.array([np.cos(yaw / 2.0), 0.0, np.sin(yaw / 2.0)])
        for yaw in np.linspace(0.0, np.pi, count)
    ]
    return Motion(
        root_rotations=np.array(roots),
        root_translations=np.array([[0.0, 0.1, 3.5]] * count),
        joint_rotations=0.15 * rng.normal(size=(1, 23, 3)) + 0.1 * waves,
        valid=np.ones(count, dtype=bool),
        betas=np.zeros(10),
        body_model=model,
    )


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body_model()


@pytest.fixture(scope="module")
def strangers() -> Motion:
    """SMPL's poses, whose tracker assumes a smaller person who is nearer."""
    return motion_of("smpl")


@pytest.fixture(scope="module")
def own(body, strangers) -> ShapedBody:
    return shape_for_motion(body, strangers)


def film(folder, person: ShapedBody, motion: Motion):
    """Pictures with the person's silhouette as alpha channel, and the same as masks."""
    skin = SkinPoints.of(person)
    for name in ("images", "masks"):
        (folder / name).mkdir(parents=True)
    for row in range(len(motion)):
        seen = splat_silhouette(skin.posed(motion[row]), CAMERA)
        alpha = (255 * seen).astype(np.uint8)
        rgba = np.dstack([np.full((*alpha.shape, 3), 90 + row, np.uint8), alpha])
        Image.fromarray(rgba).save(folder / "images" / f"{row:02d}.png")
        Image.fromarray(alpha).save(folder / "masks" / f"{row:02d}.png")
    return open_source(folder / "images"), open_masks(folder / "masks")


def taller(person: ShapedBody, factor: float) -> ShapedBody:
    """The same person, taller about the pelvis, where the tracker has it."""
    pelvis = person.joints[0]
    return replace(
        person,
        vertices=pelvis + factor * (person.vertices - pelvis),
        joints=pelvis + factor * (person.joints - pelvis),
    )


def pixels_off(fit: BodyAlignment, person: ShapedBody, motion: Motion) -> float:
    """How far a joint lands from where the person has it, pixels of 2 cm."""
    return max(
        float(np.abs(
            CAMERA.project(fit.shaped.with_pose(fit.motion[row]).joints())
            - CAMERA.project(person.with_pose(motion[row]).joints())
        ).max())
        for row in range(len(motion))
    )  # fmt: skip


def test_an_alpha_channel_aligns_as_masks_do(tmp_path, own, strangers):
    person = taller(own, 1.1)
    source, masks = film(tmp_path, person, strangers)
    assert source.has_alpha
    by_alpha = align_body(
        strangers, own, CaptureEvidence(source, AlphaChannelMasks(source), CAMERAS)
    )
    by_masks = align_body(
        strangers, own, CaptureEvidence(source, StoredMasks(masks, source), CAMERAS)
    )
    assert by_alpha.placement is not None
    assert by_alpha.placement.distance_divisor == pytest.approx(1.1, rel=0.02)
    np.testing.assert_array_equal(
        by_alpha.motion.root_translations, by_masks.motion.root_translations
    )
    assert by_alpha.description == by_masks.description
    assert pixels_off(by_alpha, person, strangers) < 1.2


def test_without_masks_an_unfitted_body_is_reported(tmp_path, own, strangers):
    Image.new("RGB", SIZE).save(tmp_path / "0.png")
    fit = align_body(strangers, own, CaptureEvidence(open_source(tmp_path), None, CAMERAS))
    assert fit.motion is strangers
    assert "--masks" in fit.description
    assert "--body" in fit.description


def test_poses_of_the_bodys_own_model_stay(tmp_path, body):
    motion = motion_of("body24")
    source, masks = film(tmp_path, body.with_shape(), motion)
    fit = align_body(
        motion, body.with_shape(), CaptureEvidence(source, StoredMasks(masks, source), CAMERAS)
    )
    assert fit.motion is motion
    assert not fit.description


# --- a finished avatar's person ------------------------------------------------------------------


def betas_of(body: BodyModel, amount: float) -> np.ndarray:
    """Betas that make this body taller, or smaller."""
    heights = np.array([body_height_m(body.with_shape(row)) for row in np.eye(10)])
    chosen = int(np.argmax(np.abs(heights - body_height_m(body.with_shape()))))
    sign = np.sign(heights[chosen] - body_height_m(body.with_shape()))
    return amount * sign * np.eye(10)[chosen]


@pytest.mark.parametrize("amount", [-1.5, 1.5])
def test_an_added_clip_is_aligned_to_the_avatars_person(tmp_path, body, amount):
    """Its tracker assumed a larger person farther away, or a smaller one nearer."""
    person, other = body.with_shape(), body.with_shape(betas_of(body, amount))
    motion = motion_of("body24")
    source, masks = film(tmp_path, person, motion)
    ratio = body_height_m(other) / body_height_m(person)
    assert abs(ratio - 1.0) > 0.02
    pelves = person.joints[0] + motion.root_translations
    claimed = replace(motion, root_translations=ratio * pelves - other.joints[0])
    for given in (
        StoredMasks(masks, source),
        AlphaChannelMasks(source),
    ):  # pictures with alpha channels
        fit = align_to_person(claimed, other, person, CaptureEvidence(source, given, CAMERAS))
        assert fit.shaped is person
        assert f"{100 * body_height_m(other):.0f} cm" in fit.description
        assert f"{100 * body_height_m(person):.0f} cm" in fit.description
        assert pixels_off(fit, person, motion) < 1.2


def test_without_masks_an_added_clips_distances_follow_the_height(tmp_path, body):
    person, other = body.with_shape(), body.with_shape(betas_of(body, 2.0))
    motion = motion_of("body24")
    ratio = body_height_m(other) / body_height_m(person)
    pelves = person.joints[0] + motion.root_translations
    claimed = replace(motion, root_translations=ratio * pelves - other.joints[0])
    Image.new("RGB", SIZE).save(tmp_path / "0.png")
    fit = align_to_person(
        claimed, other, person, CaptureEvidence(open_source(tmp_path), None, CAMERAS)
    )
    np.testing.assert_allclose(fit.motion.root_translations, motion.root_translations, atol=1e-9)


def test_an_added_clip_of_smpls_fits_the_avatars_proportions(tmp_path, body, own, strangers):
    person = scale_to_height(body.with_shape(), 1.1 * body_height_m(body.with_shape()))
    source, masks = film(tmp_path, person, strangers)
    pelves = person.joints[0] + strangers.root_translations
    nearer = replace(strangers, root_translations=pelves / 1.12 - own.joints[0])
    fit = align_to_person(
        nearer, own, person, CaptureEvidence(source, StoredMasks(masks, source), CAMERAS)
    )
    assert fit.placement is not None
    assert fit.placement.distance_divisor == pytest.approx(1.0 / 1.12, rel=0.02)
    assert pixels_off(fit, person, strangers) < 1.2


def test_the_same_person_again_changes_nothing(tmp_path, body):
    motion = motion_of("body24")
    source, masks = film(tmp_path / "film", body.with_shape(), motion)
    write_shaped_body(tmp_path / "person.npz", body.with_shape())
    person = read_shaped_body(tmp_path / "person.npz", body)
    fit = align_to_person(
        motion,
        body.with_shape(),
        person,
        CaptureEvidence(source, StoredMasks(masks, source), CAMERAS),
    )
    assert fit.motion is motion
    assert not fit.description
