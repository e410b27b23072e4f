"""The whole walk, from a film to a run folder."""

import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.evaluation.coverage import SEEN_COMPLETELY
from avatar.training import checkpoint
from capture.atomic_files import LIST_NAME as LIST
from capture.atomic_files import write_text_atomically
from export.player import Player
from instant_avatar.report import report_writer
from instant_avatar.report.report_writer import diagnose_failure
from instant_avatar.run import final_scoring, snapshot_writer
from instant_avatar.run.run_folder import RunFolder
from instant_avatar.run.snapshot_writer import CheckpointWriter

FEW = ("--frames", "0:8", "--no-refine-poses")
"""Enough for everything that is not about how well something was learnt."""


@pytest.fixture(scope="module")
def report(run):
    return json.loads((run / "report.json").read_text())


def test_a_run_leaves_five_things(run):
    assert sorted(file.name for file in run.iterdir() if file.name != LIST) == [
        "avatar.iavatar",
        "checkpoint",
        "report.html",
        "report.json",
        "turning.webp",
    ]


def test_every_frame_is_accounted_for(report):
    frames = report["frames"]
    assert frames == {
        "read": 24, "used": 22, "held_out": 2, "dropped": [], "near_duplicates": 0,
        "not_replayed": 0,
    }  # fmt: skip
    assert report["held_out"]["frames"] == [9, 19]
    assert report["held_out"]["size"] == [64, 64]


def test_something_was_learnt(report):
    # an empty picture scores about 15 dB
    assert report["held_out"]["psnr"] > 25.0
    assert report["held_out"]["psnr_mask"] < report["held_out"]["psnr"]
    assert report["package"]["psnr_to_renderer"]["hq"] >= 30.0
    words = {report[key]["verdict"] for key in ("held_out", "held_out_refined")}
    assert words & {"sharp", "soft"}
    assert report["verdict"] == report["all_round"]["verdict"] != "failed"
    assert report["held_out"]["overlap"] > 0.8


@pytest.mark.slow
def test_a_result_that_is_no_avatar_is_called_that_and_kept(
    capture, call_ingest, without_baking, tmp_path, monkeypatch
):
    """The package and the report are there; the exit code is not 0."""
    monkeypatch.setattr(report_writer, "diagnose_failure", diagnose_failure)
    score = final_scoring.score_rendering

    def as_of_a_room(picture, held):
        return replace(score(picture, held), psnr=6.88, blur=math.inf, overlap=0.2)

    monkeypatch.setattr(final_scoring, "score_rendering", as_of_a_room)
    out = tmp_path / "run"
    outcome = call_ingest(capture, *FEW, "--out", out)
    assert outcome.code == 1
    assert "no usable avatar" in outcome.complaint()
    assert "6.88 dB (failed)" in outcome.complaint()
    assert "held-out PSNR 6.88 dB (failed)" in outcome.err
    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "failed"
    assert report["held_out"]["blur"] is None  # beyond the widest
    assert "no usable avatar" in (out / "report.html").read_text()
    assert (out / "avatar.iavatar").exists()
    assert (out / "checkpoint" / "state.pt").exists()


def test_the_clock_counts_training_alone(report):
    training = report["training"]
    assert training["steps"] == report["recipe"]["steps"]
    assert training["startup_seconds"] > 0.0
    assert training["rays"] == training["steps"] * report["recipe"]["rays"]
    expected = training["rays"] / training["wall_seconds"]
    assert training["rays_per_second"] == pytest.approx(expected, rel=1e-4)
    last = report["curve"][-1]
    assert last["wall_seconds"] == training["wall_seconds"]
    assert [frame for frame, _ in last["frames"]] == report["held_out"]["frames"]
    assert np.mean([psnr for _, psnr in last["frames"]]) == pytest.approx(last["psnr"], abs=1e-5)
    marks = [point["wall_seconds"] for point in report["curve"]]
    assert len(marks) == 2  # after 100 steps, and after the last
    assert 0.0 < marks[0] < marks[1]


def test_the_package_is_the_one_that_was_reported(run, report):
    assert (run / "avatar.iavatar").stat().st_size == report["package"]["bytes"]
    kept = Player.load(run / "avatar.iavatar").manifest.metrics
    assert kept["held_out"]["verdict"] == report["verdict"]
    assert kept["held_out"]["psnr"] == pytest.approx(report["held_out"]["psnr"], abs=1e-4)
    assert [frame for frame, _ in kept["held_out"]["frames"]] == report["held_out"]["frames"]
    assert kept["recipe"]["rays"] == report["recipe"]["rays"]


def test_package_and_page_say_what_the_avatar_was_made_with(run, report):
    licence = report["licence"]
    assert licence["commercial_use"] == "unknown"  # the poses' file says nothing of its origin
    assert {part["part"] for part in licence["parts"]} == {"poses", "body", "masks"}
    manifest = Player.load(run / "avatar.iavatar").manifest
    assert manifest.metrics["made_with"] == licence
    assert manifest.licence.endswith(licence["summary"])
    assert "Commercial use: unknown" in (run / "report.html").read_text()


def test_an_actor_who_turns_twice_is_seen_from_all_sides(report):
    coverage = report["coverage"]
    assert coverage["seen"] > 0.95
    assert coverage["well"] < coverage["seen"]
    assert coverage["advice"] == SEEN_COMPLETELY
    assert len(coverage["parts"]) == 14
    assert coverage["parts"]["torso"]["back"] > 0.95


