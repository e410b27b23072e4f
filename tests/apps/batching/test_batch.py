"""ia-batch as a command: its exit codes, and real captures learnt on this machine."""

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest

from apps import batch
from apps.batching.ingest_attempt import ROOT


def records(out: Path) -> list[dict]:
    """The lines of a results file."""
    return [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]


def start(captures: Path, out: Path, *words: str) -> subprocess.Popen:
    """Start ia-batch in a process of its own."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-m", "apps.batch", str(captures), "--out", str(out), *words]
    return subprocess.Popen(
        command, env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.PIPE, text=True
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "o"], "No captures were named"),
        (["empty", "--out", "o"], "holds no capture"),
        (["films", "--out", "films/o"], "lies in an input"),
        (["films", "--out", "o", "--index", "2", "--of", "2"], "between 0 and 1"),
        (["films", "--out", "o", "--index", "1"], "belong together"),
        (["films", "--out", "o", "--cores", "0"], "--cores is 0"),
        (["films", "--out", "o", "--price", "x"], "--price is 'x'"),
        (["films", "--out", "o", "--", "--resume"], "--resume cannot be given"),
        (["films", "--out", "o", "--", "--steps", "0"], "--steps is 0"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_starts(
    tmp_path, monkeypatch, capsys, words, message
):
    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "a.mp4").write_text("no video")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    assert batch.main(words) == 2
    said = capsys.readouterr().err
    assert message in said
    assert "Traceback" not in said
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["a", "--ray"], ["a", "--ray", "local"]),
        (["--ray", "a", "--out", "o"], ["--ray", "local", "a", "--out", "o"]),
        (["--ray", "auto", "a"], ["--ray", "auto", "a"]),
        (["--ray", "10.0.0.1:6379", "a"], ["--ray", "10.0.0.1:6379", "a"]),
        (["--ray", "s3://bucket/a"], ["--ray", "local", "s3://bucket/a"]),
    ],
)
def test_the_address_of_a_cluster_may_be_left_out(words, expected):
    assert batch.fill_ray_address(words) == expected


def test_refused_captures_end_with_1_and_are_not_tried_again(tmp_path, copies, capsys):
    copies(tmp_path / "films", ["bad", "bad2"])
    out = tmp_path / "out"
    words = [str(tmp_path / "films"), "--out", str(out), "--price", "0.04 EUR"]
    assert batch.main(words) == 1
    assert [record["exit_code"] for record in records(out)] == [2, 2]
    assert "is no video that can be opened" in (out / "summary.html").read_text()
    assert "refused  bad: " in capsys.readouterr().err
    assert batch.main(words) == 1
    assert len(records(out)) == 2
    copies(tmp_path / "films", ["bad3"])  # the input grows
    assert batch.main(words) == 1
    assert [record["capture"] for record in records(out)[2:]] == ["bad3"]


def test_parts_and_their_merge(tmp_path, copies):
    copies(tmp_path / "films", ["bad", "bad2", "bad3"])
    out = tmp_path / "out"
    words = [str(tmp_path / "films"), "--out", str(out)]
    for index in "01":
        assert batch.main([*words, "--index", index, "--of", "2"]) == 1
    assert sorted(path.parent.name for path in out.glob("_parts/*/results.jsonl")) == [
        "0-of-2", "1-of-2",
    ]  # fmt: skip
    assert not (out / "summary.html").exists()
    assert batch.main([*words, "--merge"]) == 1
    assert Counter(record["part"] for record in records(out)) == {"0/2": 2, "1/2": 1}
    assert (out / "summary.html").exists()
    assert batch.main(words) == 1
    assert len(records(out)) == 3


@pytest.mark.parametrize("signals", [[signal.SIGTERM], [signal.SIGINT, signal.SIGINT]])
def test_sigterm_or_a_second_ctrl_c_ends_what_runs(tmp_path, copies, hooked, signals):
    copies(tmp_path / "films", ["hangs"])
    running = start(tmp_path / "films", tmp_path / "out", "--scratch", str(tmp_path / "work"))
    for _ in range(1200):
        logs = (tmp_path / "work").glob("*/ingest.log")
        if any("about to hang" in log.read_text() for log in logs):
            break
        assert running.poll() is None
        time.sleep(0.05)
    assert running.stderr is not None
    running.send_signal(signals[0])
    said = ""
    if signals[1:]:  # the first one waits for what runs
        while "Stopping; captures that run are finished first" not in said:
            said += running.stderr.readline()
        running.send_signal(signals[1])
    said += running.communicate(timeout=60)[1]
    assert running.returncode == 130
    assert "To go on: ia-batch" in said
    assert not (tmp_path / "out" / "results.jsonl").exists()
    assert not list((tmp_path / "work").glob("ia-batch-*"))


@pytest.mark.slow
def test_a_killed_batch_goes_on_where_it_ended(tmp_path, copies, hooked):
    copies(tmp_path / "films", ["a", "b", "c", "eats", "bad"])
    out = tmp_path / "out"
    words = ["--cores", "1", "--memory", "2", "--retries", "0"]
    words += ["--scratch", str(tmp_path / "work"), "--", "--steps", "60"]
    first = start(tmp_path / "films", out, *words)
    while first.poll() is None:
        time.sleep(0.2)
        if (out / "results.jsonl").exists() and any(r["status"] == "done" for r in records(out)):
            break
    first.kill()
    first.communicate()
    before = records(out)
    second = start(tmp_path / "films", out, *words)
    _, said = second.communicate(timeout=900)
    assert second.returncode == 1, said
    ended = {record["capture"]: record for record in records(out)}
    assert len(records(out)) == len(ended) == 5  # nothing was learnt twice
    assert records(out)[: len(before)] == before
    causes = {name: record["cause"] for name, record in ended.items()}
    assert causes["a"] == causes["b"] == causes["c"] == ""
    assert "2.0 GB were allowed" in causes["eats"]
    assert "no video" in causes["bad"]
    for name in "abc":
        assert {"avatar.iavatar", "report.html", "turning.webp"} <= set(os.listdir(out / name))
    assert not list((tmp_path / "work").glob("ia-batch-*"))
    assert "3 done" in said


def test_the_help_teaches(capsys):
    with pytest.raises(SystemExit):
        batch.main(["--help"])
    assert "ia-batch captures/ --out avatars" in capsys.readouterr().out
