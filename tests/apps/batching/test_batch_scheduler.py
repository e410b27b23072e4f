"""What is learnt, again or not at all, and what is recorded: with attempts that are scripted."""

import io
import threading
from collections.abc import Mapping

import pytest
from rich.console import Console as RichConsole

from apps.batching.batch_folder import BatchFolder
from apps.batching.batch_scheduler import (
    FIRST_NEED_MB,
    BatchLimits,
    BatchScheduler,
    LiveTable,
    plan_captures,
)
from apps.batching.executors import AttemptProgress
from apps.batching.ingest_attempt import AttemptOutcome, IngestJob
from apps.cli.command_line import CommandExit
from apps.cli.console import Console
from capture.input_error import InputError


class ScriptedExecutor:
    """Ends each attempt at once, with the next exit code of its capture; 0 after the last."""

    def __init__(self, codes: Mapping[str, list[int | None]] | None = None, room: int = 2) -> None:
        self.codes, self.room = dict(codes or {}), room
        self.started: list[IngestJob] = []
        self.running: list[IngestJob] = []
        self.killed = False

    def has_room(self, job: IngestJob) -> bool:
        return len(self.running) < self.room

    def start(self, job: IngestJob) -> None:
        self.started.append(job)
        self.running.append(job)

    def finished(self, timeout_s: float) -> list[tuple[IngestJob, AttemptOutcome]]:
        ended, self.running = self.running, []
        return [(job, self._outcome(job)) for job in ended]

    def _outcome(self, job: IngestJob) -> AttemptOutcome:
        left = self.codes.get(job.name, [])
        code = left.pop(0) if left else 0
        files = {"avatar.iavatar": job.name.encode()} if code == 0 else {"ingest.log": b"why"}
        return AttemptOutcome(
            exit_code=code, cause="" if code == 0 else "why", wall_s=3.0, core_s=2.0,
            peak_memory_mb=1000.0, machine={"used_cores": 2}, files=files,
            figures={"psnr": 30.0, "verdict": "sharp"}, interrupted=self.killed,
        )  # fmt: skip

    def progress(self) -> dict[str, AttemptProgress]:
        return {
            job.name: AttemptProgress(line="held-out PSNR 25.5 dB", host="", since=0.0)
            for job in self.running
        }

    def kill(self) -> None:
        self.killed = True

    def close(self) -> None:
        self.killed = True


@pytest.fixture
def learn(tmp_path):
    """Runs a batch with scripted attempts; returns states by name, the folder and the executor."""

    def run(captures, executor=None, *, stop=False, part=None, retries=1, again=False):
        executor = executor or ScriptedExecutor()
        job = IngestJob(name="", video="", options={}, cores=2)
        limits = BatchLimits(job=job, retries=retries, again=again)
        folder = BatchFolder(str(tmp_path / "out"), part)
        stopped = threading.Event()
        if stop:
            stopped.set()
        table = LiveTable(RichConsole(file=io.StringIO(), force_terminal=True))
        with folder.claim(Console()), table:
            states = plan_captures(captures, folder, limits)
            scheduler = BatchScheduler(states, folder, executor, limits, table)
            scheduler.run(stopped, threading.Event())
        states = {name: state.status for name, state in scheduler.states.items()}
        return states, folder, executor

    return run


def test_a_success_stands(learn, named, tmp_path):
    states, folder, _ = learn([named("a"), named("b")])
    assert states == {"a": "done", "b": "done"}
    assert (tmp_path / "out" / "a" / "avatar.iavatar").read_bytes() == b"a"
    assert [record.reserved_core_s for record in folder.records] == [6.0, 6.0]
    again, folder, second = learn([named("a"), named("b")])
    assert (again, second.started, len(folder.records)) == (states, [], 2)


def test_what_is_new_has_changed_or_is_missing_is_learnt(learn, named, tmp_path):
    learn([named("a"), named("b"), named("c")])
    (tmp_path / "out" / "b" / "avatar.iavatar").unlink()
    wanted = [named("a"), named("b"), named("c", options_key="more steps"), named("d")]
    states, _, executor = learn(wanted)
    assert {job.name for job in executor.started} == {"b", "c", "d"}
    assert set(states.values()) == {"done"}