@pytest.mark.slow
def test_a_clip_of_the_front_alone_asks_for_a_turn(capture, call_ingest, without_baking, tmp_path):
    out = tmp_path / "run"
    outcome = call_ingest(capture, "--out", out, "--frames", "0:3")
    assert "Turn until your back has been seen." in outcome.err
    first = json.loads((out / "report.json").read_text())["coverage"]
    assert first["parts"]["torso"]["back"] < 0.2
    assert "Turn until your back has been seen." in (out / "report.html").read_text()
    # what another clip shows is added to what this one did
    call_ingest(capture, "--out", out, "--frames", "8:14", "--resume", steps=15)
    second = json.loads((out / "report.json").read_text())["coverage"]
    assert second["parts"]["torso"]["back"] > 0.5
    assert second["parts"]["torso"]["front"] >= first["parts"]["torso"]["front"]


def test_the_page_needs_nothing_else(run):
    page = (run / "report.html").read_text()
    assert page.count("data:image/webp;base64,") == 5  # two pairs and the novel poses
    assert "://" not in page  # not "http": pictures are base64, in which it may stand by chance
    assert "<svg" in page


def test_a_run_goes_on_where_it_stopped_and_is_not_lost_by_accident(
    capture, call_ingest, without_baking, tmp_path, changed
):
    """Lost poses are left out and listed."""
    run, copy = RunFolder(path=tmp_path / "run"), tmp_path / "copy.json"
    run.start_run(resume=False)  # as of a run that was killed at its start
    with np.load(capture / "poses.npz") as archive:
        places = archive["transl"].copy()
    places[[3, 7]] = np.nan
    changed(capture / "poses.npz", transl=places)
    words = (capture, *FEW[:2], "--out", run.path)
    assert "No checkpoint" in call_ingest(*words, "--resume", "--json", copy).err
    assert {path.name for path in tmp_path.iterdir()} == {"capture", "run", "copy.json"}
    assert copy.read_text() == run.report_json.read_text()
    first = json.loads(copy.read_text())
    assert first["format"] == 1
    assert first["frames"]["dropped"] == [
        {"index": 3, "reason": "pose invalid"},
        {"index": 7, "reason": "pose invalid"},
    ]
    assert first["frames"]["read"] == 8
    assert "--overwrite" in call_ingest(*words).refusal()
    assert copy.read_text() == run.report_json.read_text()
    outcome = call_ingest(*words, "--resume", steps=15)
    second = json.loads(run.report_json.read_text())
    assert outcome.code == 0
    assert (first["training"]["steps"], second["training"]["steps"]) == (10, 15)
    assert second["training"]["wall_seconds"] > first["training"]["wall_seconds"]
    assert second["curve"][: len(first["curve"])] == first["curve"]
    assert second["frames"] == first["frames"]


def test_a_full_disk_keeps_the_checkpoint_before(
    capture, call_ingest, without_baking, tmp_path, monkeypatch
):
    monkeypatch.setattr(snapshot_writer, "CHECKPOINT_INTERVAL_S", 0.0)
    monkeypatch.setattr(snapshot_writer, "CHECKPOINT_COST_SHARE", 1e6)
    begin = CheckpointWriter.begin

    def written_at_once(writer, *args, **options):
        begin(writer, *args, **options)
        writer.settle()

    monkeypatch.setattr(CheckpointWriter, "begin", written_at_once)
    save, written = torch.save, []

    def full_after_one(state, file):
        if written:
            file.write(b"half of it")
            raise OSError(28, "No space left on device")
        written.append(save(state, file))

    monkeypatch.setattr(torch, "save", full_after_one)
    outcome = call_ingest(capture, *FEW[:2], "--out", tmp_path / "run")
    assert outcome.code == 3
    assert "--resume" in outcome.complaint()
    left = {file.name for file in (tmp_path / "run").rglob("*") if file.is_file()}
    assert left == {"person.npz", "state.pt", "fit.npz", LIST}
    trainer, _ = checkpoint.load(tmp_path / "run" / "checkpoint")
    assert trainer.steps == 1


@pytest.mark.parametrize(
    ("fits", "word", "left"),
    [(True, "can be played", {"avatar.iavatar", LIST}), (False, "Nothing was written", set())],
)
def test_a_disk_that_is_full_from_the_start_leaves_the_package_if_that_fits(
    film, call_ingest, without_baking, tmp_path, monkeypatch, fits, word, left
):
    """Of the older run, which is overwritten, nothing is left."""
    run = RunFolder(path=tmp_path / "run")
    run.start_run(resume=False)
    write_text_atomically(run.report_json, "{}")

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(torch, "save", full)
    if not fits:
        monkeypatch.setattr(snapshot_writer, "export_avatar", full)
    outcome = call_ingest(film, *FEW, "--out", run.path, "--overwrite")
    assert outcome.code == 3
    assert word in outcome.complaint()
    assert {file.name for file in run.path.rglob("*")} == left


@pytest.mark.slow
def test_ctrl_c_saves_what_was_learnt(film, tmp_path):
    command = [sys.executable, "-m", "instant_avatar.ingest", film, "--out", tmp_path / "run"]
    with subprocess.Popen(
        [*command, "--steps", "5000"], stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        said = ""
        while " dB" not in said:  # the first mark of the curve
            line = process.stderr.readline()
            assert line, said
            said += line
        os.kill(process.pid, signal.SIGINT)
        said += process.stderr.read()
        assert process.wait() == 130
    assert "Traceback" not in said
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert 100 <= report["training"]["steps"] < 5000
    assert len(report["held_out"]["frames"]) >= 1
    Player.load(tmp_path / "run" / "avatar.iavatar")
    assert (tmp_path / "run" / "checkpoint" / "state.pt").exists()
