"""Rare mistakes: named if possible, and never misnamed."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.source_opening import open_source
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
def test_a_cropped_video_is_detected_by_its_principal_point_and_corrected(
    capture, diagnosed, tmp_path
):
    cut = 18
    frames = list(open_source(capture / "video.mp4").frames())
    pictures = capture / "images"
    pictures.mkdir()
    for frame in frames:
        bgr = cv2.cvtColor(frame.rgb[:, cut:], cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(pictures / f"{frame.index:06d}.png"), bgr)
    (capture / "video.mp4").unlink()
    change_masks(capture, lambda _, mask: mask[:, cut:])
    with np.load(capture / "cameras.npz") as stored:
        np.savez(capture / "cameras.npz", **{**stored, "width": SIDE - cut})
    code, found = diagnosed("--fix", tmp_path / "mended")
    assert code == 0
    assert found["cause"] == "focal"
    assert found["iou"]["after_fix"] > 0.75 > 0.5 > found["iou"]["now"]
    with (
        np.load(tmp_path / "mended" / "cameras.npz") as mended,
        np.load(capture / "cameras.npz") as stored,
    ):
        moved = mended["intrinsic"] - stored["intrinsic"]
        assert moved[0, 2] == pytest.approx(-cut, abs=1.5)
        assert abs(moved[1, 2]) < 1.5


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


@pytest.mark.slow
def test_a_reversed_video_is_detected_and_corrected(capture, diagnosed, tmp_path):
    true = read_poses(capture / "poses.npz")
    back = true.select_rows(np.arange(FRAMES)[::-1], np.arange(FRAMES))
    write_motion(capture / "poses.npz", back)
    code, found = diagnosed("--fix", tmp_path / "mended")
    assert (code, found["cause"], len(found["corrections"])) == (0, "frame_rate", 1)
    assert found["iou"]["after_fix"] > found["iou"]["now"] + 0.1
    mended = read_poses(tmp_path / "mended" / "poses.npz")
    np.testing.assert_array_equal(mended.frames, np.arange(FRAMES))
    np.testing.assert_allclose(mended.joint_rotations, true.joint_rotations, atol=1e-9)
    np.testing.assert_allclose(mended.root_translations, true.root_translations, atol=1e-9)
