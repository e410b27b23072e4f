"""Refined masks: finer than the network's; their borders, and the person's color there."""

import cv2
import numpy as np
import pytest

from preprocess.masks.mask_refinement import GivenMaskRefiner, MaskRefiner
from preprocess.masks.matting import border_distance_px, person_colors, refine_border
from preprocess.tracking.keypoints import CroppedMask

SIZE_PX = 160, 240
SQUARE_PX = 3.75
"""Frame pixels for each of 64 pixels of the network's square."""
COLOR = np.array([150.0, 60.0, 50.0])
"""The person's."""


def _background(seed: int) -> np.ndarray:
    """A wall of coarse and fine texture; a third of it has nearly the person's color."""
    generator = np.random.default_rng(seed)
    coarse = generator.uniform(70.0, 190.0, (12, 8, 3)).astype(np.float32)
    alike = generator.random((12, 8)) < 0.33
    coarse[alike] = COLOR + generator.normal(0.0, 25.0, (int(alike.sum()), 3))
    fine = generator.normal(0.0, 6.0, (SIZE_PX[1], SIZE_PX[0], 3)).astype(np.float32)
    return cv2.resize(coarse, SIZE_PX, interpolation=cv2.INTER_CUBIC) + fine


def _wall(*color: float) -> np.ndarray:
    return np.full((SIZE_PX[1], SIZE_PX[0], 3), color, np.float32)


def _person(shift_px: int) -> np.ndarray:
    """A trunk with a head, two legs and a thin arm held out."""
    shape = np.zeros(SIZE_PX[::-1], np.uint8)
    middle = 80 + shift_px
    cv2.ellipse(shape, (middle, 110), (22, 45), 0, 0, 360, 255, -1)
    cv2.circle(shape, (middle, 50), 16, 255, -1)
    for side in (-1, 1):
        cv2.line(shape, (middle + side * 11, 140), (middle + side * 16, 215), 255, 13)
    cv2.line(shape, (middle + 14, 80), (middle + 50, 125), 255, 5)
    return cv2.GaussianBlur(shape.astype(np.float32) / 255.0, (0, 0), 0.7)


def _frame(shift_px: int, background: np.ndarray) -> tuple[np.ndarray, CroppedMask, np.ndarray]:
    """A frame, what a coarse network says of it, and the exact mask."""
    truth = _person(shift_px)
    rows = np.arange(SIZE_PX[1])[:, None, None]
    color = COLOR + 25.0 * np.sin(rows / 4.0)
    rgb = truth[..., None] * color + (1.0 - truth[..., None]) * background
    rgb = rgb + np.random.default_rng(shift_px + 100).normal(0.0, 3.0, rgb.shape)
    square = np.zeros((240, 240), np.float32)
    square[:, 40:200] = cv2.GaussianBlur(truth, (0, 0), 4.0)
    values = cv2.resize(square, (64, 64), interpolation=cv2.INTER_AREA)
    mask = CroppedMask(
        values=np.round(255.0 * values).astype(np.uint8),
        image_from_crop=np.array([[SQUARE_PX, 0.0, -40.0], [0.0, SQUARE_PX, 0.0]]),
    )
    return np.clip(rgb, 0.0, 255.0).astype(np.uint8), mask, truth


def _iou(alpha: np.ndarray, truth: np.ndarray) -> float:
    found, true = alpha > 0.5, truth > 0.5
    return float((found & true).sum() / (found | true).sum())


def _refine_clip(backgrounds: list[np.ndarray]) -> tuple[float, float]:
    """IoU of the network's masks and of the refined ones over the later half of a clip."""
    refiner, soft, refined = MaskRefiner(SIZE_PX), [], []
    for number, background in enumerate(backgrounds):
        rgb, mask, truth = _frame((number % 8 - 4) * 5, background)
        soft.append(_iou(mask.resample(SIZE_PX, SIZE_PX), truth))
        refined.append(_iou(refiner(rgb, mask), truth))
    half = len(soft) // 2
    return float(np.mean(soft[half:])), float(np.mean(refined[half:]))


