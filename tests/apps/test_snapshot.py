"""Packages that cannot wait, and the finer ones that follow."""

import dataclasses
from pathlib import Path

from apps.learning.snapshot import Snapshot, finer
from export.build import ExportReport

WRITTEN = ExportReport(
    path=Path("a.iavatar"), bytes=9, seconds=1.0, psnr_to_renderer={"hq": 40.0},
    largest_difference=0.0, tuning=None, warnings=(),
)  # fmt: skip
HASTY = Snapshot(exported=WRITTEN, refused=None, ready_at=10.0)
LATER = Snapshot(exported=dataclasses.replace(WRITTEN, bytes=20), refused=None, ready_at=14.0)
REFUSED = Snapshot(exported=None, refused="fog", ready_at=12.0)


def test_the_finer_package_stands_and_was_ready_with_the_hasty_one():
    taken = finer(HASTY, LATER)
    assert taken.exported is LATER.exported
    assert taken.ready_at == HASTY.ready_at


def test_if_the_finer_one_is_refused_the_hasty_one_stays():
    assert finer(HASTY, REFUSED) is HASTY


def test_if_the_hasty_one_was_refused_the_finer_one_counts_from_when_it_was_there():
    assert finer(REFUSED, LATER) is LATER
