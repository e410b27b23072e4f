"""A batch's folder, its page, and what is learnt, again or not at all, by the results in it."""

import json
import time
import uuid
from dataclasses import replace
from pathlib import Path

import pytest

from capture.input_error import InputError
from instant_avatar import ingest
from instant_avatar.batching.batch_arguments import BatchArguments
from instant_avatar.batching.batch_folder import BatchFolder, summary_page
from instant_avatar.batching.capture_discovery import find_captures
from instant_avatar.batching.ingest_attempt import AttemptFailure, learn_capture
from instant_avatar.batching.remote_files import fetch_files, list_files, open_remote, read_text
from instant_avatar.cli.command_line import CommandExit
from instant_avatar.cli.console import Console
from instant_avatar.run.run_tracking import FORCE
from tests.instant_avatar.batching.conftest import ended, named


@pytest.fixture(params=["file", "memory"])
def out(request, tmp_path) -> str:
    """A folder, and a URL in the memory of this process."""
    return str(tmp_path / "out") if request.param == "file" else f"memory://{uuid.uuid4().hex}/out"


def send(url: str, files: dict[str, bytes]) -> None:
    with open_remote(url) as (system, path):
        for name, content in files.items():
            system.pipe_file(f"{path}/{name}", content)


def waiting(out: str, captures, *, again: bool = False) -> list[str]:
    """Names of the captures that a batch would learn."""
    folder = BatchFolder(out)
    with folder.claim(Console()):
        return [c.name for c in captures if folder.settled(c, again=again) is None]


def place(out: str, *attempts) -> None:
    folder = BatchFolder(out)
    with folder.claim(Console()):
        for attempt in attempts:
            folder.place_attempt(attempt)


def test_what_ended_stands_until_it_changes_or_its_package_is_gone(out):
    captures = [named("a"), named("bad"), named("weak")]
    assert waiting(out, captures) == ["a", "bad", "weak"]
    place(out, ended(captures[0]), ended(captures[1], 2), ended(captures[2], None))
    assert waiting(out, captures) == []
    assert waiting(out, captures, again=True) == ["bad", "weak"]
    assert waiting(out, [named("a", input_key="longer"), named("new")]) == ["a", "new"]
    assert waiting(out, [named("bad", options_key="more steps")]) == ["bad"]
    place(out, ended(named("a", options_key="more steps")))
    assert waiting(out, captures) == ["a"]  # its package is another one now
    place(out, ended(captures[0]))
    assert waiting(out, captures) == []
    if "://" in out:
        with open_remote(out) as (system, path):
            system.rm(f"{path}/a", recursive=True)
    else:
        (Path(out) / "a" / "avatar.iavatar").unlink()
    assert waiting(out, captures) == ["a"]


def test_a_line_per_capture_and_a_folder_for_each(out):
    place(out, ended(named("a"), 1), ended(named("b"), 2))
    place(out, ended(named("a"), 0))
    lines = [json.loads(line) for line in read_text(f"{out}/results.jsonl").splitlines()]
    assert [(r["capture"], r["status"], r["attempt"]) for r in lines] == [
        ("a", "failed", 1), ("b", "refused", 1), ("a", "done", 2),
    ]  # fmt: skip
    names = {path.removeprefix(out) for path in list_files(out)}
    assert {"/a/avatar.iavatar", "/_failed/b/ingest.log", "/results.jsonl"} <= names


def test_a_line_that_was_cut_short_is_dropped(tmp_path):
    place(str(tmp_path), ended(named("a")), ended(named("b")))
    results = tmp_path / "results.jsonl"
    results.write_text(results.read_text()[:-30])
    assert waiting(str(tmp_path), [named("a"), named("b")]) == ["b"]
    place(str(tmp_path), ended(named("b")))
    assert len(list(map(json.loads, results.read_text().splitlines()))) == 2


def test_files_of_others_stay(tmp_path):
    out = tmp_path / "out"
    place(str(out), ended(named("a")))
    (out / "b").mkdir()
    (out / "b" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"notes\.txt"):
        waiting(str(out), [named("b")])
    (out / "results.jsonl").write_text('{"mine": 1}\n')
    with pytest.raises(InputError, match=r"results\.jsonl"):
        waiting(str(out), [])
    assert (out / "results.jsonl").read_text() == '{"mine": 1}\n'


