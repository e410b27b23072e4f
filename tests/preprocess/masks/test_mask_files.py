"""Tests for masks in every container and polarity."""

import pickle

import cv2
import numpy as np
import pytest
from PIL import Image

from capture.input_error import InputError
from capture.live_sources import silence_opencv
from preprocess.masks.mask_files import open_masks

SIZE = (30, 40)


def person(shift: int = 0) -> np.ndarray:
    """8-bit: a soft-edged rectangle of 20 % of the image, off its rim."""
    mask = np.zeros((40, 30), np.uint8)
    mask[8:32, 10 + shift : 20 + shift] = 255
    mask[8:32, 10 + shift] = 77
    return mask


@pytest.fixture
def write(tmp_path):
    def write(masks, name="masks", suffix=".png"):
        folder = tmp_path / name
        folder.mkdir()
        for index, mask in enumerate(masks):
            path = folder / f"{index}{suffix}"
            if suffix == ".npy":
                np.save(path, mask)
            else:
                Image.fromarray(mask).save(path)
        return folder

    return write


def test_alpha_is_the_value_over_255_and_never_thresholded(write):
    masks = open_masks(write([person(), person(3)]))
    np.testing.assert_array_equal(masks.alpha(1, SIZE), person(3).astype(np.float32) / 255)
    assert np.float32(77 / 255) in masks.alpha(0, SIZE)
    assert masks.count == 2
    assert masks.size_px == SIZE
    assert not masks.inverted


