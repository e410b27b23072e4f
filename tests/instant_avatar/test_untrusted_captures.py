"""Hostile files of every kind, as the commands read them (`benchmarks.fuzz_readers` makes more)."""

import pytest

from benchmarks.fuzz_readers import batches
from benchmarks.fuzz_seeds import make_seeds


@pytest.mark.slow
def test_every_reader_reads_or_refuses_whatever_it_is_given(tmp_path):
    make_seeds(tmp_path / "seeds")
    found = batches(tmp_path / "seeds", 240, seed=8)
    assert len(found) == 240
    assert {each["kind"] for each in found} >= {"poses", "masks", "cameras", "bodies", "captures"}
    assert [each for each in found if each["ended"] not in ("read", "refused")] == []
