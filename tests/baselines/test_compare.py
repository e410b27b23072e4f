"""python -m baselines.compare: a small comparison from the command line, and its table."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from baselines import compare, comparison_scores
from baselines.comparison_table import comparison_table, time_to_reach, with_better_poses
from baselines.systems import compared_capture
from preprocess.body.parametric_body import load_body_model
from studio.shoot import ShootConfig, film_capture


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A tiny sample, and what two methods make of it in a few steps."""
    folder = tmp_path_factory.mktemp("compared")
    film_capture(folder / "sample", ShootConfig(size=32, frames=11))
    words = [str(folder / "sample"), "--steps", "6", "--out", str(folder / "out")]
    with pytest.MonkeyPatch.context() as quick:
        quick.setattr(comparison_scores, "RENDERINGS", 2)
        quick.setattr(comparison_scores, "CURVE_RENDERINGS", 1)
        assert compare.main([*words, "--methods", "anim-nerf", "ours"]) == 0
    return folder, words


def test_it_writes_scores_table_and_pictures(compared):
    out = compared[0] / "out"
    results = json.loads((out / "comparison.json").read_text())
    assert [each["method"] for each in results] == ["anim-nerf", "ours"]
    for each in results:
        assert each["steps"] == 6
        assert [point["steps"] for point in each["curve"]] == [1, 3, 6]
        assert each["made_on"]["commit"]
        assert each["made_on"]["processor"]
        assert each["poses"] == "exact"
        assert math.isfinite(each["held_out"]["psnr"])
        for kind in ("novel", "novel_fitted"):
            assert len(each[kind]["frames"]) == 12
            pictures = {path.name for path in (out / each["method"] / kind).glob("*.png")}
            assert pictures == {f"{index:04d}.png" for index in range(12)}
    assert (out / "pictures.png").stat().st_size > 0
    assert "| ours |" in (out / "table.md").read_text()


def test_what_is_done_is_not_trained_again(compared, monkeypatch):
    def fail(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(compare, "_train_method", fail)
    assert compare.main([*compared[1], "--methods", "ours"]) == 0


def test_overwrite_trains_again(compared, monkeypatch):
    trained = []
    monkeypatch.setattr(compare, "_train_method", lambda name, *_: trained.append(name))
    monkeypatch.setattr(compare, "_write_sheet", lambda *_: None)
    assert compare.main([*compared[1], "--methods", "ours", "ours", "--overwrite"]) == 0
    assert trained == ["ours"]


def test_what_another_commit_trained_is_trained_again_only_if_asked(compared, monkeypatch):
    trained, scores = [], compared[0] / "out" / "ours" / "scores.json"
    before = scores.read_text()
    kept = json.loads(before)
    scores.write_text(json.dumps({**kept, "made_on": {**kept["made_on"], "commit": "0000000"}}))
    monkeypatch.setattr(compare, "_train_method", lambda name, *_: trained.append(name))
    for flags in ([], ["--redo-older"]):
        assert compare.main([*compared[1], "--methods", "anim-nerf", "ours", *flags]) == 0
    scores.write_text(before)
    assert trained == ["ours"]


def test_other_conditions_are_refused(compared, capsys):
    _, words = compared
    words = [*words, "--methods", "ours", "--seed", "1"]
    assert compare.main(words) == 2
    assert "seed 0, now 1" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "does not exist"),
        ([".", "--seconds", "0"], "must be positive"),
        ([".", "--steps", "0"], "at least 1"),
        ([".", "--out", "."], "holds files of others"),
    ],
)
def test_bad_input_is_one_sentence(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.txt").write_text("kept")
    assert compare.main(words) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert (tmp_path / "mine.txt").read_text() == "kept"


def curve(*values):
    return [{"core_seconds": 10.0 * 2**i, "novel": value} for i, value in enumerate(values)]


@pytest.mark.parametrize(
    ("values", "wanted", "text"),
    [
        ((20.0, 22.0, 24.0), 22.0, "20 s"),
        ((20.0, 22.0, 24.0), 28.0, "3 min (extrapolated)"),
        ((20.0, 22.0, 22.0), 28.0, "not reached, and the curve is flat"),
        ((20.0, 22.0, 22.2), 34.0, "not reached"),
    ],
)
def test_missing_time_is_extrapolated_by_the_last_doubling(values, wanted, text):
    assert time_to_reach(curve(*values), "novel", wanted) == text


def test_a_capture_without_novel_poses_has_a_table():
    frame = {"psnr": 30.0, "psnr_mask": 22.0, "ssim": 0.98}
    scores = {**frame, "frames": [frame]}
    none = {**dict.fromkeys(frame), "frames": []}
    result = {
        "method": "ours", "core_seconds": 60.0, "steps": 100, "conditions": {"steps": None},
        "held_out": scores, "held_out_fitted": scores, "novel": none, "novel_fitted": none,
        "curve": [{"core_seconds": 60.0, "steps": 100, "held_out": np.nan, "novel": None}],
    }  # fmt: skip
    table = comparison_table([result])
    assert "| ours | 60 | 100 | 600 | - | - | - | - | 30.00 | 30.00 | 22.00 | 0.9800 |" in table
    assert "held-out frames in fitted poses, PSNR after" in table


def test_a_pose_that_was_better_before_it_was_fitted_stays():
    def scored(*values):
        return {"frames": [{"psnr": value, "psnr_mask": value, "ssim": value} for value in values]}

    result = {
        "novel": scored(40.0, 20.0), "novel_fitted": scored(38.0, 26.0),
        "held_out": scored(), "held_out_fitted": scored(),
    }  # fmt: skip
    assert with_better_poses(result)["novel_fitted"]["psnr"] == 33.0


def test_true_masks_are_never_refined(tmp_path, monkeypatch):
    asked = []
    (tmp_path / "truth" / "novel").mkdir(parents=True)

    def open_nothing(inputs, **_):
        asked.append(inputs)
        return SimpleNamespace(observations=list)

    monkeypatch.setattr(compared_capture, "open_capture", open_nothing)
    person = load_body_model().with_shape()
    assert compared_capture.novel_observations(tmp_path, person) == []
    assert not asked[0].refine_masks
