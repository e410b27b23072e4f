"""The package as baked, and the fine-tuned one that follows."""

import dataclasses
from pathlib import Path

from export.build import ExportReport
from instant_avatar.run.snapshot_writer import PackageSnapshot, prefer_final

WRITTEN = ExportReport(
    path=Path("a.iavatar"), bytes=9, seconds=1.0, psnr_to_renderer={"hq": 40.0},
    largest_difference=0.0, fine_tuning_psnr=None, warnings=(),
)  # fmt: skip
HASTY = PackageSnapshot(export_report=WRITTEN, refusal=None, ready_at=10.0)
LATER = PackageSnapshot(
    export_report=dataclasses.replace(WRITTEN, bytes=20), refusal=None, ready_at=14.0
)
REFUSED = PackageSnapshot(export_report=None, refusal="fog", ready_at=12.0)


def test_the_finer_package_stands_and_was_ready_with_the_hasty_one():
    taken = prefer_final(HASTY, LATER)
    assert taken.export_report is LATER.export_report
    assert taken.ready_at == HASTY.ready_at


def test_if_the_finer_one_is_refused_the_hasty_one_stays():
    assert prefer_final(HASTY, REFUSED) is HASTY