def test_bad_input_is_tried_once_and_other_failures_as_often_as_asked(learn, named, tmp_path):
    codes = {"bad": [2, 0], "weak": [1, None, 0], "late": [3, 0]}
    captures = [named("bad"), named("weak"), named("late")]
    states, _, executor = learn(captures, ScriptedExecutor(codes))
    assert states == {"bad": "refused", "weak": "failed", "late": "done"}
    assert sorted(job.name for job in executor.started) == ["bad", "late", "late", "weak", "weak"]
    out = tmp_path / "out"
    assert sorted(path.name for path in (out / "_failed").iterdir()) == ["bad", "weak"]
    assert not (out / "bad").exists()
    states, _, second = learn(captures)
    assert second.started == []
    assert states == {"bad": "refused", "weak": "failed", "late": "done"}
    states, _, third = learn(captures, again=True)
    assert sorted(job.name for job in third.started) == ["bad", "weak"]
    assert set(states.values()) == {"done"}
    assert not list((out / "_failed").iterdir())


def test_more_retries_go_on_where_fewer_ended(learn, named):
    learn([named("a")], ScriptedExecutor({"a": [1, 1]}))
    states, folder, executor = learn([named("a")], ScriptedExecutor({"a": [1]}), retries=3)
    assert (states["a"], len(executor.started)) == ("done", 2)
    assert [record.attempt for record in folder.records] == [1, 2, 3, 4]


def test_an_interrupted_attempt_does_not_count(learn, named):
    executor = ScriptedExecutor({"a": [None]})
    executor.killed = True
    states, folder, _ = learn([named("a")], executor, retries=0)
    assert (states, folder.records) == ({"a": "waiting"}, [])
    assert learn([named("a")], retries=0)[0] == {"a": "done"}


def test_nothing_is_started_once_stopped(learn, named):
    states, _, executor = learn([named("a")], stop=True)
    assert (states, executor.started) == ({"a": "waiting"}, [])


def test_captures_ask_for_memory_as_measured(learn, named):
    _, _, first = learn([named("a"), named("b")], ScriptedExecutor(room=1))
    assert [job.memory_mb for job in first.started] == [FIRST_NEED_MB, pytest.approx(1150.0)]
    _, _, second = learn([named("c")])
    assert second.started[0].memory_mb == pytest.approx(1150.0)


def test_a_folder_of_others_is_refused_before_learning(learn, named, tmp_path):
    foreign = tmp_path / "out" / "a" / "thesis.txt"
    foreign.parent.mkdir(parents=True)
    foreign.write_text("mine")
    executor = ScriptedExecutor()
    with pytest.raises(InputError, match="holds thesis"):
        learn([named("a"), named("b")], executor)
    assert executor.started == []
    assert foreign.read_text() == "mine"


def test_parts_share_a_folder_and_are_merged(learn, named, tmp_path):
    captures = [named(name) for name in "abcd"]
    learn(captures[0::2], part=(0, 2))
    learn(captures[1::2], ScriptedExecutor({"b": [2]}), part=(1, 2))
    _, folder, executor = learn(captures)
    assert executor.started == []
    with folder.claim(Console()):
        folder.merge()
    lines = (tmp_path / "out" / "results.jsonl").read_text().splitlines()
    assert len(lines) == len(folder.records) == 4
    assert {record.part for record in folder.records} == {"0/2", "1/2"}


def test_two_batches_exclude_each_other_and_parts_do_not(tmp_path):
    def claim(part=None):
        return BatchFolder(str(tmp_path / "out"), part).claim(Console())

    with claim(), pytest.raises(CommandExit, match="Another command is writing"), claim():
        pass
    with claim(), pytest.raises(CommandExit, match="Another command"), claim((0, 2)):
        pass
    with claim((0, 2)), claim((1, 2)):
        with pytest.raises(CommandExit, match="Another command"), claim((1, 2)):
            pass
        with pytest.raises(CommandExit, match="Another command"), claim():
            pass
    with claim():
        pass


def test_a_line_that_was_cut_short_costs_only_itself(learn, named, tmp_path):
    learn([named("a")])
    results = tmp_path / "out" / "results.jsonl"
    results.write_text(results.read_text() + '{"capture": "b", "vi')
    _, folder, executor = learn([named("a"), named("b")])
    assert [job.name for job in executor.started] == ["b"]
    assert [record.capture for record in folder.records] == ["a", "b"]
    reread = BatchFolder(str(tmp_path / "out"))
    with reread.claim(Console()):
        assert [record.capture for record in reread.records] == ["a", "b"]


def test_nothing_is_left_of_a_batch_that_did_nothing(learn, tmp_path):
    learn([])
    assert not (tmp_path / "out").exists()
