"""Pictures of another system, scored like an avatar."""

import json

import cv2
import numpy as np
import pytest

from apps import evaluate
from avatar.evaluation.image_metrics import ground_truth_over
from preprocess.capture_session import CaptureInputs
from preprocess.open_capture import open_capture
from tests.apps.conftest import Outcome

FRAMES = "3:24:8"


@pytest.fixture(scope="module")
def truths(film):
    """The frames that are scored, by number."""
    inputs = CaptureInputs(video=film, frames=slice(3, 24, 8))
    return {seen.frame.index: seen for seen in open_capture(inputs).observations()}


@pytest.fixture
def theirs(tmp_path):
    (tmp_path / "theirs").mkdir()
    return tmp_path / "theirs"


@pytest.fixture
def score(film, theirs, tmp_path, capsys):
    """Runs ia-evaluate --pictures; returns how it ended, and the rows."""

    def call(*arguments):
        out = tmp_path / "scores.json"
        words = [
            "--pictures",
            theirs,
            "--on",
            film,
            "--frames",
            FRAMES,
            "--json",
            out,
            "--overwrite",
        ]
        code = evaluate.main([str(word) for word in (*words, *arguments)])
        said = capsys.readouterr()
        rows = json.loads(out.read_text())["avatars"][0]["rows"] if code == 0 else []
        return Outcome(code=code, out=said.out, err=said.err), rows

    return call


def write(path, picture):
    colors = np.clip(picture[..., :3] * 255.0, 0, 255).round().astype(np.uint8)[..., ::-1]
    if picture.shape[-1] == 4:
        alpha = (picture[..., 3:] * 255.0).round().astype(np.uint8)
        colors = np.concatenate([colors, alpha], axis=-1)
    assert cv2.imwrite(str(path), colors)


def spoiled(seen, gray, steps):
    """The truth with each pixel off by some steps of 255."""
    truth = np.round(255.0 * ground_truth_over(seen, gray))
    return (truth + np.where(truth > 127.0, -steps, steps)) / 255.0


def decibels(steps):
    return pytest.approx(-20.0 * np.log10(steps / 255.0), abs=0.1)


@pytest.mark.parametrize("name", ["frame_{index:04d}.png", "{row}.png"])
def test_pictures_are_found_by_number_or_else_by_order(truths, theirs, score, name):
    for row, (index, seen) in enumerate(truths.items()):
        write(theirs / name.format(index=index, row=row), spoiled(seen, 1.0, 5 * (row + 1)))
    ended, (row,) = score()
    assert ended.code == 0, ended.err
    assert [frame["frame"] for frame in row["frames"]] == [3, 11, 19]
    assert [frame["psnr"] for frame in row["frames"]] == [decibels(k) for k in (5, 10, 15)]
    assert (row["renderer"], row["poses"], row["cpu_ms"]) == ("pictures", "theirs", None)
    assert row["frames"][0]["overlap"] is None
    assert ("matched in order" in ended.err) == ("row" in name)


def test_frames_without_a_picture_are_named(truths, theirs, score):
    for index, seen in truths.items():
        if index != 11:
            write(theirs / f"{index}.png", spoiled(seen, 1.0, 20))
    ended, (row,) = score()
    assert [frame["frame"] for frame in row["frames"]] == [3, 19]
    assert "no picture of 1 frames, which are not scored: 11." in " ".join(ended.err.split())


def test_the_background_is_the_pictures_own_and_is_checked(truths, theirs, score):
    for index, seen in truths.items():
        write(theirs / f"{index}.png", spoiled(seen, 0.0, 20))
    refused, _ = score()
    assert refused.code == 2
    assert "--background black" in refused.complaint("ia-evaluate")
    both, _ = score("--background", "black", "white")
    assert "no alpha channel" in both.complaint("ia-evaluate")
    ended, (row,) = score("--background", "black")
    assert ended.code == 0, ended.err
    assert (row["background"], row["psnr"]) == ("black", decibels(20))


def test_with_an_alpha_channel_any_background_is_put_behind(truths, theirs, score):
    for index, seen in truths.items():
        picture = np.dstack([seen.frame.rgb / 255.0, 0.8 * seen.alpha])
        write(theirs / f"{index}.png", picture)
    ended, rows = score("--background", "white", "black")
    assert ended.code == 0, ended.err
    assert [row["background"] for row in rows] == ["white", "black"]
    assert rows[0]["psnr"] != rows[1]["psnr"]
    assert rows[0]["frames"][0]["overlap"] == pytest.approx(0.8, abs=0.01)


def test_pictures_of_another_size_are_refused_with_the_size_to_name(truths, theirs, score):
    for index in truths:
        write(theirs / f"{index}.png", np.ones((32, 32, 3)))
    ended, _ = score()
    assert ended.code == 2
    assert "32x32 px, its frame 64x64" in ended.complaint("ia-evaluate")
    assert "--size 32" in ended.err.replace("\n", " ")


def test_a_folder_for_other_frames_scores_nothing(theirs, score):
    write(theirs / "900.png", np.ones((64, 64, 3)))
    ended, _ = score()
    assert ended.code == 2
    assert "no picture of 3 frames" in ended.complaint("ia-evaluate")
