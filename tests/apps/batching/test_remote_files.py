"""Captures and avatars behind URLs: in memory, and on a real S3 server."""

import json
import uuid
from pathlib import Path

import pytest

from apps.batching.batch_folder import AttemptRecord, BatchFolder
from apps.batching.capture_discovery import find_captures
from apps.batching.remote_files import fetch_inputs, list_files, send_files
from apps.cli.command_line import CommandExit
from apps.cli.console import Console
from capture.input_error import InputError


@pytest.fixture
def bucket() -> str:
    """A URL of its own in the memory of this process."""
    return f"memory://{uuid.uuid4().hex}"


def test_captures_behind_a_url_are_found_like_local_ones(bucket):
    files = {"anna/video.mp4": b"film", "anna/poses.npz": b"poses", "bob.mp4": b"other"}
    send_files(f"{bucket}/may", files)
    anna, bob = find_captures([f"{bucket}/may"], {"steps": 3})
    assert (anna.name, anna.video) == ("anna", f"{bucket}/may/anna")
    assert dict(anna.sources) == {
        f"{bucket}/may/anna/video.mp4": 4, f"{bucket}/may/anna/poses.npz": 5,
    }  # fmt: skip
    assert (bob.name, dict(bob.sources)) == ("bob", {f"{bucket}/may/bob.mp4": 5})


def test_a_manifest_behind_a_url(bucket):
    rows = [{"capture": "films/a.mp4", "poses": "poses/a.npz", "name": "anna", "steps": 4}]
    manifest = "\n".join(map(json.dumps, rows)).encode()
    send_files(bucket, {"list.jsonl": manifest, "films/a.mp4": b"film", "poses/a.npz": b"poses"})
    (anna,) = find_captures([f"{bucket}/list.jsonl"], {})
    assert anna.options == {"poses": f"{bucket}/poses/a.npz", "steps": 4}
    assert len(anna.sources) == 2
    send_files(bucket, {"list.jsonl": b'{"capture": "gone.mp4"}'})
    with pytest.raises(InputError, match="does not exist"):
        find_captures([f"{bucket}/list.jsonl"], {})


def test_what_is_fetched_is_what_was_listed(bucket, tmp_path):
    send_files(bucket, {"anna/images/0.png": b"0", "anna/poses.npz": b"own", "a.npz": b"poses"})
    files = list_files(f"{bucket}/anna") | list_files(f"{bucket}/a.npz")
    sources = tuple((url, state.size) for url, state in files.items())
    options = {"poses": f"{bucket}/a.npz", "steps": 3, "refine_poses": False}
    video, moved = fetch_inputs(sources, f"{bucket}/anna", options, tmp_path)
    assert (Path(video) / "images" / "0.png").read_bytes() == b"0"
    assert Path(moved["poses"]).read_bytes() == b"poses"
    assert (moved["steps"], moved["refine_poses"]) == (3, False)
    send_files(bucket, {"a.npz": b"longer poses"})
    with pytest.raises(OSError, match="5 were listed"):
        fetch_inputs(sources, f"{bucket}/anna", options, tmp_path / "again")


def test_unknown_urls_and_missing_packages_are_explained():
    with pytest.raises(InputError, match="cannot be read"):
        list_files("nonsense://bucket/a")


def test_results_behind_a_url_are_shared_and_locked(bucket):
    out = f"{bucket}/out"
    record = AttemptRecord(
        capture="a", video="/a", attempt=1, status="done", exit_code=0, cause="",
        input="i", options="o", started=1.0, ended=2.0,
    )  # fmt: skip
    with BatchFolder(out, (0, 2)).claim(Console()):
        with pytest.raises(CommandExit, match="Another batch is writing"):
            BatchFolder(out).claim(Console()).__enter__()
        with BatchFolder(out, (1, 2)).claim(Console()):
            pass
    folder = BatchFolder(out)
    with folder.claim(Console()):
        folder.append(record)
        with pytest.raises(CommandExit, match="Another batch"):
            BatchFolder(out, (1, 2)).claim(Console()).__enter__()
        assert not folder.has_package("a")
    again = BatchFolder(out)
    with again.claim(Console()):
        assert again.records == [record]
        again.place_files("a", {"avatar.iavatar": b"a", "report.html": b"r"}, "done")
        assert again.has_package("a")
        again.write_text("summary.csv", "text")
    names = [name.removeprefix(out) for name in list_files(out)]
    assert names == [
        "/a/avatar.iavatar", "/a/report.html", "/results.jsonl", "/summary.csv",
    ]  # fmt: skip


def test_the_lock_of_a_killed_batch_counts_ten_minutes(bucket):
    out = f"{bucket}/out"
    label = {"host": "h", "process": 1, "since": "then", "at": 0.0}
    send_files(out, {"_lock.json": json.dumps(label).encode()})
    with BatchFolder(out).claim(Console()):
        assert json.loads(_content(f"{out}/_lock.json"))["host"] != "h"
    assert list_files(f"{out}/_lock.json") == {}


def _content(url: str) -> bytes:
    from apps.batching.remote_files import open_remote

    system, path = open_remote(url)
    return system.cat_file(path)
