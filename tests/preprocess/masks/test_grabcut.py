"""Tests for masks estimated by GrabCut around the posed body."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from capture.camera import Camera
from capture.frame import Frame
from capture.input_error import InputError
from preprocess import plugins
from preprocess.body.body_pose import BodyPose
from preprocess.body.kinematics import rotation_matrices
from preprocess.body.silhouette import MeshSilhouette, signed_distance_px
from preprocess.masks.clothing_offset import FOOT_JOINTS, ClothedBody, ClothingOffset, solid_hair
from preprocess.masks.color_models import (
    FOREGROUND_MIN_DIFFERENCE,
    MAX_LIGHT_GAIN,
    MIN_BACKGROUND_SPREAD,
    MIN_LIGHT_GAIN,
    BackgroundModel,
)
from preprocess.masks.grabcut import GrabCutSegmenter, _ExpectedShape, _Segmentation
from preprocess.masks.mask_origin import make_segmenter, segmenter_name

SIZE = (160, 200)


@pytest.fixture
def camera() -> Camera:
    """2.8 m before a standing person."""
    upright = np.diag([1.0, -1.0, -1.0, 1.0])
    upright[:3, 3] = [0.0, 1.0, 2.8]
    matrix = np.array([[250.0, 0, 80], [0, 250, 100], [0, 0, 1]])
    return Camera.from_intrinsic(matrix, SIZE, upright)


def standing(shaped, yaw: float = 0.0) -> BodyPose:
    joints = np.zeros((23, 3))
    joints[[0, 1], 2] = 0.2, -0.2
    joints[[15, 16], 2] = -0.8, 0.8
    height = -shaped.vertices[:, 1].min()
    return BodyPose(
        root_rotation=np.array([0.0, yaw, 0.0]),
        root_translation=np.array([0.0, height, 0.0]),
        joint_rotations=joints,
    )


@pytest.fixture
def film(shaped, camera, rng):
    """A person in a blue suit, wider than the body, before a wall of many colors."""
    outline = MeshSilhouette(shaped)
    wall = cv2.resize(rng.integers(40, 220, (25, 20, 3), dtype=np.uint8), SIZE)
    wall[..., 2] //= 2
    cloth = rng.integers(0, 40, (*SIZE[::-1], 3), dtype=np.uint8) + np.uint8([20, 30, 190])

    def film(yaw: float, index: int = 0) -> tuple[Frame, BodyPose, np.ndarray]:
        pose = standing(shaped, yaw)
        body = outline.draw_pose(pose, camera).astype(np.uint8)
        true = cv2.dilate(body, np.ones((5, 5), np.uint8)) > 0
        rgb = np.where(true[..., None], cloth, wall).astype(np.uint8)
        noise = rng.normal(0.0, 3.0, rgb.shape)
        rgb = np.clip(rgb + noise, 0, 255).astype(np.uint8)
        return Frame(index=index, time_s=index / 30, rgb=rgb), pose, true

    return film


def agreement(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.minimum(a, b).sum() / np.maximum(a, b).sum())


def test_the_filled_mesh_covers_what_skin_points_cover(shaped, camera):
    pose = standing(shaped, 0.4)
    drawn = MeshSilhouette(shaped).draw_pose(pose, camera)
    at = np.floor(camera.project(shaped.with_pose(pose).vertices())).astype(int)
    assert drawn[at[:, 1], at[:, 0]].mean() > 0.99
    points = np.zeros(drawn.shape, np.uint8)
    points[at[:, 1], at[:, 0]] = 1
    closed = cv2.morphologyEx(points, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    assert agreement(drawn, closed) > 0.93  # skin between the points is covered, nothing else


def test_nothing_is_drawn_of_a_body_behind_the_camera(shaped, camera):
    away = np.eye(4)
    away[2, 3] = -5.0
    assert (
        not MeshSilhouette(shaped)
        .draw_pose(standing(shaped), replace(camera, camera_from_world=away))
        .any()
    )


def test_clothes_wider_than_the_body_are_segmented(shaped, camera, film):
    find = GrabCutSegmenter(shaped)
    frame, pose, true = film(0.0)
    body = MeshSilhouette(shaped).draw_pose(pose, camera)
    assert agreement(body, true) < 0.85
    assert agreement(find(frame, pose, camera), true) > 0.95
    assert find.mask_count == 1
    assert 0.6 < find.agreement < 0.95


def test_the_person_is_found_in_a_twentieth_of_the_light(shaped, camera, film, rng):
    find, found = GrabCutSegmenter(shaped), []
    for index in range(6):
        frame, pose, true = film(0.3 * index, index)
        noisy = frame.rgb / 20.0 + rng.normal(0.0, 1.5, frame.rgb.shape)
        dark = replace(frame, rgb=np.clip(noisy, 0, 255).astype(np.uint8))
        found.append(agreement(find(dark, pose, camera), true))
    assert min(found[2:]) > 0.9


def test_the_background_model_helps_where_poses_are_off(shaped, camera, film):
    def shifted(pose: BodyPose) -> BodyPose:
        return replace(pose, root_translation=pose.root_translation + np.array([0.03, 0.0, 0.0]))

    find = GrabCutSegmenter(shaped)
    for index, yaw in enumerate(np.linspace(0.0, 6.0, 10)):
        frame, pose, true = film(float(yaw), index)
        last = agreement(find(frame, shifted(pose), camera), true)
        alone = agreement(GrabCutSegmenter(shaped)(frame, shifted(pose), camera), true)
    assert last > 0.93
    assert last > alone - 0.01


def test_a_moving_camera_clears_the_background_model(camera, rng):
    behind, free = BackgroundModel(), np.ones(SIZE[::-1], dtype=bool)
    wall = rng.integers(0, 255, (*SIZE[::-1], 3), dtype=np.uint8)

    def remembers(now: Camera, picture: np.ndarray) -> bool:
        before = BackgroundModel()
        for _ in range(3):
            before.reset_if_moved(camera, wall, free)
            before.update(wall, free)
        before.reset_if_moved(now, picture, free)
        return before.is_initialized

    assert not behind.is_initialized
    noise = np.clip(wall + rng.normal(0.0, 3.0, wall.shape), 0, 255).astype(np.uint8)
    assert remembers(camera, noise)
    turned = camera.camera_from_world.copy()
    turned[:3] = rotation_matrices(np.array([0.0, 0.02, 0.0])) @ turned[:3]
    assert not remembers(replace(camera, camera_from_world=turned), wall)
    assert not remembers(camera, np.roll(wall, 4, axis=1))  # it moved although its pose did not


def test_the_background_model_finds_the_person(camera, rng):
    behind, free = BackgroundModel(), np.ones(SIZE[::-1], dtype=bool)
    wall = rng.integers(0, 255, (*SIZE[::-1], 3), dtype=np.uint8)
    for _ in range(3):
        behind.update(wall, free)
    person = np.zeros(SIZE[::-1], dtype=bool)
    person[50:90, 40:60] = True
    picture = np.where(person[..., None], np.uint8(255) - wall, wall)
    like, unlike = behind.classify(picture, free)
    assert like[~person].all()
    assert not unlike[~person].any()
    # no brightness of the wall, of all that are possible, comes near to these pixels
    brightness = np.linspace(MIN_LIGHT_GAIN, MAX_LIGHT_GAIN, 241)[:, None, None]
    off = picture[person] - brightness * wall[person]
    nearest = (off**2).sum(axis=-1).argmin(axis=0)
    off = np.abs(off).max(axis=-1)[nearest, np.arange(person.sum())]
    sure = np.abs(off - FOREGROUND_MIN_DIFFERENCE) > 1.0
    np.testing.assert_array_equal(unlike[person][sure], off[sure] > FOREGROUND_MIN_DIFFERENCE)
    assert 0.5 < unlike[person].mean() < 1.0


def test_a_shadow_is_not_person_but_a_red_sole_in_it_is(camera):
    behind, free = BackgroundModel(), np.ones(SIZE[::-1], dtype=bool)
    floor = np.broadcast_to(np.uint8([140, 105, 65]), (*SIZE[::-1], 3)).copy()
    for _ in range(3):
        behind.update(floor, free)
    picture = floor.copy()
    picture[100:] = floor[100:] * 0.6
    picture[120:124] = 0.6 * np.array([200.0, 70.0, 60.0])
    like, unlike = behind.classify(picture, free)
    assert like[:100].all()
    assert not like[100:].any()
    np.testing.assert_array_equal(np.flatnonzero(unlike.any(axis=1)), np.arange(120, 124))


def test_the_predicted_background_has_local_brightness_and_spread(camera, rng):
    """A noisy wall, seen with a shadow on it."""
    wall = rng.integers(60, 200, (*SIZE[::-1], 3)).astype(float)
    person = np.zeros(SIZE[::-1], dtype=bool)
    person[50:90, 40:60] = True
    behind, steady, pictures = BackgroundModel(), BackgroundModel(), []
    assert behind.predict(wall.astype(np.uint8), ~person) is None
    never = np.zeros_like(person)
    never[150:] = True
    for _ in range(12):
        pictures.append(np.clip(wall + rng.normal(0.0, 12.0, wall.shape), 0, 255).astype(np.uint8))
        behind.update(pictures[-1], ~never)
        steady.update(wall.astype(np.uint8), ~never)
    shadow = np.where(person[..., None], 255.0, 0.7 * wall).astype(np.uint8)
    shown = behind.predict(shadow, ~person)
    assert shown is not None
    assert np.isinf(shown[1][never]).all()
    expected = np.sqrt(np.var(pictures, axis=0).mean(axis=-1))
    np.testing.assert_allclose(
        shown[1][~never], np.maximum(expected, MIN_BACKGROUND_SPREAD)[~never], rtol=1e-3
    )
    rim = person & ~cv2.erode(person.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    np.testing.assert_allclose(shown[0][rim], 0.7 * np.mean(pictures, axis=0)[rim], rtol=0.03)
    sure = steady.predict(shadow, ~person)
    assert sure is not None
    assert (sure[1][~never] == MIN_BACKGROUND_SPREAD).all()


@pytest.mark.parametrize("thick_m", [pytest.param(0.0, marks=pytest.mark.slow), 0.04])
def test_clothing_offsets_are_learnt_from_masks(shaped, camera, thick_m):
    """Masks of a body that is thicker by `thick_m` all over; the person turns once."""
    large = camera.resize((480, 600))
    outline, shell = MeshSilhouette(shaped), ClothingOffset(shaped)
    for yaw in np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False):
        pose = standing(shaped, float(yaw))
        around = shell.clothe(pose, large)
        assert around is not None
        true = outline.draw_vertices(around.skin + thick_m * around.normals, large).astype(
            np.float32
        )
        expected = shell.draw(around, large)
        covered = cv2.resize(expected, large.size_px, interpolation=cv2.INTER_AREA) > 0.5
        away = signed_distance_px(covered)
        rgb = np.where(true[..., None] > 0.0, np.uint8(200), np.uint8(20))
        shell.update(around, large, np.repeat(rgb, 3, axis=2), true, away, (0.1, 0.1))
    around = shell.clothe(standing(shaped), large)
    assert around is not None
    assert around.known_fraction > 0.3
    height = shaped.vertices[:, 1]
    trunk = (height > -0.3) & (height < 0.2) & (np.abs(shaped.vertices[:, 0]) < 0.2)
    assert np.median(np.abs(around.offset_m[trunk] - thick_m)) < 0.004
    drawn = cv2.resize(shell.draw(around, large), large.size_px, interpolation=cv2.INTER_AREA)
    true = outline.draw_vertices(around.skin + thick_m * around.normals, large)
    assert agreement(drawn, true) > 0.96


def test_offsets_compensate_for_the_overshooting_outline(shaped, camera, rng):
    """Every other vertex, at random, is 4 mm thicker: the outline is theirs."""
    large, shell = camera.resize((480, 600)), ClothingOffset(shaped)
    around = shell.clothe(standing(shaped), large)
    assert around is not None
    head = around.skin[around.rim_vertices, 1] > 1.5

    def beyond(thickness: np.ndarray, known: float) -> np.ndarray:
        now = around._replace(offset_m=thickness, known_fraction=known)
        fine = shell.draw(now, large)
        covered = cv2.resize(fine, large.size_px, interpolation=cv2.INTER_AREA)
        return shell._overshoot_m(now, large, signed_distance_px(covered > 0.5))[head]

    even = np.full(len(shaped.vertices), 0.01)
    thicker = rng.random(len(even)) < 0.5
    rough, smooth = beyond(even + 0.004 * thicker, 1.0), beyond(even, 1.0)
    thick = thicker[around.rim_vertices][head]
    # those farther inside are hidden by other parts of the head, and say nothing
    low, high = (rough[(thick == which) & (rough != 0.0)] for which in (False, True))
    assert np.median(smooth[smooth != 0.0]) < 0.001
    assert 0.002 < np.median(low) < 0.004
    assert np.median(high) < 0.001
    np.testing.assert_allclose(beyond(even + 0.004 * thicker, 0.1), 0.25 * rough)


def test_a_border_at_the_bands_limit_hardly_counts(shaped, camera):
    """A mask that extends to the uncertain band's limit found no border there."""
    pose = standing(shaped)
    thickness = []
    for limit in (0.02, 0.2):
        shell = ClothingOffset(shaped)
        for _ in range(4):
            around = shell.clothe(pose, camera)
            assert around is not None
            leaked = MeshSilhouette(shaped).draw_vertices(
                around.skin + 0.03 * around.normals, camera
            )
            covered = cv2.resize(
                shell.draw(around, camera), camera.size_px, interpolation=cv2.INTER_AREA
            )
            rgb = np.repeat(leaked[..., None] * np.uint8(200), 3, axis=2)
            away = signed_distance_px(covered > 0.5)
            shell.update(around, camera, rgb, leaked.astype(np.float32), away, (limit, limit))
        thickness.append(float(np.median(shell._offsets_m()[0][around.rim_vertices])))
    assert thickness[0] < thickness[1] - 0.005


