"""The summary of a batch: the worst first, every attempt paid for."""

import csv
import io

import pytest

from apps.batching.batch_folder import AttemptRecord, BatchFolder
from apps.batching.batch_scheduler import CaptureState
from apps.batching.summary_page import BatchSummary, CorePrice, summary_csv, summary_page
from apps.cli.console import Console
from capture.input_error import InputError

FIGURES = {"verdict": "sharp", "ssim": 0.9, "package_bytes": 2_000_000}


@pytest.fixture
def summary(named, tmp_path) -> BatchSummary:
    """Two avatars, one of which took two attempts, a refused capture, and one that waits."""
    folder = BatchFolder(str(tmp_path / "out"))
    states = []
    attempts = [("good", "done", 35.0), ("late", "failed", None), ("late", "done", 25.0)]
    with folder.claim(Console()):
        for number, (name, status, psnr) in enumerate([*attempts, ("b<d", "refused", None)]):
            record = AttemptRecord(
                capture=name, video=f"/{name}", attempt=1, status=status, exit_code=None,
                cause="" if psnr else "no <person>", input="", options="", started=float(number),
                ended=0.0, wall_s=1800.0, core_s=900.0, machine={"used_cores": 2, "host": "one"},
                figures={**FIGURES, "psnr": psnr} if psnr else {},
            )  # fmt: skip
            folder.append(record)
            if (name, status) != ("late", "failed"):
                states.append(CaptureState(capture=named(name), status=status, record=record))
        states.append(CaptureState(capture=named("new"), status="waiting"))
    return BatchSummary.of(states, folder, CorePrice.parse("0.5 EUR"))


def test_the_worst_come_first(summary):
    assert [s.capture.name for s in summary.states] == ["b<d", "new", "late", "good"]


def test_an_avatar_costs_what_all_attempts_cost(summary):
    assert summary.per_avatar_core_s() == 4 * 3600.0 / 2
    assert summary.headline() == (
        "2 done, 1 waiting, 1 refused. Median 30.00 dB, 1800 s; 7200 occupied core-seconds and "
        "1.0000 EUR per avatar."
    )


def test_a_row_per_capture(summary):
    rows = {row["capture"]: row for row in csv.DictReader(io.StringIO(summary_csv(summary)))}
    assert rows["late"]["reserved_core_s"] == "7200.0"
    assert rows["late"]["cost"] == "1.0"
    assert rows["good"]["psnr"] == "35.0"
    assert rows["b<d"]["cause"] == "no <person>"
    assert rows["new"]["status"] == "waiting"


def test_the_page_shows_avatars_causes_and_tails(summary):
    page = summary_page(summary, "avatars")
    assert '<img loading="lazy" src="good/turning.webp"' in page
    assert 'href="_failed/b%3Cd/ingest.log"' in page
    assert "refused: no &lt;person&gt;" in page
    assert "no <person>" not in page
    assert "<td>25.00</td><td>25.50</td><td>30.00</td><td>34.50</td><td>35.00</td>" in page


def test_prices():
    assert CorePrice.parse("0.04").of(3600.0) == 0.04
    with pytest.raises(InputError, match="per core-hour"):
        CorePrice.parse("cheap")
