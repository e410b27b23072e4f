"""ia-batch on a real Ray cluster of several nodes on this machine."""

import importlib.util
import json
import os
import subprocess
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

import pytest

from apps.batching.ingest_attempt import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="Ray is not installed"),
]
WORDS = ["--cores", "1", "--retries", "1", "--limit", "180", "--memory", "2"]
"""Options of these batches: small nodes, and one attempt more."""
FILES = {"avatar.iavatar", "ingest.log", "report.html", "report.json", "turning.webp"}
"""What a capture with poses leaves."""


@pytest.fixture
def cluster(hooked, monkeypatch):
    """Three nodes of one core each, and a head that learns nothing."""
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{os.environ['PYTHONPATH']}")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from ray.cluster_utils import Cluster

        size = {"object_store_memory": 100_000_000, "include_dashboard": False}
        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **size})
        try:
            made.workers = [
                made.add_node(num_cpus=1, memory=3_000_000_000, **size) for _ in range(3)
            ]
            yield made
        finally:
            made.shutdown()


def start(captures: Path, out: Path, cluster) -> subprocess.Popen:
    """Start ia-batch on the cluster."""
    command = [sys.executable, "-m", "apps.batch", str(captures), "--out", str(out), *WORDS]
    command += ["--scratch", str(out.parent / "work"), "--ray", cluster.address]
    return subprocess.Popen(
        [*command, "--", "--steps", "60"], stderr=subprocess.PIPE, text=True, cwd=ROOT
    )


def records(out: Path) -> list[dict]:
    """The lines of the results file, if there is one."""
    path = out / "results.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def wait_for_done(count: int, out: Path, batch: subprocess.Popen) -> None:
    """Wait for a number of avatars."""
    while sum(record["status"] == "done" for record in records(out)) < count:
        assert batch.poll() is None, batch.communicate()
        time.sleep(0.2)


def test_24_captures_on_3_nodes_of_which_one_dies(tmp_path, copies, cluster):
    good = [f"a{number:02d}" for number in range(20)]
    copies(tmp_path / "films", [*good, "a-hangs", "a-eats", "bad", "bad2"])
    out = tmp_path / "out"

    first = start(tmp_path / "films", out, cluster)
    wait_for_done(3, out, first)
    cluster.remove_node(cluster.workers.pop(), allow_graceful=False)
    wait_for_done(8, out, first)
    first.kill()
    first.communicate()
    before = records(out)

    second = start(tmp_path / "films", out, cluster)
    _, said = second.communicate(timeout=3000)
    assert second.returncode == 1, said
    found = records(out)
    assert found[: len(before)] == before
    done = [record["capture"] for record in found if record["status"] == "done"]
    assert sorted(done) == good  # each once
    for name in good:
        assert set(os.listdir(out / name)) == {*FILES, ".instant-avatar-files"}
    refused = [record for record in found if record["status"] == "refused"]
    assert sorted(record["capture"] for record in refused) == ["bad", "bad2"]
    failures = [record for record in found if record["status"] == "failed"]
    lost = [record for record in failures if "was lost" in record["cause"]]
    assert lost  # with its node
    assert {record["exit_code"] for record in lost} == {None}
    counted = Counter(record["capture"] for record in failures if record not in lost)
    assert set(counted) == {"a-eats", "a-hangs"}
    assert "took longer than 180 s" in _cause(failures, "a-hangs")
    assert "2.0 GB were allowed" in _cause(failures, "a-eats")
    assert Counter(record["capture"] for record in failures)["a-hangs"] == 2
    nodes = {record["machine"].get("node") for record in found} - {None}
    assert len(nodes) in (2, 3)  # the one that died may have had nothing but a-hangs
    assert not list(out.rglob("*.part"))
    assert "20 done" in said
    page = (out / "summary.html").read_text()
    assert page.count('<img loading="lazy"') == 20

    third = start(tmp_path / "films", out, cluster)
    third.communicate(timeout=600)
    assert (third.returncode, records(out)) == (1, found)


def _cause(failures: list[dict], name: str) -> str:
    """The cause of a capture's last failure."""
    return [record["cause"] for record in failures if record["capture"] == name][-1]


def test_no_node_is_large_enough(tmp_path, copies, cluster):
    copies(tmp_path / "films", ["bad"])
    command = [sys.executable, "-m", "apps.batch", str(tmp_path / "films"), "--cores", "2"]
    command += ["--out", str(tmp_path / "out"), "--ray", cluster.address]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 2, done.stderr
    assert "No node of the cluster has 2 cores" in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()
