"""Tests for key frames: the sharpest of each stretch, with the person left out."""

import cv2
import numpy as np
import pytest

from capture.input_error import InputError
from capture.source_opening import open_source
from preprocess.sfm.colmap_mapping import dilate_person, select_keyframes, write_keyframes

COUNT, SHARP = 36, (1, 5, 6, 11, 13, 17, 18, 22, 25, 29, 32, 35)


def no_person(frame, size_px):
    return np.zeros(size_px[::-1], dtype=bool)


@pytest.fixture
def film(tmp_path, rng):
    """Noise, blurred in all frames but every third, which are all over the place."""
    folder = tmp_path / "film"
    folder.mkdir()
    for index in range(COUNT):
        picture = rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        if index not in SHARP:
            picture = cv2.GaussianBlur(picture, None, 2.0)
        cv2.imwrite(str(folder / f"{index:03d}.png"), picture)
    return open_source(folder)


def test_the_sharpest_frame_of_each_stretch_is_chosen(film):
    told = []
    keys = list(select_keyframes(film, no_person, told.append, 12))
    assert tuple(key.index for key in keys) == SHARP
    assert told[-1] == 1.0
    assert told == sorted(told)


def test_only_wanted_frames_are_chosen(film):
    part = open_source(film.path, frames=slice(6, 30, 2))
    chosen = select_keyframes(part, no_person, lambda share: None, 60)
    assert {key.index for key in chosen} == set(range(6, 30, 2))


def test_frames_without_a_known_person_are_skipped(film):
    def sometimes(frame, size_px):
        return None if frame.index in (5, 6) else no_person(frame, size_px)

    chosen = [key.index for key in select_keyframes(film, sometimes, lambda share: None, 12)]
    assert not {5, 6} & set(chosen)
    assert len(chosen) == 12


def test_the_person_is_left_out_with_a_margin():
    person = np.zeros((200, 300), dtype=bool)
    person[50:150, 100:140] = True
    around = dilate_person(person)
    rows, columns = np.nonzero(around)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (46, 153, 96, 143)


def test_colmap_does_not_look_at_the_person(film, tmp_path):
    def left_half(frame, size_px):
        person = no_person(frame, size_px)
        person[:, : size_px[0] // 2] = True
        return person

    chosen = select_keyframes(film, left_half, lambda share: None, 12)
    assert len(write_keyframes(chosen, tmp_path / "images", tmp_path / "masks")) == 12
    mask = cv2.imread(str(tmp_path / "masks" / "000001.png.png"), cv2.IMREAD_GRAYSCALE)
    assert not mask[:, :32].any()  # it looks where a mask is not 0
    assert (mask[:, 40:] == 255).all()


def test_too_few_key_frames_are_refused(film, tmp_path):
    chosen = select_keyframes(film, no_person, lambda share: None, 5)
    with pytest.raises(InputError, match="Only 5 frames"):
        write_keyframes(chosen, tmp_path / "images", tmp_path / "masks")
