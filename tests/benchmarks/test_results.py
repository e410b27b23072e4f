"""docs/results.md: its plan, its tables, and that the text around them stays."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from benchmarks import results
from benchmarks.results import ResultsJob, plan, write_page
from benchmarks.results_page import ComparedSample, results_lines
from capture.input_error import InputError

MADE_ON = {
    "commit": "abc1234", "date": "2026-11-22 21:00 UTC", "processor": "a processor", "cores": 2,
    "load": 1.5, "memory_gb": 16.0, "software": "Python 3.11",
}  # fmt: skip


def result(method, novel, commit="abc1234", fitted=2.0):
    frame = {"psnr": novel, "psnr_mask": 20.0, "ssim": 0.9}
    scores = {**frame, "frames": [frame]}
    better = {**frame, "psnr": novel + fitted, "frames": [{**frame, "psnr": novel + fitted}]}
    curve = [
        {"core_seconds": 30.0, "steps": 5, "held_out": 20.0, "novel": novel - 1.0},
        {"core_seconds": 60.0, "steps": 10, "held_out": 21.0, "novel": novel},
    ]
    return {
        "method": method, "made_on": {**MADE_ON, "commit": commit}, "curve": curve,
        "core_seconds": 60.0, "steps": 10, "novel": scores, "novel_fitted": better,
        "held_out": scores, "held_out_fitted": better,
    }  # fmt: skip


def test_each_sample_is_a_column_and_the_gain_is_stated():
    phone, exact = (
        ComparedSample(subject=2, kind=kind, seconds=60.0) for kind in ("phone", "exact")
    )
    found = {
        phone: [result("anim-nerf", 21.0), result("ours", 27.0, fitted=3.0)],
        exact: [result("ours", 33.0)],
    }
    text = "\n".join(results_lines(found, ["a machine"]))
    assert "|  | S2 phone-like | S2 exact |" in text
    assert "| anim-nerf | 21.00 / 0.9000 | - |" in text
    assert "| anim-nerf | 23.00 / 0.9000 | - |" in text
    for gain in ("+6.0", "+7.0"):  # in the poses given, and in fitted ones
        assert f"S2 phone-like {gain} dB. At least +5 dB on 1 of 1." in text
    assert "* commit abc1234; 2026-11-22 21:00 UTC to" in text
    assert "another commit" not in text
    assert "| ours | 6,000: 10 | 6,000: 10 |" in text
    assert "| S2 phone-like | anim-nerf | 20.00 | 21.00 | 64 min (extrapolated) |" in text
    assert "24.48 / .9353" in text


def test_an_interrupted_run_goes_on_and_other_films_are_refused(tmp_path, monkeypatch):
    filmed, compared = [], []

    def compare(_, planned, __):
        compared.append(planned)
        return 130 if len(compared) == 3 else 0

    monkeypatch.setattr(results, "film_capture", lambda place, _: filmed.append(place.mkdir()))
    monkeypatch.setattr(results, "compare", compare)
    job = ResultsJob(out=tmp_path / "out", jobs=1)
    assert results.run(job) == 130
    assert len(filmed) == 6
    assert results.run(job) == 0
    assert len(filmed) == 6
    assert compared[len(plan("short")) :] == plan("short")
    with pytest.raises(InputError, match="filmed with"):
        results.run(replace(job, size=128))


def test_text_around_the_tables_is_kept(tmp_path):
    sample = ComparedSample(subject=1, kind="exact", seconds=60.0)
    folder = tmp_path / "out" / "S1-exact-60s"
    (folder / "ours").mkdir(parents=True)
    (folder / "ours" / "scores.json").write_text(json.dumps(result("ours", 30.0)))
    (folder / "snarf").mkdir()
    (folder / "snarf" / "scores.json").write_text(json.dumps({"method": "snarf"}))  # an old form
    cv2.imwrite(str(folder / "pictures.png"), np.zeros((8, 8, 3), dtype=np.uint8))
    page = tmp_path / "results.md"
    page.write_text("before\n<!-- tables: begin -->\nold\n<!-- tables: end -->\nafter\n")
    job = ResultsJob(out=tmp_path / "out", write=page)
    write_page(job, [sample])
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert "old" not in text
    assert "30.00 / 0.9000" in text
    assert (tmp_path / "results.webp").stat().st_size > 0
