"""summary.html: a contact sheet of a batch, the worst first."""

import math
from collections import Counter
from collections.abc import Mapping
from statistics import median
from urllib.parse import quote

from instant_avatar.batching.batch_folder import folder_of
from instant_avatar.batching.ingest_attempt import ANIMATION_NAME, LOG_NAME, AttemptRecord
from instant_avatar.cli.console import format_duration
from instant_avatar.report.page_rendering import render_template
from instant_avatar.report.report_schema import format_psnr

STATUSES = ("failed", "refused", "waiting", "done")
"""States of a capture, the worst first."""
Results = Mapping[str, AttemptRecord | None]
"""The result of each capture by its name; None for one that waits."""


def describe_result(record: AttemptRecord | None) -> str:
    """Return quality and duration of an avatar, or why there is none."""
    if record is None:
        return "not learnt yet"
    if record.status != "done":
        return f"{record.status}: {record.cause}"
    score = format_psnr(record.figures.get("psnr"), record.figures.get("verdict"))
    return f"{score}, {format_duration(record.wall_s)}"


def headline(results: Results) -> str:
    """Return counts, median quality and median time in a sentence."""
    counts = Counter(map(_status, results.values()))
    text = ", ".join(f"{counts[s]} {s}" for s in reversed(STATUSES) if counts[s])
    done = [record for record in results.values() if record is not None and record.status == "done"]
    scores = [psnr for record in done if (psnr := record.figures.get("psnr")) is not None]
    if scores:
        wall_s = median(record.wall_s for record in done)
        text += f". Median {format_psnr(median(scores), None)}, {format_duration(wall_s)}"
    return f"{text}."


def summary_page(results: Results, title: str) -> str:
    """Return the page; its pictures lie beside it, in the folders of the captures."""
    cards = [
        (name, _status(record), quote(folder_of(name, _status(record))), describe_result(record))
        for name, record in sorted(results.items(), key=_badness)
    ]
    return render_template(
        "summary.html",
        title=title,
        headline=headline(results),
        cards=cards,
        animation=ANIMATION_NAME,
        log=LOG_NAME,
    )


def _status(record: AttemptRecord | None) -> str:
    return "waiting" if record is None else record.status


def _badness(item: tuple[str, AttemptRecord | None]) -> tuple[int, float, str]:
    """Return a key by which the worst come first: no avatar, then the lowest PSNR."""
    name, record = item
    psnr = None if record is None else record.figures.get("psnr")
    return STATUSES.index(_status(record)), -math.inf if psnr is None else psnr, name
