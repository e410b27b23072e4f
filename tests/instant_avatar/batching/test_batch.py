"""ia-batch as a command: its exit codes, and real captures learnt by Ray on this machine."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from instant_avatar import batch
from instant_avatar.cli import command_line
from tests.instant_avatar.batching.conftest import ended

ROOT = Path(batch.__file__).parents[1]
HOOK = """
import os, signal, sys

class BeforeIngest:
    def find_spec(self, name, path=None, target=None):
        if name == "instant_avatar.ingest":
            sys.meta_path.remove(self)
            import instant_avatar.batching.ingest_attempt as attempt
            ingest = attempt._ingest
            from instant_avatar.animation.driving_motion import demo_motion
            from avatar.training import held_out_pose_fitting
            from export.bake import bake_tables, fine_tuning
            demo_motion.__defaults__ = (6,)
            fine_tuning.ROUNDS = 1
            bake_tables.FINE_TUNING_PICTURES = 2
            bake_tables.VOXEL_FACTORS = (1.6, 1.6)
            fine_tuning.TRAINING_PX = fine_tuning.VALIDATION_PX = 128
            held_out_pose_fitting.CORRECTIONS_PER_FRAME = 4
            try:  # one of two processes that come here at once
                os.unlink(os.environ["KILL_ONCE"])
            except FileNotFoundError:
                return
            os.kill(os.getpid(), signal.SIGKILL)

if "KILL_ONCE" in os.environ and "default_worker.py" in " ".join(sys.orig_argv):
    sys.meta_path.insert(0, BeforeIngest())
"""
"""What a process of Ray does first: it shortens the end of training, and one kills itself."""


def records(out: Path) -> list[dict]:
    """The lines of a results file."""
    return [json.loads(line) for line in (out / "results.jsonl").read_text().splitlines()]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "o"], "No captures were named"),
        (["empty", "--out", "o"], "holds no capture"),
        (["films", "--out", "films/o"], "--out"),
        (["films", "--out", "o", "--cores", "0"], "--cores"),
        (["films", "--out", "o", "--", "--resume"], "--resume"),
        (["films", "--out", "o", "--", "--steps", "0"], "--steps"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_starts(
    tmp_path, monkeypatch, call, words, message
):
    (tmp_path / "films").mkdir()
    (tmp_path / "films" / "a.mp4").write_text("no video")
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    assert message in call(batch, *words).refusal()
    assert not (tmp_path / "o").exists()


def test_without_ray_it_says_what_to_install(monkeypatch, call):
    monkeypatch.setattr(command_line, "find_spec", lambda module: None if module == "ray" else True)
    assert "[learn,cluster]" in call(batch, "films", "--out", "o").refusal()


def test_where_ray_does_not_start_one_line_says_so(tmp_path, copies, monkeypatch, call):
    def init(**_):
        raise Exception("The current node timed out during startup.")

    copies(tmp_path / "films", ["a"])
    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=init, __spec__=True))
    refusal = call(batch, tmp_path / "films", "--out", tmp_path / "out").refusal()
    assert "Ray did not start on this machine (The current" in refusal


def test_a_broken_capture_costs_a_line_and_what_ended_is_not_learnt_again(
    tmp_path, copies, scripted, capsys
):
    copies(tmp_path / "films", ["bad", "a", "weak"])
    out = tmp_path / "out"
    words = [str(tmp_path / "films"), "--out", str(out)]
    assert batch.main(words) == 1
    assert scripted == ["a", "bad", "weak"]
    assert [r["exit_code"] for r in records(out)] == [0, 2, 1]
    assert "no <person>" in capsys.readouterr().err
    copies(tmp_path / "films", ["b"])  # the input grows
    assert batch.main(words) == 1
    assert scripted[3:] == ["b"]
    assert (out / "summary.html").read_text().count("turning.webp") == 2
    assert batch.main([*words, "--again"]) == 1
    assert scripted[4:] == ["bad", "weak"]
    assert batch.main([str(tmp_path / "films" / "a"), "--out", str(out)]) == 0


def test_ctrl_c_keeps_what_is_done(tmp_path, copies, scripted, monkeypatch):
    copies(tmp_path / "films", ["a", "b"])
    words = [str(tmp_path / "films"), "--out", str(tmp_path / "out")]

    def stop_after_one(captures, arguments):
        yield ended(captures[0])
        raise KeyboardInterrupt

    with monkeypatch.context() as context:
        context.setattr(batch, "run_attempts", stop_after_one)
        assert batch.main(words) == 130
    assert "not learnt yet" in (tmp_path / "out" / "summary.html").read_text()
    assert batch.main(words) == 0
    assert scripted == ["b"]


def run_batch(*words: object, **environment: str) -> subprocess.CompletedProcess:
    """Run ia-batch in a process of its own."""
    command = [sys.executable, "-m", "instant_avatar.batch", *map(str, words)]
    environment = {**os.environ, "RAY_worker_niceness": "0", **environment}
    return subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_ray_learns_captures_though_one_is_broken_and_a_process_is_killed(tmp_path, copies):
    copies(tmp_path / "films", ["a", "b", "bad"])
    (tmp_path / "hook").mkdir()
    (tmp_path / "hook" / "sitecustomize.py").write_text(HOOK, encoding="utf-8")
    (tmp_path / "kill").touch()
    path = os.pathsep.join([str(tmp_path / "hook"), str(ROOT)])
    words = [tmp_path / "films", "--out", tmp_path / "out", "--cores", "1", "--retries", "1"]
    first = run_batch(
        *words, "--", "--steps", "60", PYTHONPATH=path, KILL_ONCE=str(tmp_path / "kill")
    )
    assert first.returncode == 1, first.stderr
    assert not (tmp_path / "kill").exists()
    ends = {r["capture"]: r for r in records(tmp_path / "out")}
    assert {name: r["status"] for name, r in ends.items()} == {
        "a": "done", "b": "done", "bad": "refused",
    }  # fmt: skip
    assert ends["a"]["figures"]["steps"] == 60
    kept = {"avatar.iavatar", "ingest.log", "report.html", "report.json", "turning.webp"}
    for name in "ab":
        assert kept <= set(os.listdir(tmp_path / "out" / name))
    again = run_batch(*words, "--", "--steps", "60", PYTHONPATH=path)
    assert again.returncode == 1, again.stderr
    assert len(records(tmp_path / "out")) == 3


@pytest.mark.slow
def test_a_capture_that_fits_no_node_is_bad_input(tmp_path, copies):
    copies(tmp_path / "films", ["bad"])
    done = run_batch(tmp_path / "films", "--out", tmp_path / "out", "--memory", "100000")
    assert done.returncode == 2, done.stderr
    assert "--memory" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