def test_what_a_static_camera_has_seen_decides_and_others_do_no_harm() -> None:
    """A background that is another in each frame, shakes, or is exposed otherwise by channel."""
    wall, shakes = _background(1), np.random.default_rng(0).integers(-6, 7, (16, 2))
    gains = 1.0 + 0.12 * np.sin(np.arange(16)[:, None] * np.array([0.7, 0.9, 1.1]))
    soft, static = _refine_clip([wall] * 16)
    _, moving = _refine_clip([_background(seed) for seed in range(16)])
    _, shaken = _refine_clip([np.roll(wall, tuple(shake), axis=(0, 1)) for shake in shakes])
    _, drifting = _refine_clip([wall * gain for gain in gains])
    assert static > moving + 0.005
    assert moving > soft + 0.005
    assert shaken > soft + 0.01
    assert drifting > static - 0.01


def test_shadow_of_the_person_stays_background() -> None:
    """Background that was seen before and is darker now is shaded, not person."""
    background = _wall(110.0, 140.0, 170.0)
    refiner = MaskRefiner(SIZE_PX)
    for shift_px in (-20, 20, -15, 15, -10, 10):
        refiner(*_frame(shift_px, background)[:2])
    shade = np.zeros(SIZE_PX[::-1], np.uint8)
    cv2.ellipse(shade, (112, 212), (14, 8), 0, 0, 360, 1, -1)
    rgb, mask, truth = _frame(0, background * (1.0 - 0.3 * shade[..., None]))
    found = refiner(rgb, mask)[(shade > 0) & (truth < 0.01)]
    assert (found > 0.5).mean() < 0.1


@pytest.mark.parametrize("size_px", [(80, 120), (160, 240), (240, 360)])
def test_any_size(size_px: tuple[int, int]) -> None:
    rgb, mask, truth = _frame(0, _background(1))
    alpha = MaskRefiner(SIZE_PX)(rgb, mask, size_px)
    assert alpha.shape == size_px[::-1]
    assert 0.0 <= alpha.min() < alpha.max() <= 1.0
    assert alpha.mean() == pytest.approx(truth.mean(), rel=0.03)


def test_large_frames_are_decided_at_a_smaller_size() -> None:
    """A frame of odd size is reduced by a whole number; the mask stays where the person is."""
    rgb, mask, truth = _frame(0, _background(1))
    size_px = SIZE_PX[0] * 3 + 1, SIZE_PX[1] * 3 + 1
    scale = np.array(size_px) / np.array(SIZE_PX)
    rgb = cv2.resize(rgb, size_px, interpolation=cv2.INTER_LINEAR)
    large = CroppedMask(values=mask.values, image_from_crop=mask.image_from_crop * scale[:, None])
    refined = MaskRefiner(size_px)(rgb, large)
    truth = cv2.resize(truth, size_px)
    assert _iou(refined, truth) > _iou(large.resample(size_px, size_px), truth) + 0.01


def test_frame_without_a_person_gives_an_empty_mask() -> None:
    rgb, mask, _ = _frame(0, _background(1))
    empty = CroppedMask(values=np.zeros_like(mask.values), image_from_crop=mask.image_from_crop)
    assert not MaskRefiner(SIZE_PX)(rgb, empty).any()


def test_things_of_the_persons_color_that_are_apart_stay_background() -> None:
    """A spot of the color of the trunk beside it, where the network saw no person, is cleared."""
    rgb, mask, truth = _frame(0, _wall(120.0))
    spot = np.s_[118:128, 45:51]
    rgb[spot] = rgb[105:115, 77:83]
    alpha = MaskRefiner(SIZE_PX)(rgb, mask)
    assert truth[spot].max() < 0.01
    assert alpha[spot].max() < 0.5
    assert _iou(alpha, truth) > 0.96