def test_soles_that_most_masks_miss_belong_to_the_shoe(shaped, camera):
    """Of five masks two reach 3 cm beyond the skin, the others end at it."""
    large, shell, pose = camera.resize((480, 600)), ClothingOffset(shaped), standing(shaped)
    for thick_m in (0.03, 0.0, 0.0, 0.03, 0.0) * 4:
        around = shell.clothe(pose, large)
        assert around is not None
        mask = MeshSilhouette(shaped).draw_vertices(around.skin + thick_m * around.normals, large)
        covered = cv2.resize(shell.draw(around, large), large.size_px, interpolation=cv2.INTER_AREA)
        rgb = np.repeat(mask[..., None] * np.uint8(200), 3, axis=2)
        shell.update(
            around,
            large,
            rgb,
            mask.astype(np.float32),
            signed_distance_px(covered > 0.5),
            (0.2, 0.2),
        )
    thickness, known = shell._offsets_m()
    feet, legs = np.isin(shell._limb, FOOT_JOINTS), np.isin(shell._limb, (1, 2, 4, 5))
    assert np.median(thickness[feet & (known == 1.0)]) > 0.02
    assert np.median(thickness[legs & (known == 1.0)]) < 0.01


def test_a_bun_is_wide_in_all_directions_and_a_leak_is_not():
    beyond = np.zeros((40, 60), dtype=bool)
    beyond[4:10, 30:36] = True  # 6 cm wide and high
    beyond[20:22, 30:50] = True  # a stripe 2 cm high
    expected = np.zeros_like(beyond)
    expected[3:11, 29:37] = True
    np.testing.assert_array_equal(solid_hair(beyond, 100.0), expected)


