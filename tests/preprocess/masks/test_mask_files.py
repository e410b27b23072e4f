"""Tests for masks in every container and polarity."""

import json
import pickle

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from capture.image_folder import silence_opencv
from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.masks.encoded_masks import decode_rle
from preprocess.masks.mask_files import open_masks, open_tracker_masks

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
        np.testing.assert_array_equal(masks.alpha(1, SIZE), expected.alpha(1, SIZE))


def test_inverted_masks_are_detected_unless_stated(write):
    folder = write([255 - person(), 255 - person(2)])
    upright = person() / np.float32(255)
    found = open_masks(folder)
    assert found.inverted
    np.testing.assert_allclose(found.alpha(0, SIZE), upright, atol=1e-6)
    told = open_masks(folder, invert=False)
    np.testing.assert_allclose(told.alpha(0, SIZE), 1 - upright, atol=1e-6)
    assert open_masks(write([person()], "other"), invert=True).inverted


def test_an_empty_mask_among_others_does_not_decide(write):
    nothing = np.zeros((40, 30), np.uint8)
    assert not open_masks(write([nothing, person(), nothing])).inverted
    assert open_masks(write([255 - nothing, 255 - person()], "turned")).inverted


def test_masks_of_unclear_polarity_are_refused(write):
    framed = np.full((40, 30), 255, np.uint8)
    framed[2:-2, 2:-2] = 0
    with pytest.raises(InputError, match="--mask-invert"):
        open_masks(write([framed]))


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


def text_of(mask: np.ndarray) -> bytes:
    """COCO's text of a mask's run lengths, as its maskApi writes it."""
    flat = mask.T.ravel() > 0
    ends = np.flatnonzero(np.diff(np.concatenate([[False], flat]).astype(int))).tolist()
    lengths = np.diff([0, *ends, flat.size]).tolist()
    text = bytearray()
    for place, length in enumerate(lengths):
        value = length - lengths[place - 2] if place > 2 else length
        more = True
        while more:
            group, value = value & 0x1F, value >> 5
            more = value != (-1 if group & 0x10 else 0)
            text.append((group | 0x20 if more else group) + 48)
    return bytes(text)


def test_run_lengths_are_those_of_the_standards_own_example():
    """From the specification of COCO's maskApi: columns first, beginning with zeros."""
    assert decode_rle({"size": [3, 4], "counts": [1, 2, 5, 4]}).tolist() == [
        [0, 0, 0, 1], [1, 0, 0, 1], [1, 0, 1, 1]
    ]  # fmt: skip
    assert decode_rle({"size": [2, 2], "counts": "04"}).tolist() == [[1, 1], [1, 1]]


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_encoded_masks_of_any_shape_round_trip(height, width, seed):
    rng = np.random.default_rng(seed)
    mask = np.repeat(rng.random((height, width)) < rng.random(), rng.integers(1, 9), axis=0)
    code = {"size": list(mask.shape), "counts": text_of(mask)}
    np.testing.assert_array_equal(decode_rle(code), mask)


@pytest.mark.parametrize("container", ["list", "names", "coco", "npy", "several"])
def test_encoded_masks_are_read_from_every_container(tmp_path, container):
    hard = [(person(i) > 200).astype(np.uint8) for i in range(12)]
    codes = [{"size": [40, 30], "counts": text_of(mask).decode()} for mask in hard]
    names = [f"mask_{i}.png" for i in range(12)]
    path = tmp_path / ("masks.npy" if container == "npy" else "masks.json")
    if container == "npy":
        told = [{**code, "counts": code["counts"].encode()} for code in codes]
        np.save(path, np.array(told, dtype=object))
    elif container == "coco":
        images = [{"id": i + 100, "file_name": names[i]} for i in reversed(range(12))]
        listed = [
            {"image_id": i + 100, "segmentation": codes[i]} for i in (3, 1, 2, 0, *range(4, 12))
        ]
        path.write_text(json.dumps({"images": images, "annotations": listed}))
    elif container == "names":
        path.write_text(json.dumps(dict(sorted(zip(names, codes, strict=True)))))
    elif container == "several":
        empty = {"size": [40, 30], "counts": [1200]}
        path.write_text(json.dumps([[empty, code] if i else [] for i, code in enumerate(codes)]))
    else:
        path.write_text(json.dumps(codes))
    masks = open_masks(path)
    assert masks.count == 12
    for row in (11, 0, 5):
        expected = hard[row] if row or container != "several" else np.zeros((40, 30))
        np.testing.assert_array_equal(masks.alpha(row, SIZE), expected)


def tracks(count: int = 12) -> tuple[dict, list[np.ndarray]]:
    """PHALP's file: person 7 in all frames but two, 2 in half of them; and the masks of 7."""
    content, hard = {}, []
    for row in range(count):
        mask, other = ((person(row + shift) > 200).astype(np.uint8) for shift in (0, 5))
        codes = [{"size": [40, 30], "counts": text_of(each)} for each in (other, mask)]
        content[f"img/{row:06d}.jpg"] = {
            "time": row, "tid": [2, 7], "mask": codes,
            "tracked_time": [row % 2, 3 if row in (4, 5) else 0],
        }  # fmt: skip
        hard.append(np.zeros_like(mask) if row in (4, 5) else mask)
    return content, hard


def test_one_persons_masks_are_read_from_phalps_tracks(tmp_path):
    content, hard = tracks()
    path = tmp_path / "demo.pkl"
    path.write_bytes(pickle.dumps(content))
    masks = open_masks(path)
    assert masks.count == 12
    for row in range(12):
        np.testing.assert_array_equal(masks.alpha(row, SIZE), hard[row])
    second = open_masks(path, person="2").alpha(2, SIZE)
    np.testing.assert_array_equal(second, person(7) > 200)
    assert not open_masks(path, person="2").alpha(3, SIZE).any()
    with pytest.raises(InputError):
        open_masks(path, person="9")


def test_masks_beside_poses_are_taken_only_where_they_fit_the_video(tmp_path):
    content, hard = tracks()
    path = tmp_path / "demo.pkl"
    path.write_bytes(pickle.dumps(content))

    def film(frames: int = 12, size_px: tuple[int, int] = SIZE):
        folder = tmp_path / f"{frames}_{size_px[0]}"
        folder.mkdir(exist_ok=True)
        for row in range(frames):
            Image.new("RGB", size_px).save(folder / f"{row}.png")
        return open_source(folder)

    masks = open_tracker_masks(path, film())
    assert masks is not None
    np.testing.assert_array_equal(masks.alpha(3, SIZE), hard[3])
    assert open_tracker_masks(path, film(frames=13)) is None
    assert open_tracker_masks(path, film(size_px=(64, 64))) is None
    spoilt = {name: {**frame, "mask": [{"size": [40, 30], "counts": b"abc"}] * 2}
              for name, frame in content.items()}  # fmt: skip
    path.write_bytes(pickle.dumps(spoilt))
    assert open_tracker_masks(path, film()) is None


@pytest.mark.parametrize(
    "code",
    [
        {"size": [3, 4], "counts": [5]},
        {"size": [1 << 20, 1 << 20], "counts": [1 << 40]},
        {"size": [3, 4], "counts": "o" * 40},
        {"size": [3, 4], "counts": [-1, 13]},
    ],
)
def test_codes_that_do_not_fill_their_image_are_refused(tmp_path, code):
    path = tmp_path / "masks.json"
    path.write_text(json.dumps([code, code]))
    with pytest.raises(InputError, match="run-length code"):
        open_masks(path)


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
