"""Tests of `preprocess/tracking/blazepose_networks.py`: the square of a person, and detections."""

import hashlib

import numpy as np
import pytest

from dev.make_blazepose import NETWORKS, WEIGHTS, verified
from preprocess.tracking.blazepose_networks import (
    PersonDetection,
    PersonSquare,
    anchors,
    is_same_person,
    parts_of_frame,
    refine,
)
from preprocess.tracking.keypoints import CroppedMask

SIZE = 64
"""Width and height of the crops, pixels."""


def gaussian(width, height, x, y, deviation):
    """A bright spot whose middle is at (x, y); the first pixel's middle is at (0.5, 0.5)."""
    rows, columns = np.mgrid[:height, :width] + 0.5
    spot = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * deviation**2))
    return np.repeat(np.rint(255 * spot).astype(np.uint8)[..., None], 3, axis=2)


def centroid(gray):
    rows, columns = np.mgrid[: gray.shape[0], : gray.shape[1]] + 0.5
    gray = gray.astype(float)
    return np.array([(columns * gray).sum(), (rows * gray).sum()]) / gray.sum()


@pytest.mark.parametrize("side", [40.0, 64.0, 100.0, 150.0, 301.7])
@pytest.mark.parametrize("angle", [0.0, 0.4, -2.5])
def test_a_spot_in_a_crop_is_where_it_is_in_the_frame(side, angle):
    square = PersonSquare(x=203.3, y=151.8, side=side, angle=angle)
    spot = np.array([203.3 + 0.1 * side, 151.8 - 0.07 * side])
    crop = square.crop(gaussian(400, 300, *spot, deviation=side / 16), SIZE)
    there = square.image_from_crop(SIZE) @ [*centroid(crop[..., 0]), 1]
    # OpenCV moves pixels by whole 1/32 of a pixel.
    assert np.abs(there - spot).max() <= max(1, side / SIZE) / 64


def test_a_crop_of_whole_pixels_is_the_frame_itself():
    rgb = np.random.default_rng(0).integers(0, 256, (80, 90, 3), np.uint8)
    square = PersonSquare(x=44.0, y=40.0, side=float(SIZE))
    np.testing.assert_array_equal(square.crop(rgb, SIZE), rgb[8:72, 12:76])
    halved = PersonSquare(x=44.0, y=40.0, side=float(SIZE)).crop(rgb, SIZE // 2)
    expected = rgb[8:72, 12:76].reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
    assert np.abs(halved - expected).max() <= 1


def test_outside_the_frame_a_crop_is_black():
    rgb = np.full((80, 60, 3), 200, np.uint8)
    crop = PersonSquare.of_frame(rgb).crop(rgb, SIZE)
    assert (crop[:, 9:55] == 200).all()
    assert (crop[:, :7] == 0).all()
    assert (crop[:, 57:] == 0).all()
    assert (PersonSquare(x=500.0, y=0.0, side=50.0).crop(rgb, SIZE) == 0).all()


def test_the_square_stands_on_its_head_with_the_person():
    square = PersonSquare.around(np.array([50.0, 60.0]), np.array([50.0, 100.0]))
    assert (square.x, square.y, square.side) == (50.0, 60.0, 100.0)
    image_from_crop = square.image_from_crop(100)
    np.testing.assert_allclose(image_from_crop @ [50, 10, 1], [50, 100], atol=1e-9)  # head: up
    leaning = PersonSquare.around(np.array([0.0, 0.0]), np.array([10.0, -10.0]))
    np.testing.assert_allclose(leaning.rotation() @ [0, -1], np.sqrt(0.5) * np.array([1, -1]))


def test_a_mask_of_the_crop_lies_over_what_was_cropped():
    spot, frame_px = (120.4, 90.7), (240, 200)
    square = PersonSquare(x=118.0, y=95.0, side=130.0, angle=0.3)
    crop = square.crop(gaussian(*frame_px, *spot, deviation=9.0), SIZE)
    mask = CroppedMask(values=crop[..., 0], image_from_crop=square.image_from_crop(SIZE))
    np.testing.assert_allclose(centroid(mask.resample(frame_px, frame_px)), spot, atol=0.02)
    halved = mask.resample(frame_px, (120, 100))
    assert halved.shape == (100, 120)
    np.testing.assert_allclose(centroid(halved), np.array(spot) / 2, atol=0.02)
    assert mask.resample(frame_px, frame_px)[0, 0] == 0


def test_anchors_are_the_middles_of_their_cells():
    places = anchors(224)
    assert places.shape == (2254, 2)
    np.testing.assert_allclose(places[:3] * 224, [[4, 4], [4, 4], [12, 4]])
    np.testing.assert_allclose(places[1568] * 224, [8, 8])
    np.testing.assert_allclose(places[-1] * 224, [208, 208])


def test_a_flat_heat_map_leaves_a_point_where_it_is_and_a_peak_draws_it():
    heatmaps = np.full((2, 64, 64), -9.0, np.float32)
    heatmaps[1, 30:33, 20:23] = 9.0
    points = np.array([[81.0, 122.0], [81.0, 122.0]])
    refined = refine(points, heatmaps, 256)
    np.testing.assert_array_equal(refined[0], points[0])
    np.testing.assert_allclose(refined[1], [84, 124], atol=0.1)
    np.testing.assert_array_equal(refine(points - 300, heatmaps, 256), points - 300)


def test_the_parts_of_a_wide_frame_cover_it():
    wide = parts_of_frame(np.zeros((100, 260, 3), np.uint8))
    assert [part.x for part in wide] == [50.0, 130.0, 210.0]
    assert {(part.y, part.side) for part in wide} == {(50.0, 100.0)}
    tall = parts_of_frame(np.zeros((260, 100, 3), np.uint8))
    assert [part.y for part in tall] == [50.0, 130.0, 210.0]


def test_detections_of_one_head_are_one_person():
    def detection(x, head_x):
        box = np.array([head_x - 20.0, 0, head_x + 20, 40])
        return PersonDetection(square=PersonSquare(x=x, y=100.0, side=200.0), box=box, score=1.0)

    assert is_same_person(detection(100.0, 100.0), detection(110.0, 160.0))
    assert is_same_person(detection(100.0, 100.0), detection(160.0, 105.0))
    assert not is_same_person(detection(100.0, 100.0), detection(160.0, 160.0))


@pytest.mark.parametrize("name", ["blazepose_detector", "blazepose_landmarks_full"])
def test_the_networks_here_are_the_ones_that_the_script_makes(name):
    data = (WEIGHTS / f"{name}.onnx").read_bytes()
    assert hashlib.sha256(data).hexdigest() == NETWORKS[name].sha256


def test_other_data_are_refused():
    with pytest.raises(SystemExit, match="model: SHA-256 is"):
        verified(b"other", "0" * 64, "model")