def test_masks_get_better_as_clothes_become_known(shaped, camera, film):
    find = GrabCutSegmenter(shaped)
    found = []
    for index, yaw in enumerate(np.linspace(0.0, 2.0 * np.pi, 16)):
        frame, pose, true = film(float(yaw), index)
        found.append(agreement(find(frame, pose, camera), true))
    assert np.mean(found[-6:]) > np.mean(found[:3])
    assert np.mean(found[-6:]) > 0.95


@pytest.mark.parametrize("off_m", [0.006, 0.02])
def test_far_from_the_shape_a_segmentation_leaked_if_poses_are_good(shaped, off_m):
    find, shape = GrabCutSegmenter(shaped), np.zeros((40, 60), dtype=bool)
    shape[:, :30] = True
    away = signed_distance_px(shape)
    around = ClothedBody(
        skin=np.zeros((0, 3)), normals=np.zeros((0, 3)), offset_m=np.zeros(0),
        rim_vertices=np.zeros(0, dtype=int), known_fraction=1.0, px_per_m=100.0,
    )  # fmt: skip
    covered = shape.astype(np.float32)
    find._shape_error_m = off_m
    cut = np.zeros_like(shape)
    cut[:20, :30] = True
    cut[20:, :34] = True  # four centimetres too far
    found_cut = _Segmentation(
        foreground=cut,
        signed_distance_px=signed_distance_px(cut),
        decided_by_background=0.0 * covered,
        band_m=(0.05, 0.05),
    )
    expected = _ExpectedShape(
        supersampled=covered,
        coverage=covered,
        signed_distance_px=away,
        hair_region=np.zeros_like(shape),
    )
    weight = find._shape_weight(found_cut, expected, around)
    hairy = find._shape_weight(
        found_cut, expected._replace(hair_region=~expected.hair_region), around
    )
    assert hairy[35, 31:35].max() <= weight[35, 31:35].min()  # a bun is no leak
    assert weight.min() >= 0.0
    assert weight.max() <= 1.0
    found, leaked = weight[5, 25:35].mean(), weight[35, 25:35].mean()
    if off_m < 0.01:
        assert leaked > 0.97
        assert found < 0.95
    else:
        assert abs(leaked - found) < 0.2
        assert leaked < 0.35


