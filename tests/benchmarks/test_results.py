"""docs/results.md: its plan, its tables, and that the text around them stays."""

from dataclasses import replace

import pytest

from benchmarks import results
from benchmarks.results import ResultsJob, plan
from capture.input_error import InputError


def test_an_interrupted_run_goes_on_and_other_films_are_refused(tmp_path, monkeypatch):
    filmed, compared = [], []

    def compare(_, planned):
        compared.append(planned)
        return 130 if len(compared) == 3 else 0

    monkeypatch.setattr(results, "film_capture", lambda place, _: filmed.append(place.mkdir()))
    monkeypatch.setattr(results, "compare", compare)
    job = ResultsJob(out=tmp_path / "out", jobs=1)
    assert results.run(job) == 130
    assert len(filmed) == 6
    assert results.run(job) == 0
    assert len(filmed) == 6
    assert compared[len(plan()) :] == plan()
    with pytest.raises(InputError, match="filmed with"):
        results.run(replace(job, size=128))
