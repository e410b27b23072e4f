"""Tests for masks of which some are missing: their names say whose they are, or nothing."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.source_opening import open_source
from preprocess.frame_association import associate_by_name


@pytest.fixture(scope="module")
def film(tmp_path_factory) -> Path:
    """Five frames."""
    path = tmp_path_factory.mktemp("film") / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (32, 24))
    for _ in range(5):
        writer.write(np.zeros((24, 32, 3), np.uint8))
    writer.release()
    return path


@pytest.mark.parametrize(
    ("names", "rows"),
    [
        (["m_0", "m_1", "m_3"], {0: 0, 1: 1, 3: 2}),  # from 0
        (["000001", "000004", "000005"], {0: 0, 3: 1, 4: 2}),  # from 1: the last is there
        (["a2_0000", "a2_0001", "a2_0004"], {0: 0, 1: 1, 4: 2}),
        (["m_0", "m_4"], None),  # most would have none
        (["m_0", "m_1", "m_2"], None),  # the first three, or a few chosen ones
        (["m_1", "m_2", "m_4"], None),  # from 0 or from 1
        (["m_0", "m_1", "m_5"], None),  # of a longer film
        (["m_0", "n_0", "m_3"], None),
        (["zero", "m_1", "m_3"], None),
    ],
)
def test_numbers_count_the_frames_of_a_film_of_five(names, rows, film):
    assert associate_by_name(names, open_source(film)) == rows


@pytest.mark.parametrize(
    ("names", "rows"),
    [
        (["shot_12", "shot_15"], {0: 0, 2: 1}),
        (["mask_13", "mask_15"], {1: 0, 2: 1}),
        (["mask_13", "mask_14"], None),  # there is no picture 14
        (["a", "b"], None),
    ],
)
def test_masks_of_pictures_belong_to_those_of_their_name_or_number(names, rows, tmp_path):
    for number in (12, 13, 15):
        cv2.imwrite(str(tmp_path / f"shot_{number}.png"), np.zeros((8, 8, 3), np.uint8))
    assert associate_by_name(names, open_source(tmp_path)) == rows
