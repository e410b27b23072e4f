"""python -m baselines.compare: a small comparison from the command line, and its table."""

import json
import math

import numpy as np
import pytest

from avatar.training.pose_correction import interpolate_correction
from baselines import compare, comparison_scores
from baselines.systems.compared_capture import FIRST_NOVEL_FRAME, novel_observations
from instant_avatar.studio.shoot import ShootConfig, film_capture
from preprocess.body.parametric_body import load_body_model

METHODS = ("anim-nerf", "ours")


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A tiny sample, and what two methods make of it in a few steps."""
    folder = tmp_path_factory.mktemp("compared")
    film_capture(folder / "sample", ShootConfig(size=32, frames=11))
    words = [str(folder / "sample"), "--steps", "6", "--out", str(folder / "out")]
    with pytest.MonkeyPatch.context() as quick:
        quick.setattr(comparison_scores, "RENDERINGS", 2)
        quick.setattr(comparison_scores, "CURVE_RENDERINGS", 1)
        assert compare.main([*words, "--methods", *METHODS]) == 0
    return folder, words


pytestmark = pytest.mark.slow


def test_it_writes_scores_table_and_pictures(compared):
    out = compared[0] / "out"
    results = [json.loads((out / name / "scores.json").read_text()) for name in METHODS]
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
            assert pictures == {f"{FIRST_NOVEL_FRAME + index}.png" for index in range(12)}
    assert (out / "pictures.png").stat().st_size > 0
    assert "| ours |" in (out / "table.md").read_text()


def test_a_pose_never_filmed_starts_from_no_frames_correction(compared):
    person = load_body_model().with_shape()
    corrections = {frame: np.ones((25, 3)) for frame in range(11)}
    for seen in novel_observations(compared[0] / "sample", person):
        assert not interpolate_correction(seen.frame.index, corrections).any()


def test_what_is_done_is_not_trained_again(compared, monkeypatch):
    def fail(*_):
        raise AssertionError("trained again")

    monkeypatch.setattr(compare, "_train_method", fail)
    assert compare.main([*compared[1], "--methods", "ours"]) == 0