def test_a_protruding_bun_of_hair_is_segmented(shaped, camera, film):
    find = GrabCutSegmenter(shaped)
    for index, yaw in enumerate(np.linspace(0.0, 1.0, 4)):
        frame, pose, true = film(float(yaw), index)
        head = camera.project(shaped.with_pose(pose).joints()[[15]])[0].astype(int)
        top = int(np.flatnonzero(true[:, head[0]])[0])
        bun = np.zeros(true.shape, np.uint8)
        cv2.circle(bun, (int(head[0]), top), 5, 1, -1)
        rgb = np.where((bun > 0)[..., None], np.uint8([25, 35, 200]), frame.rgb)
        mask = find(replace(frame, rgb=rgb), pose, camera)
    assert mask[(bun > 0) & ~true].mean() > 0.8


def test_the_same_frames_give_the_same_masks(shaped, camera, film):
    frame, pose, _ = film(0.7)
    masks = [GrabCutSegmenter(shaped)(frame, pose, camera) for _ in range(2)]
    np.testing.assert_array_equal(*masks)


def test_large_images_are_segmented_small_and_upsampled(shaped, camera, film):
    frame, pose, true = film(0.3)
    large = replace(frame, rgb=cv2.resize(frame.rgb, (480, 600), interpolation=cv2.INTER_NEAREST))
    mask = GrabCutSegmenter(shaped)(large, pose, camera.resize((480, 600)))
    assert mask.shape == (600, 480)
    assert agreement(cv2.resize(mask, SIZE, interpolation=cv2.INTER_AREA), true) > 0.93


