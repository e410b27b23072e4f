"""One attempt: its limits, its causes, and that nothing of it stays."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

from apps.batching.ingest_attempt import ROOT, ingest_words, run_attempt
from apps.batching.remote_files import work_folder
from apps.cli.hardware import tree_memory_mb
from capture.input_error import InputError


def wait_until(happened) -> None:
    """Wait for an event that must come; a minute is for machines that are busy."""
    for _ in range(1200):
        if happened():
            return
        time.sleep(0.05)
    pytest.fail("it did not happen")


def test_words_of_options():
    options = {"steps": 5, "refine_poses": False, "mask_invert": True, "frames": "0:10"}
    assert ingest_words(options) == [
        "--steps", "5", "--no-refine-poses", "--mask-invert", "--frames", "0:10",
    ]  # fmt: skip


def test_bad_input_ends_with_its_cause(job):
    lines = []
    outcome = run_attempt(job, lines.append)
    assert outcome.exit_code == 2
    assert "bad.mp4 is no video that can be opened" in outcome.cause
    assert set(outcome.files) == {"ingest.log"}
    assert outcome.core_s > 0.1
    assert outcome.peak_memory_mb > 20.0
    assert [path.name for path in Path(job.scratch).iterdir()] == ["in-use"]


def test_a_hung_process_costs_the_limit(job, hooked):
    outcome = run_attempt(replace(job, name="hangs", limit_s=1.0))
    assert outcome.exit_code is None
    assert outcome.cause == "took longer than 1 s (--limit)"
    assert b"about to hang" in outcome.files["ingest.log"]


def test_a_process_that_eats_memory_is_killed(job, hooked):
    outcome = run_attempt(replace(job, name="eats", limit_mb=300.0))
    assert outcome.exit_code is None
    assert "0.3 GB were allowed" in outcome.cause
    assert 300.0 < outcome.peak_memory_mb < 3000.0


def test_a_stopped_batch_kills_the_process(job, hooked):
    outcome = run_attempt(replace(job, name="hangs"), stopped=lambda: True)
    assert outcome.interrupted
    assert outcome.cause == "the batch was stopped"


@pytest.mark.skipif(sys.platform != "linux", reason="needs prctl")
def test_the_process_ends_with_the_one_that_supervises_it(job, hooked):
    code = (
        "import sys; from apps.batching.ingest_attempt import IngestJob, run_attempt\n"
        "run_attempt(IngestJob(name='hangs', video=sys.argv[1], options={}, scratch=sys.argv[2]))"
    )
    path = f"{ROOT}{os.pathsep}{os.environ['PYTHONPATH']}"
    watched = subprocess.Popen(
        [sys.executable, "-c", code, job.video, job.scratch], env={**os.environ, "PYTHONPATH": path}
    )

    def is_hanging() -> bool:
        assert watched.poll() is None
        logs = Path(job.scratch).glob("*/ingest.log")
        return any("about to hang" in log.read_text() for log in logs)

    wait_until(is_hanging)
    children = Path(f"/proc/{watched.pid}/task/{watched.pid}/children").read_text().split()
    os.kill(watched.pid, signal.SIGKILL)
    watched.wait()
    assert children
    wait_until(lambda: not any(Path(f"/proc/{child}/statm").exists() for child in children))
    assert len(list(Path(job.scratch).glob("ia-batch-*"))) == 1
    with work_folder(Path(job.scratch), 0, None, lambda: False):  # removes what was left
        assert len(list(Path(job.scratch).glob("ia-batch-*"))) == 1


def test_fetched_captures_stay_within_the_budget(tmp_path):
    with pytest.raises(InputError, match="--disk allows"):
        work_folder(tmp_path, 11, 10, lambda: False).__enter__()
    waited = []

    def stopped() -> bool:
        waited.append(True)
        return len(waited) > 1

    with (
        work_folder(tmp_path, 6, 10, lambda: False),
        work_folder(tmp_path, 4, 10, lambda: False),
        work_folder(tmp_path, 1, 10, stopped),
    ):
        assert len(waited) == 2  # it waited once
    with work_folder(tmp_path, 10, 10, lambda: False):
        pass


def test_the_memory_of_a_tree_counts_its_children():
    child = subprocess.Popen(
        [sys.executable, "-c", "x = b'x' * 100_000_000; print(flush=True); input()"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert child.stdout is not None
    child.stdout.readline()
    own = tree_memory_mb(os.getpid())
    assert tree_memory_mb(child.pid) > 100.0
    child.communicate(b"\n")
    assert own - tree_memory_mb(os.getpid()) > 90.0
    assert tree_memory_mb(child.pid) == 0.0
