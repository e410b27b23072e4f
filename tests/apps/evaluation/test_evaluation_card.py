"""The evaluation card: the same scores as the table, under conditions that are stated."""

import csv
import json
import subprocess

import pytest

from apps import evaluate
from apps.cli import hardware
from apps.evaluation.frame_scoring import SHOWN_FRAMES
from apps.report.report_figures import CurvePoint, psnr_at
from tests.apps.conftest import Outcome
from tests.apps.report.test_report_page import Tags


@pytest.fixture
def call_evaluate(capsys):
    def call(*arguments):
        code = evaluate.main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Outcome(code=code, out=captured.out, err=captured.err)

    return call


def test_a_card_holds_conditions_scores_and_pictures(run, film, call_evaluate, tmp_path):
    card = tmp_path / "card"
    words = ("--no-fitted", "--background", "white", "black", "--dance", film / "poses.npz")
    ended = call_evaluate(run, *words, "--card", card)
    assert ended.code == 0, ended.err
    content = json.loads((card / "card.json").read_text())
    conditions, (avatar,) = content["conditions"], content["avatars"]
    assert conditions["background"] == "white and black"
    assert conditions["resolution"] == "64x64 px"
    assert "150 steps" in conditions[f"training of {run}"]
    assert "LPIPS" in conditions["LPIPS not measured"]
    with (card / "card.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["renderer"], row["background"]) for row in rows] == [
        (name, on) for name in ("renderer", "player hq", "player lite") for on in ("white", "black")
    ]
    for row, stated in zip(rows, avatar["rows"], strict=True):
        assert float(row["psnr_head"]) == pytest.approx(stated["psnr_head"], abs=1e-3)
        assert float(row["ssim_mask"]) < float(row["ssim"])
        assert row["lpips_vgg"] == ""
    text = (card / "card.md").read_text()
    assert ended.out in text
    for heading in ("Conditions", "Scores", "Image, box and mask", "Body parts", "Quality by time"):
        assert f"## {heading}" in text
    page = (card / "card.html").read_text()
    tags = Tags(page)
    scored = len(avatar["rows"][0]["frames"])
    assert len(tags.addresses) == 3 * min(scored, SHOWN_FRAMES) + 1  # and the dance
    assert all(address.startswith("data:image/webp;base64,") for address in tags.addresses)
    again = call_evaluate(run, "--no-fitted", "--no-player", "--card", card)
    assert again.code == 0  # a card of its own is replaced
    (card / "mine.txt").write_text("kept")
    refused = call_evaluate(run, "--card", card)
    assert refused.code == 2
    assert "mine.txt" in refused.complaint("ia-evaluate")


def test_a_dance_without_a_card_is_refused(run, film, call_evaluate):
    ended = call_evaluate(run, "--dance", film / "poses.npz")
    assert ended.code == 2
    assert "--card" in ended.complaint("ia-evaluate")


def test_quality_at_a_time_lies_between_the_points_of_the_curve():
    def point(wall, cpu, psnr, video=1):
        times = {"wall_seconds": wall, "cpu_seconds": cpu, "frames_seen": 1}
        return CurvePoint(**times, psnr=psnr, psnr_mask=20.0, video=video)

    def wall(curve, seconds):
        return psnr_at(curve, seconds, clock="wall_seconds", score="psnr")

    curve = [point(2.0, 4.0, 20.0), point(5.0, 9.0, None), point(10.0, 12.0, 28.0)]
    at = [wall(curve, seconds) for seconds in (1.0, 2.0, 6.0, 10.0, 11.0)]
    assert at == [None, 20.0, 24.0, 28.0, None]
    assert psnr_at(curve, 8.0, clock="cpu_seconds", score="psnr") == 24.0
    assert wall([*curve, point(12.0, 14.0, 30.0, video=2)], 6.0) is None
    assert wall([], 6.0) is None


def test_an_installation_within_another_checkout_has_no_commit(monkeypatch, tmp_path):
    subprocess.run(["git", "init", "-q", tmp_path], check=True)
    (tmp_path / "site-packages").mkdir()
    monkeypatch.setattr(hardware, "ROOT", tmp_path / "site-packages")
    assert hardware._commit() == "unknown"
