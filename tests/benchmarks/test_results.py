"""docs/results.md: its tables, and that the text around them stays."""

import json

import cv2
import numpy as np

from benchmarks.results import ResultsJob, write_page
from benchmarks.results_page import ComparedSample, results_lines


def result(method, novel):
    scores = {"psnr": novel, "psnr_mask": 20.0, "ssim": 0.9}
    curve = [
        {"core_seconds": 30.0, "steps": 5, "held_out": 20.0, "novel": novel - 1.0},
        {"core_seconds": 60.0, "steps": 10, "held_out": 21.0, "novel": novel},
    ]
    return {"method": method, "commit": "abc", "novel": scores, "held_out": scores, "curve": curve}


def test_each_sample_is_a_column_and_the_gain_is_stated():
    phone, exact = (
        ComparedSample(subject=2, kind=kind, seconds=60.0) for kind in ("phone", "exact")
    )
    found = {
        phone: [result("anim-nerf", 21.0), result("ours", 27.0)],
        exact: [result("ours", 33.0)],
    }
    text = "\n".join(results_lines(found, ["a machine"]))
    assert "|  | S2 phone-like | S2 exact |" in text
    assert "| anim-nerf | 21.00 / 0.9000 | - |" in text
    assert "S2 phone-like +6.0 dB. At least +5 dB on 1 of 1." in text
    assert "| S2 phone-like | anim-nerf | 20.00 | 21.00 | 64 min (extrapolated) |" in text
    assert "24.48 / .9353" in text


def test_text_around_the_tables_is_kept(tmp_path):
    sample = ComparedSample(subject=1, kind="exact", seconds=60.0)
    folder = tmp_path / "out" / "S1-exact-60s"
    (folder / "ours").mkdir(parents=True)
    (folder / "ours" / "scores.json").write_text(json.dumps(result("ours", 30.0)))
    cv2.imwrite(str(folder / "pictures.png"), np.zeros((8, 8, 3), dtype=np.uint8))
    page = tmp_path / "results.md"
    page.write_text("before\n<!-- tables: begin -->\nold\n<!-- tables: end -->\nafter\n")
    job = ResultsJob(out=tmp_path / "out", write=page)
    write_page(job, [sample], ["a machine"])
    text = page.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert "old" not in text
    assert "30.00 / 0.9000" in text
    assert (tmp_path / "results.webp").stat().st_size > 0
