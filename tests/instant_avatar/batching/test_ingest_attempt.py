"""One attempt: its causes, its limit, and what is brought back."""

import time
from dataclasses import replace

import pytest

from capture.input_error import InputError
from instant_avatar import ingest
from instant_avatar.batching.batch_arguments import BatchArguments
from instant_avatar.batching.ingest_attempt import AttemptFailure, learn_capture
from instant_avatar.cli.command_line import CommandExit

ARGUMENTS = BatchArguments(captures=("films",), out="out", cores=1)


@pytest.fixture
def attempt(monkeypatch, named, tmp_path):
    """Makes an attempt with an ia-ingest that does what it is given."""
    for library in ("OMP", "NUMBA", "MKL"):
        monkeypatch.setenv(f"{library}_NUM_THREADS", "1")

    def make(work, **changes):
        monkeypatch.setattr(ingest, "ingest", work)
        capture = replace(named("a"), options=("--steps", "7"), paths={"--cameras": "static"})
        return learn_capture(capture, replace(ARGUMENTS, **changes), str(tmp_path))

    return make


def test_what_a_run_wrote_is_brought_back(attempt, tmp_path):
    def work(arguments, console):
        assert (arguments.steps, arguments.threads, arguments.cameras) == (7, 1, "static")
        console.info("trained")
        checkpoint = arguments.out / "checkpoint"
        checkpoint.mkdir(parents=True)
        (arguments.out / "avatar.iavatar").write_bytes(b"avatar")
        (checkpoint / "state.pt").write_bytes(b"state")
        return 0

    made = attempt(work)
    assert (made.record.status, made.record.cause) == ("done", "")
    assert made.files == {"ingest.log": b"trained\n", "avatar.iavatar": b"avatar"}
    assert made.record.peak_memory_mb > 20.0
    assert attempt(work, checkpoints=True).files["checkpoint/state.pt"] == b"state"
    assert list(tmp_path.iterdir()) == []


def test_the_cause_is_what_ia_ingest_raised(attempt):
    def refuse(arguments, console):
        raise InputError("no video")

    def fail(arguments, console):
        raise CommandExit("no usable avatar", 1)

    def break_down(arguments, console):
        raise KeyError("bug")

    refused = attempt(refuse).record
    assert (refused.status, refused.exit_code, refused.cause) == ("refused", 2, "no video")
    with pytest.raises(AttemptFailure, match="no usable avatar") as failed:
        attempt(fail)
    assert failed.value.attempt.record.exit_code == 1
    with pytest.raises(AttemptFailure, match="KeyError") as failed:
        attempt(break_down)
    assert b"Traceback" in failed.value.attempt.files["ingest.log"]


def test_an_attempt_that_hangs_costs_the_limit(attempt):
    with pytest.raises(AttemptFailure, match="--limit"):
        attempt(lambda arguments, console: time.sleep(600.0), limit=0.2)