def test_one_batch_at_a_time(tmp_path):
    with (
        BatchFolder(str(tmp_path)).claim(Console()),
        pytest.raises(CommandExit),
        BatchFolder(str(tmp_path)).claim(Console()),
    ):
        pass


def test_captures_behind_a_url_are_found_and_fetched(tmp_path):
    bucket = f"memory://{uuid.uuid4().hex}"
    table = b"capture,poses\nmay/bob.mp4,may/anna/poses.npz\n"
    files = {"anna/images/0.png": b"film", "anna/poses.npz": b"poses", "bob.mp4": b"other"}
    send(f"{bucket}/may", files)
    send(bucket, {"list.csv": table})
    anna, bob = find_captures([f"{bucket}/may"])
    assert (anna.name, anna.video) == ("anna", f"{bucket}/may/anna")
    assert set(anna.sources) == {f"{bucket}/may/anna/{n}" for n in ("images/0.png", "poses.npz")}
    assert (bob.name, bob.sources) == ("bob", (f"{bucket}/may/bob.mp4",))
    (bob,) = find_captures([f"{bucket}/list.csv"])
    assert bob.paths == {"--poses": f"{bucket}/may/anna/poses.npz"}
    local = fetch_files([anna.video, *bob.places()], [*anna.sources, *bob.sources], tmp_path)
    assert Path(local[anna.video], "images", "0.png").read_bytes() == b"film"
    assert Path(local[bob.video]).read_bytes() == b"other"
    assert Path(local[bob.paths["--poses"]]).read_bytes() == b"poses"


def test_a_url_that_cannot_be_read_is_bad_input():
    with pytest.raises(InputError, match="nonsense"):
        list_files("nonsense://bucket/a")


@pytest.fixture
def results():
    """Two avatars, a refused capture, and one that waits."""
    ends = {"good": (0, 35.0), "blurred": (0, 25.0), "b<d": (2,)}
    made = {name: ended(named(name), *end).record for name, end in ends.items()}
    return {**made, "new": None}


def test_the_page_shows_avatars_and_causes_the_worst_first(results):
    page = summary_page(results, "avatars")
    names = ["b&lt;d", "new", "blurred", "good"]
    places = [page.index(f"<b>{name}</b>") for name in names]
    assert places == sorted(places)
    assert 'src="good/turning.webp"' in page
    assert 'href="_failed/b%3Cd/ingest.log"' in page
    assert "no &lt;person&gt;" in page
    assert "no <person>" not in page
    assert "--paper" in page  # the style of all pages


ARGUMENTS = BatchArguments(captures=("films",), out="out", cores=1)


@pytest.fixture
def attempt(monkeypatch, tmp_path):
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

    def refuse_poses(arguments, console):
        raise InputError(f"{arguments.out}/tracking/skeleton.mp4 shows it. Or {FORCE}.")

    def fail(arguments, console):
        raise CommandExit("no usable avatar", 1)

    def break_down(arguments, console):
        raise KeyError("bug")

    refused = attempt(refuse).record
    assert (refused.status, refused.exit_code, refused.cause) == ("refused", 2, "no video")
    refused = attempt(refuse_poses).record
    shown, advice = refused.cause.split(" shows it. Or ")
    assert shown == "tracking/skeleton.mp4"
    assert advice == "the same command with --again, and --force after --."
    with pytest.raises(AttemptFailure, match="no usable avatar") as failed:
        attempt(fail)
    assert failed.value.attempt.record.exit_code == 1
    with pytest.raises(AttemptFailure, match="KeyError") as failed:
        attempt(break_down)
    assert b"Traceback" in failed.value.attempt.files["ingest.log"]


def test_an_attempt_that_hangs_costs_the_limit(attempt):
    with pytest.raises(AttemptFailure, match="--limit"):
        attempt(lambda arguments, console: time.sleep(600.0), limit=0.2)
