"""Peak memory of this process alone, and percentiles of a stream in bounded memory."""

import subprocess
import sys

import numpy as np
import pytest

from capture.process_metrics import ReservoirSample, peak_memory_mb

SAID = "from capture.process_metrics import peak_memory_mb as p; {}; print(p())"


def said(held: str) -> float:
    command = [sys.executable, "-c", SAID.format(held)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def test_what_was_held_is_counted_and_what_the_parent_holds_is_not():
    before = said("pass")
    block = bytearray(b"\1") * (200 << 20)
    assert peak_memory_mb() > 200.0
    assert abs(said("pass") - before) < 20.0
    assert said("bytearray(b'x') * (200 << 20)") > before + 180.0
    del block


def test_of_few_numbers_the_percentiles_are_exact(rng):
    numbers = rng.normal(size=300)
    reservoir = ReservoirSample()
    for number in numbers:
        reservoir.add(float(number))
    for percent in (0.0, 50.0, 95.0, 100.0):
        assert reservoir.percentile(percent) == pytest.approx(np.percentile(numbers, percent))
    assert reservoir.count == 300
    assert reservoir.largest == numbers.max()


def test_of_many_the_kept_ones_are_a_fair_sample_of_all():
    reservoir = ReservoirSample(kept=500)
    for number in range(50_000):
        reservoir.add(float(number))
    assert len(reservoir._kept) == 500
    assert reservoir.count == 50_000
    assert reservoir.largest == 49_999.0
    # the standard error of a share of one half of 500 is 0.022
    assert reservoir.percentile(50.0) == pytest.approx(25_000, abs=4 * 0.0224 * 50_000)
    assert reservoir.percentile(95.0) == pytest.approx(47_500, abs=4 * 0.0098 * 50_000)


def test_of_none_everything_is_zero():
    assert ReservoirSample().percentile(95.0) == ReservoirSample().largest == 0.0
    assert ReservoirSample().count == 0


def test_the_largest_of_negative_numbers_is_negative():
    reservoir = ReservoirSample()
    for number in (-3.0, -1.0, -2.0):
        reservoir.add(number)
    assert reservoir.largest == -1.0
