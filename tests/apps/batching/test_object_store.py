"""ia-batch with captures and avatars on a real S3 server."""

import importlib.util
import json
import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from apps.batching.ingest_attempt import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        any(importlib.util.find_spec(name) is None for name in ("moto", "flask", "s3fs")),
        reason="moto, flask or s3fs is not installed",
    ),
]


class ObjectStore:
    """An S3 server with two buckets, films and avatars."""

    def __init__(self, address: str) -> None:
        import boto3

        self._client = boto3.client("s3", endpoint_url=address)
        for bucket in ("films", "avatars"):
            self._client.create_bucket(Bucket=bucket)

    def put(self, key: str, content: bytes) -> None:
        self._client.put_object(Bucket="films", Key=key, Body=content)

    def get(self, key: str) -> bytes:
        return self._client.get_object(Bucket="avatars", Key=key)["Body"].read()

    def listing(self) -> list[str]:
        return [each["Key"] for each in self._client.list_objects_v2(Bucket="avatars")["Contents"]]

    def upload(self, folder: Path, place: str) -> None:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                self.put(f"{place}/{path.relative_to(folder)}", path.read_bytes())


@pytest.fixture
def store(hooked, monkeypatch):
    """An S3 server, and the environment that names it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"http://127.0.0.1:{port}"
    server = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-p", str(port)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    try:
        for _ in range(600):
            with suppress(OSError):
                socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
                break
            time.sleep(0.1)
        yield ObjectStore(address)
    finally:
        server.kill()
        server.wait()


def learn(work: Path, *words: str, place: str = "s3://films/may") -> subprocess.CompletedProcess:
    """Run ia-batch from the films in the store."""
    command = [sys.executable, "-m", "apps.batch", place, "--cores", "1"]
    command += ["--scratch", str(work), *words]
    path = f"{ROOT}{os.pathsep}{os.environ['PYTHONPATH']}"
    return subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=work,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip


def test_captures_come_from_and_avatars_go_to_an_object_store(tmp_path, copies, store):
    copies(tmp_path / "films", ["anna", "bad"])
    store.upload(tmp_path / "films", "may")
    words = ["--out", "s3://avatars/may", "--disk", "0.1", "--", "--steps", "60"]
    (tmp_path / "work").mkdir()

    first = learn(tmp_path / "work", *words)
    assert first.returncode == 1, first.stderr
    kept = {"avatar.iavatar", "ingest.log", "report.html", "report.json", "turning.webp"}
    keys = {key.removeprefix("may/") for key in store.listing()}
    expected = {f"anna/{name}" for name in kept} | {"results.jsonl", "summary.csv", "summary.html"}
    assert keys == {*expected, "_failed/bad/ingest.log"}
    lines = store.get("may/results.jsonl").decode().splitlines()
    status = {record["capture"]: record["status"] for record in map(json.loads, lines)}
    assert status == {"anna": "done", "bad": "refused"}
    assert [path.name for path in (tmp_path / "work").iterdir()] == ["in-use"]

    second = learn(tmp_path / "work", *words)
    assert second.returncode == 1
    assert "2 captures, 2 of them settled before" in second.stderr
    assert store.get("may/results.jsonl").decode().splitlines() == lines

    store.put("may/bad.mp4", b"still no video")  # changed: tried again
    third = learn(tmp_path / "work", *words)
    assert third.returncode == 1
    assert len(store.get("may/results.jsonl").splitlines()) == 3


def test_a_capture_beyond_the_budget_is_refused(tmp_path, copies, store):
    copies(tmp_path / "films", ["anna"])
    store.upload(tmp_path / "films", "may")
    (tmp_path / "work").mkdir()
    ended = learn(tmp_path / "work", "--out", str(tmp_path / "out"), "--disk", "0.00001")
    assert ended.returncode == 1, ended.stderr
    assert "--disk allows 0.00 GB" in ended.stderr


def test_without_credentials_the_store_says_so(tmp_path, store, monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:1")
    (tmp_path / "work").mkdir()
    ended = learn(tmp_path / "work", "--out", str(tmp_path / "out"))
    assert ended.returncode == 2, ended.stderr
    assert "cannot list s3://films/may" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_manifest_of_a_web_server_names_files(tmp_path, copies, hooked):
    copies(tmp_path / "films", ["bad", "bad2"])
    (tmp_path / "films" / "list.csv").write_text("capture,name\nbad.mp4,anna\nbad2.mp4,\n")
    (tmp_path / "work").mkdir()
    handler = partial(SimpleHTTPRequestHandler, directory=str(tmp_path / "films"))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        place = f"http://127.0.0.1:{server.server_port}"
        words = ["--out", str(tmp_path / "out"), "--retries", "0"]
        ended = learn(tmp_path / "work", *words, place=f"{place}/list.csv")
        refused = learn(tmp_path / "work", *words, place=place)
        server.shutdown()
    lines = (tmp_path / "out" / "results.jsonl").read_text().splitlines()
    status = {record["capture"]: record["cause"] for record in map(json.loads, lines)}
    assert ended.returncode == 1, ended.stderr
    assert set(status) == {"anna", "bad2"}
    assert all("no video that can be opened" in cause for cause in status.values())
    assert refused.returncode == 2
    assert "web servers list no folders" in refused.stderr
