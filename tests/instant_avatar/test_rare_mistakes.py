"""Rare mistakes: named if possible, and never misnamed."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_avatar import check
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.poses.pose_file import write_motion
from preprocess.poses.pose_format_registry import read_poses

SIDE, FRAMES = 96, 40


@pytest.fixture(scope="module")
def turning(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("turning") / "capture"
    film_capture(folder, ShootConfig(frames=FRAMES, size=SIDE, background="plain", turns=1.0))
    return folder


@pytest.fixture
def capture(turning, tmp_path) -> Path:
    shutil.copytree(turning, tmp_path / "capture")
    return tmp_path / "capture"


@pytest.fixture
def diagnosed(capture, tmp_path):
    """Runs ia-check on the capture: its exit code and its JSON."""

    def call(*arguments):
        found = tmp_path / "found.json"
        words = [str(capture), *map(str, arguments)]
        code = check.main(
            [*words, "--json", str(found), "--sheet", str(tmp_path / "sheet.png"), "--overwrite"]
        )
        return code, json.loads(found.read_text())

    return call


def masks_of(folder: Path) -> list[Path]:
    return sorted((folder / "masks").iterdir())


def change_masks(folder: Path, change) -> None:
    for row, path in enumerate(masks_of(folder)):
        cv2.imwrite(str(path), change(row, cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))


@pytest.mark.slow
def test_poses_of_another_person_from_the_middle_on_are_no_offset(capture, diagnosed):
    motion = read_poses(capture / "poses.npz")
    motion.root_translations[FRAMES // 2 :, 0] += 0.9
    write_motion(capture / "poses.npz", motion)
    code, found = diagnosed()
    assert any("(20)" in anomaly for anomaly in found["anomalies"])
    assert found["corrections"] == []
    assert code == 2


@pytest.mark.slow
def test_boxes_are_called_boxes_and_no_focal_length_is_fitted_to_them(capture, diagnosed):
    def boxed(_, mask):
        rows, columns = np.nonzero(mask > 127)
        mask[rows.min() : rows.max(), columns.min() : columns.max()] = 255
        return mask

    change_masks(capture, boxed)
    _, found = diagnosed()
    assert any("boxes" in anomaly for anomaly in found["anomalies"])
    assert found["corrections"] == []