@pytest.mark.parametrize(
    "stored",
    [
        person() // 200,
        person() > 200,
        (person() > 200).astype(np.float32),
        ((person() > 200) * 255.0).astype(np.float64),
        (person() // 200).astype(np.int64) * 255,
    ],
    ids=["0 and 1", "bool", "float", "float to 255", "int to 255"],
)
def test_every_scale_of_a_hard_mask_gives_the_same_mask(write, stored):
    alpha = open_masks(write([stored], suffix=".npy")).alpha(0, SIZE)
    np.testing.assert_array_equal(alpha, (person() > 200).astype(np.float32))


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "LA", "1", "P", "I;16"])
def test_every_image_mode_gives_the_same_mask(tmp_path, mode):
    hard = np.where(person() > 200, 255, 0).astype(np.uint8)
    gray = Image.fromarray(hard)
    folder = tmp_path / "masks"
    folder.mkdir()
    if mode == "RGBA":
        picture = Image.fromarray(np.dstack([np.full((40, 30, 3), 9, np.uint8), hard]))
    elif mode == "P":
        picture = Image.fromarray(hard // 255)
        picture.putpalette([0, 0, 0, 128, 0, 0])
    elif mode == "I;16":
        picture = Image.fromarray(hard.astype(np.uint16) * 257)
    else:
        picture = gray.convert(mode)
    picture.save(folder / "0.png")
    np.testing.assert_allclose(open_masks(folder).alpha(0, SIZE), hard / 255.0)


def test_one_archive_or_array_is_read_like_a_folder(write, tmp_path):
    stack = np.stack([person(), person(4)])
    np.savez(tmp_path / "m.npz", masks=stack, note=np.zeros(3))
    np.save(tmp_path / "m.npy", stack)
    expected = open_masks(write(stack))
    for name in ("m.npz", "m.npy"):
        masks = open_masks(tmp_path / name)
        assert masks.count == 2
        sent = pickle.loads(pickle.dumps(masks))  # to another process
        np.testing.assert_array_equal(sent.alpha(1, SIZE), expected.alpha(1, SIZE))


def test_inverted_masks_are_detected_unless_stated(write):
    folder = write([255 - person(), 255 - person(2)])
    upright = person() / np.float32(255)
    found = open_masks(folder)
    assert found.inverted
    np.testing.assert_allclose(found.alpha(0, SIZE), upright, atol=1e-6)
    told = pickle.loads(pickle.dumps(open_masks(folder, invert=False)))
    np.testing.assert_allclose(told.alpha(0, SIZE), 1 - upright, atol=1e-6)
    assert open_masks(write([person()], "other"), invert=True).inverted


def test_an_empty_mask_among_others_does_not_decide(write):
    nothing = np.zeros((40, 30), np.uint8)
    assert not open_masks(write([nothing, person(), nothing])).inverted
    assert open_masks(write([255 - nothing, 255 - person()], "turned")).inverted


def test_a_person_who_fills_the_picture_is_no_background(write):
    near = np.zeros((40, 30), np.uint8)
    near[6:, 4:26] = 255
    assert not open_masks(write([near])).inverted


def test_gray_object_numbers_are_masks_and_dark_noise_is_not(write, rng):
    two = np.where(person() > 127, 2, 0).astype(np.uint8)
    two[:5, :5] = 1
    masks = open_masks(write([two, two], "numbers"))
    np.testing.assert_array_equal(masks.alpha(0, SIZE), (two > 0).astype(np.float32))
    noise = (rng.uniform(size=(40, 30)) < 0.005).astype(np.uint8) * 3
    dark = open_masks(write([noise, noise], "noise"), invert=False)
    assert dark.alpha(1, SIZE).max() < 0.02


def test_photographs_are_not_masks(write, rng):
    photographs = [rng.integers(0, 255, (40, 30), dtype=np.uint8) for _ in range(3)]
    for invert in (None, False):
        with pytest.raises(InputError, match="photographs"):
            open_masks(write(photographs, f"photographs {invert}"), invert=invert)
    soft = cv2.GaussianBlur(person(), (5, 5), 0)
    assert open_masks(write([soft], "soft")).count == 1


def test_masks_that_show_nothing_are_refused(write):
    with pytest.raises(InputError, match="masks"):
        open_masks(write([np.zeros((40, 30), np.uint8)] * 3))


def test_a_mask_of_another_shape_is_refused_and_of_another_size_scaled(write):
    masks = open_masks(write([person()]))
    with pytest.raises(InputError, match=r"30x40 px, its image 40x30"):
        masks.alpha(0, (40, 30))
    half = masks.alpha(0, (15, 20))
    by_hand = (person() / np.float32(255)).reshape(20, 2, 15, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(half, by_hand, atol=1e-6)
    assert masks.alpha(0, (60, 80)).shape == (80, 60)


@pytest.mark.parametrize(
    "name",
    ["masks.npz", "masks.npy", "masks.mp4", "masks.txt", "masks/0.png", "masks/0.npy",
     "masks/notes.txt"],
)  # fmt: skip
def test_what_holds_no_masks_is_refused(tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"junk")
    with pytest.raises(InputError, match=name.split("/")[0]):
        open_masks(tmp_path / name.split("/")[0])


def test_a_video_of_masks_is_read_in_any_order(tmp_path):
    silence_opencv()
    path = tmp_path / "masks.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (60, 80))
    large = [np.kron(person(i), np.ones((2, 2), np.uint8)) for i in range(12)]
    for mask in large:
        writer.write(np.dstack([mask] * 3))
    writer.release()
    masks = open_masks(path)
    assert masks.count == 12
    assert masks.size_px == (60, 80)
    for row in (0, 7, 3, 3, 11):
        alpha = masks.alpha(row, (60, 80))
        assert np.abs(alpha - large[row] / 255.0).mean() < 0.02
        assert alpha.min() == 0.0
        assert alpha.max() == 1.0


def test_arrays_that_are_not_masks_are_refused(tmp_path, write):
    np.savez(tmp_path / "m.npz", masks=np.zeros((3, 40)))
    with pytest.raises(InputError, match=r"m\.npz"):
        open_masks(tmp_path / "m.npz")
    with pytest.raises(InputError, match="NaN"):
        open_masks(write([np.full((40, 30), np.nan)], suffix=".npy"))
    with pytest.raises(InputError, match="nowhere"):
        open_masks(tmp_path / "nowhere")