def test_a_person_outside_the_image_has_no_mask(shaped, camera, film):
    frame, pose, _ = film(0.0)
    aside = replace(pose, root_translation=pose.root_translation + np.array([9.0, 0.0, 0.0]))
    with pytest.raises(InputError, match="not in the image"):
        GrabCutSegmenter(shaped)(frame, aside, camera)


# --- segmenters of other packages ----------------------------------------------------------


def test_a_segmenter_is_named_by_its_prefix():
    assert segmenter_name("segmenter:grabcut") == "grabcut"
    assert segmenter_name("masks/") is None
    assert segmenter_name(None) is None


class Point:
    """An installed package's entry point."""

    def __init__(self, name, load):
        self.name, self.load = name, load


def test_another_packages_segmenter_is_made_for_the_body(monkeypatch, shaped):
    made = []

    def load():
        return lambda body: made.append(body) or (lambda frame, pose, camera: frame)

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Point("rembg", load)])
    assert make_segmenter("rembg", shaped)(1, None, None) == 1
    assert made == [shaped]
    with pytest.raises(InputError, match="installed are grabcut, rembg"):
        make_segmenter("sam", shaped)


def test_a_segmenter_that_cannot_be_loaded_is_named(monkeypatch, shaped):
    def load():
        raise ImportError("no module named rembg")

    monkeypatch.setattr(plugins, "entry_points", lambda group: [Point("rembg", load)])
    with pytest.raises(InputError, match=r"'rembg' could not be loaded: no module named rembg"):
        make_segmenter("rembg", shaped)