def test_stripes_of_the_walls_color_stay_person() -> None:
    """A shirt of red and white stripes before a wall that is nearly white."""
    wall = _wall(205.0)
    stripes = np.where(np.arange(SIZE_PX[1])[:, None, None] // 8 % 2, COLOR, [222.0, 220.0, 216.0])
    refiner, found = MaskRefiner(SIZE_PX), []
    for number in range(12):
        _, mask, truth = _frame((number % 8 - 4) * 5, wall)
        rgb = truth[..., None] * stripes + (1.0 - truth[..., None]) * wall
        rgb += np.random.default_rng(number).normal(0.0, 3.0, rgb.shape)
        found.append(_iou(refiner(np.clip(rgb, 0.0, 255.0).astype(np.uint8), mask), truth))
    assert np.mean(found[6:]) > 0.95


def test_border_before_a_known_background_is_exact_to_a_part_of_a_pixel() -> None:
    refiner, off = MaskRefiner(SIZE_PX), []
    wall = _wall(205.0)
    for number in range(12):
        rgb, mask, truth = _frame((number % 8 - 4) * 5, wall)
        off.append(
            float(np.abs(refiner(rgb, mask) - truth)[(truth > 0.02) & (truth < 0.98)].mean())
        )
    assert np.mean(off[6:]) < 0.147


def test_textured_background_that_the_network_takes_for_person_is_cleared() -> None:
    refiner, background = MaskRefiner(SIZE_PX), _background(1)
    for number in range(6):
        refiner(*_frame((number - 3) * 5, background)[:2])
    rgb, mask, truth = _frame(0, background)
    values = mask.values.copy()
    values[36:62, 42:54] = 255  # beside the left leg
    wrong = CroppedMask(values=values, image_from_crop=mask.image_from_crop)
    taken = (wrong.resample(SIZE_PX, SIZE_PX) > 0.9) & (truth < 0.01)
    assert taken.sum() > 300
    assert refiner(rgb, wrong)[taken].mean() < 0.1


def _given_masks(refiner: GivenMaskRefiner, *, wrong: bool) -> list[tuple[np.ndarray, ...]]:
    """Given, found and exact masks of a clip; wrong ones are wider and have a wandering border."""
    background, clip = _background(1), []
    for number in range(12):
        rgb, _, truth = _frame((number % 8 - 4) * 5, background)
        given = truth
        if wrong:
            noise = np.random.default_rng(number).normal(0.0, 1.0, truth.shape).astype(np.float32)
            given = cv2.GaussianBlur(truth, (0, 0), 2.0) + cv2.GaussianBlur(noise, (0, 0), 4.0)
            given = np.clip(2.0 * given - 0.25, 0.0, 1.0)
        clip.append((given, refiner(rgb, given, SIZE_PX), truth))
    return clip


def test_given_masks_are_refined_where_they_miss_the_edges() -> None:
    refiner = GivenMaskRefiner()
    clip = _given_masks(refiner, wrong=True)[6:]
    before = float(np.mean([_iou(given, truth) for given, _, truth in clip]))
    after = float(np.mean([_iou(found, truth) for _, found, truth in clip]))
    assert before < 0.95
    assert after > before + 0.04
    assert refiner.note is not None
    assert "--no-refine-masks" in refiner.note


def test_exact_masks_stay_as_they_are() -> None:
    refiner = GivenMaskRefiner()
    clip = _given_masks(refiner, wrong=False)
    assert all(found is given for given, found, _ in clip)
    assert refiner.keeps_given_masks
    assert refiner.note is None


def test_a_frame_without_the_person_is_no_evidence() -> None:
    refiner, empty = GivenMaskRefiner(), np.zeros(SIZE_PX[::-1], np.float32)
    assert refiner(np.zeros((*SIZE_PX[::-1], 3), np.uint8), empty, SIZE_PX) is empty
    assert not refiner.is_needed
    assert not refiner.keeps_given_masks


# --- borders --------------------------------------------------------------------------------------

WALL, SUIT = np.float32([205, 60, 190]), np.float32([30, 160, 40])


def disc(radius: float, size: int = 64, fine: int = 8) -> np.ndarray:
    """How much of each pixel a disc covers."""
    y, x = np.mgrid[0 : size * fine, 0 : size * fine] / fine
    inside = (np.hypot(x - 31.3, y - 33.7) < radius).astype(np.float32)
    return cv2.resize(inside, (size, size), interpolation=cv2.INTER_AREA)


def mix(person: np.ndarray, background: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    mixed = alpha[..., None] * person + (1.0 - alpha[..., None]) * background
    return np.rint(mixed).astype(np.uint8)


def constant(color: np.ndarray, spread: float, size: int = 64) -> tuple[np.ndarray, np.ndarray]:
    return (
        np.broadcast_to(color, (size, size, 3)).astype(np.float32),
        np.full((size, size), spread, np.float32),
    )


def test_a_border_half_a_pixel_off_comes_back(rng):
    """In either direction, before a wall of any known colors."""
    true = disc(20.2)
    wall = rng.integers(120, 250, (64, 64, 3)).astype(np.float32)
    picture = mix(SUIT, wall, true)
    for radius in (19.7, 20.7):
        given = disc(radius)
        found = refine_border(picture, given, (wall, constant(WALL, 5.0)[1]), constant(SUIT, 8.0))
        assert np.abs(found - true).sum() < 0.33 * np.abs(given - true).sum()
        far = np.abs(border_distance_px(given)) > 4.0
        np.testing.assert_array_equal(found[far], given[far])


def test_a_soft_border_stays_soft():
    """Of an enlarged or moving picture: what lies beside a sharp mask is a mixture, too."""
    true, given = cv2.GaussianBlur(disc(20.2), (0, 0), 1.5), disc(20.7)
    found = refine_border(mix(SUIT, WALL, true), given, constant(WALL, 5.0), constant(SUIT, 8.0))
    assert np.abs(found - true).sum() < 0.33 * np.abs(given - true).sum()


def test_nothing_changes_where_either_color_is_unknown():
    picture, given = mix(SUIT, WALL, disc(20.2)), disc(19.7)
    known, unknown = constant(WALL, 5.0), constant(SUIT, np.inf)
    np.testing.assert_array_equal(refine_border(picture, given, known, unknown), given)
    np.testing.assert_array_equal(refine_border(picture, given, unknown, known), given)


def test_the_mask_stays_where_person_and_wall_look_alike():
    """No displacement is likelier than another, so the area stays."""
    given = disc(20.2)
    found = refine_border(mix(SUIT, SUIT, given), given, constant(SUIT, 5.0), constant(SUIT, 5.0))
    assert abs(found.sum() - given.sum()) < 0.02 * given.sum()
    assert np.abs(found - given).max() < 0.5


def test_an_unexpected_foreground_color_is_still_person():
    """The expected color lies beyond the person's, so by both colors alone half is wall."""
    true, given = disc(20.2), disc(19.7)
    expected = WALL + 2.0 * (SUIT - WALL)
    picture, person = mix(SUIT, WALL, true), constant(expected, 8.0)
    found = refine_border(picture, given, constant(WALL, 5.0), person)
    assert found[true == 1.0].mean() > 0.96


def test_border_distance_has_sub_pixel_accuracy():
    y, x = np.mgrid[0:64, 0:64] + 0.5
    true = np.hypot(x - 31.3, y - 33.7) - 20.2
    near = np.abs(true) < 4.0
    off = np.abs(border_distance_px(disc(20.2)) - true)[near]
    assert off.mean() < 0.25
    assert off.max() < 0.8


@pytest.fixture
def alpha() -> np.ndarray:
    """A disc's mask with a border of two pixels."""
    rows, columns = np.mgrid[:41, :37]
    away = np.hypot(rows - 20.0, columns - 17.0)
    return np.clip((13.0 - away) / 2.0, 0.0, 1.0).astype(np.float32)


def test_a_border_pixel_has_the_persons_color_without_the_background(alpha):
    person, background = np.array([180.0, 30.0, 40.0]), np.array([240.0, 250.0, 235.0])
    rgb = mix(person, background, alpha)
    border = (alpha > 0.1) & (alpha < 1.0)
    stain = np.abs(rgb[border] - person).max(axis=1).mean()
    left = np.abs(person_colors(rgb, alpha)[border] - person).max(axis=1).mean()
    assert stain > 60.0
    assert left < 0.4 * stain


def test_stripes_and_a_background_of_two_colors_are_kept_apart(alpha):
    columns = np.arange(alpha.shape[1])
    stripes = np.where((columns // 5 % 2)[None, :, None] > 0, [30.0, 60.0, 200.0], 220.0)
    person = np.broadcast_to(stripes, (*alpha.shape, 3))
    background = np.where(np.arange(len(alpha))[:, None, None] < 20, [0.0, 160.0, 0.0], 90.0)
    rgb = mix(person, np.broadcast_to(background, person.shape), alpha)
    weight = alpha[..., None]
    stain = np.square(weight * (rgb - person)).mean()
    assert np.square(weight * (person_colors(rgb, alpha) - person)).mean() < 0.4 * stain


def test_a_hard_mask_leaves_the_image_as_it_is(alpha, rng):
    rgb = rng.integers(0, 256, (*alpha.shape, 3), dtype=np.uint8)
    np.testing.assert_array_equal(person_colors(rgb, (alpha > 0.5).astype(np.float32)), rgb)


def test_an_empty_mask_and_one_of_the_whole_image_are_no_error(rng):
    rgb = rng.integers(0, 256, (6, 9, 3), dtype=np.uint8)
    for value in (0.0, 0.5, 1.0):
        found = person_colors(rgb, np.full((6, 9), value, np.float32))
        assert np.isfinite(found).all()
