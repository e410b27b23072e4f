"""summary.html and summary.csv: what a batch has made, what it cost, the worst first."""

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from urllib.parse import quote

import numpy as np

from apps.batching.batch_folder import AttemptRecord, BatchFolder
from apps.batching.batch_scheduler import CaptureState
from apps.batching.ingest_attempt import LOG_NAME, TURNING_NAME, folder_of
from apps.report.report_page import html_page, html_table
from apps.report.report_schema import format_psnr
from capture.input_error import InputError

PERCENTILES = (0, 5, 50, 95, 100)
"""Percentiles in the table of medians and tails."""
STATUS_ORDER = ("failed", "refused", "waiting", "learning", "done")
"""Order of the cards: the worst first; among avatars, the one with the lowest PSNR."""
COLUMNS: tuple[str, ...] = (
    "capture", "status", "attempts", "exit_code", "cause", "verdict", "psnr", "ssim", "frames",
    "steps", "wall_s", "core_s", "reserved_core_s", "cost", "peak_memory_mb", "package_bytes",
    "host", "video",
)  # fmt: skip
"""Columns of summary.csv."""
STYLE = """
main { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fill, minmax(11rem, 1fr));
  align-items: start; }
main a { display: block; padding: 0.45rem 0.8rem 0; color: var(--soft); }
main .done a { padding: 0; aspect-ratio: 1; overflow: hidden; }
main img { object-fit: cover; }
main .failed, main .refused { border-color: var(--masked); }
.filters { display: flex; flex-wrap: wrap; gap: 0.8rem; margin: 1.6rem 0 1rem; }
.filters input, .filters select { font: inherit; padding: 0.2rem 0.5rem; color: inherit;
  background: var(--card); border: 1px solid var(--line); border-radius: 0.4rem; }
th { text-align: left; font-weight: 600; padding: 0.3rem 0.6rem 0.3rem 0; }
figcaption b { color: var(--ink); }
figcaption { overflow-wrap: anywhere; }
"""
"""Styles of the cards, in addition to those of report.html."""
SCRIPT = """
const cards = [...document.querySelectorAll('main figure')];
const [words, status, order] = ['words', 'status', 'order'].map(id => document.getElementById(id));
const keys = { worst: c => +c.dataset.place, best: c => -c.dataset.place,
  name: c => c.dataset.name, slowest: c => -c.dataset.seconds };
function show() {
  const wanted = words.value.toLowerCase();
  let shown = 0;
  for (const card of cards) {
    const tags = card.dataset.status.split(' ');
    const fits = (!status.value || tags.includes(status.value))
      && card.textContent.toLowerCase().includes(wanted);
    card.hidden = !fits;
    shown += fits;
  }
  document.getElementById('shown').textContent = shown + ' of ' + cards.length;
}
order.onchange = () => {
  const key = keys[order.value];
  cards.sort((a, b) => key(a) < key(b) ? -1 : 1);
  document.querySelector('main').append(...cards);
};
words.oninput = status.onchange = show;
show();
"""
"""Filters and order of the cards."""


@dataclass(frozen=True, kw_only=True)
class CorePrice:
    """What an hour of a core costs, and in which currency."""

    per_core_hour: float
    currency: str = ""

    @classmethod
    def parse(cls, text: str) -> "CorePrice":
        """Read "0.04", or "0.04 EUR".

        Raises:
            InputError: If the text has another form.
        """
        found = re.fullmatch(r"(\d*\.?\d+)\s*(\S*)", text.strip())
        if found is None:
            raise InputError(f"--price is {text!r}, but must be a number per core-hour: 0.04 EUR.")
        return cls(per_core_hour=float(found[1]), currency=found[2])

    def of(self, core_s: float) -> float:
        """Return the cost of some core-seconds."""
        return core_s / 3600.0 * self.per_core_hour


@dataclass(frozen=True, kw_only=True)
class BatchSummary:
    """All captures of a batch with what they have cost, the worst first.

    Attributes:
        states: The captures.
        spent: Attempts by capture, successful or not.
        price: Price of a core-hour; None if not given.
    """

    states: tuple[CaptureState, ...]
    spent: dict[str, list[AttemptRecord]]
    price: CorePrice | None

    @classmethod
    def of(
        cls, states: Iterable[CaptureState], folder: BatchFolder, price: CorePrice | None
    ) -> "BatchSummary":
        """Summarize the captures by the results of all batches into a folder."""
        spent: dict[str, list[AttemptRecord]] = {}
        for record in folder.records:
            spent.setdefault(record.capture, []).append(record)
        ordered = sorted(states, key=_badness)
        return cls(states=tuple(ordered), spent=spent, price=price)

    def done(self) -> list[AttemptRecord]:
        """Return the successful attempts."""
        return [s.record for s in self.states if s.status == "done" and s.record is not None]

    def reserved_core_s(self, name: str) -> float:
        """Return the core-seconds that all attempts at a capture have occupied."""
        return sum((record.reserved_core_s for record in self.spent.get(name, ())), 0.0)

    def per_avatar_core_s(self) -> float:
        """Return the core-seconds occupied per avatar, failed attempts included; NaN for none."""
        total = sum(self.reserved_core_s(state.capture.name) for state in self.states)
        return total / len(self.done()) if self.done() else math.nan

    def cost_text(self, core_s: float) -> str:
        """Return a cost with its currency; empty without a price."""
        if self.price is None or not math.isfinite(core_s):
            return ""
        return f"{self.price.of(core_s):.4f} {self.price.currency}".strip()

    def headline(self) -> str:
        """Return the counts, median quality, and cost in a sentence."""
        counts = [(status, sum(s.status == status for s in self.states)) for status in STATUS_ORDER]
        text = ", ".join(f"{count} {status}" for status, count in reversed(counts) if count)
        done = self.done()
        if not done:
            return f"{text}."
        psnr = _numbers(record.figures.get("psnr") for record in done)
        cost = self.cost_text(self.per_avatar_core_s())
        return (
            f"{text}. Median {format_psnr(float(np.median(psnr)) if psnr else None, None)}, "
            f"{np.median([r.wall_s for r in done]):.0f} s; {self.per_avatar_core_s():.0f} "
            f"occupied core-seconds{f' and {cost}' if cost else ''} per avatar."
        )


def _badness(state: CaptureState) -> tuple[int, float, str]:
    psnr = None if state.record is None else state.record.figures.get("psnr")
    return STATUS_ORDER.index(state.status), -math.inf if psnr is None else psnr, state.capture.name


def _numbers(values: Iterable[float | None]) -> list[float]:
    return [float(value) for value in values if value is not None]


def write_summary(summary: BatchSummary, folder: BatchFolder, title: str) -> None:
    """Write summary.html and summary.csv into the folder of a batch.

    Raises:
        OSError: If the disk is full.
    """
    folder.write_text("summary.csv", summary_csv(summary))
    folder.write_text("summary.html", summary_page(summary, title))


def summary_csv(summary: BatchSummary) -> str:
    """Return one row per capture, the worst first; costs are those of all attempts."""
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    for state in summary.states:
        record, name = state.record, state.capture.name
        reserved = summary.reserved_core_s(name)
        row = {} if record is None else {**record.figures, **vars(record)}
        row |= {
            "capture": name,
            "video": state.capture.video,
            "status": state.status,
            "attempts": state.attempts,
            "reserved_core_s": round(reserved, 1),
            "cost": None if summary.price is None else round(summary.price.of(reserved), 6),
            "host": None if record is None else record.machine.get("host"),
        }
        table.writerow(row)
    return text.getvalue()


def summary_page(summary: BatchSummary, title: str) -> str:
    """Return the page; its pictures lie beside it, in the folders of the captures."""
    cards = "\n".join(_card(state, place) for place, state in enumerate(summary.states))
    verdicts = {str(record.figures.get("verdict")) for record in summary.done()}
    options = "".join(
        f"<option>{escape(value)}</option>"
        for value in [*reversed(STATUS_ORDER), *sorted(verdicts - {"None", "failed"})]
    )
    body = (
        f'<h1>{escape(title)}</h1>\n<p class="lead">{escape(summary.headline())}</p>\n'
        f'<div class="card">{_tails_table(summary)}</div>\n'
        '<p class="filters"><input id="words" type="search" placeholder="name or cause">'
        f'<select id="status"><option value="">all states</option>{options}</select>'
        '<select id="order"><option value="worst">worst first</option>'
        '<option value="best">best first</option><option value="slowest">slowest first</option>'
        '<option value="name">by name</option></select><span id="shown"></span></p>\n'
        f"<main>\n{cards}\n</main>\n<footer>Written by ia-batch of instant-avatar-stream. The same "
        f"as a table: summary.csv; every attempt: results.jsonl.</footer>\n"
        f"<script>{SCRIPT}</script>"
    )
    return html_page(f"{title}: avatars", body, style=STYLE)


def _tails_table(summary: BatchSummary) -> str:
    """Return medians and tails of quality and cost over all avatars."""
    done = summary.done()
    package_mb = [n / 1e6 for n in _numbers(r.figures.get("package_bytes") for r in done)]
    quantities: Sequence[tuple[str, list[float], str]] = (
        ("held-out PSNR, dB", _numbers(r.figures.get("psnr") for r in done), ".2f"),
        ("time, s", [r.wall_s for r in done], ".0f"),
        ("core-seconds used", [r.core_s for r in done], ".0f"),
        ("peak memory, MB", [r.peak_memory_mb for r in done], ".0f"),
        ("package, MB", package_mb, ".2f"),
    )
    lines = [
        [name, *(f"{each:{digits}}" for each in np.percentile(values, PERCENTILES))]
        for name, values, digits in quantities
        if values
    ]
    heads = [f"{percent} %" for percent in PERCENTILES]
    return html_table([["percentiles over the avatars", *heads], *lines])


def _card(state: CaptureState, place: int) -> str:
    record, name = state.record, state.capture.name
    figures = {} if record is None else record.figures
    folder = quote(folder_of(name, state.status))
    words, link, inside = "not learnt yet", "", ""
    if record is not None and state.status == "done":
        words = format_psnr(figures.get("psnr"), figures.get("verdict"))
        link = f'href="{folder}/report.html"'
        inside = f'<img loading="lazy" src="{folder}/{TURNING_NAME}" alt="{escape(name)} turning">'
    elif record is not None:
        words = f"{state.status}: {record.cause}"
        link, inside = f'href="{folder}/{LOG_NAME}"', "log"
    seconds = 0.0 if record is None else record.wall_s
    tags = f"{state.status} {figures.get('verdict') or ''}".strip()
    return (
        f'<figure class="{state.status}" data-status="{escape(tags)}" data-place="{place}" '
        f'data-name="{escape(name)}" data-seconds="{seconds:.1f}"><a {link}>{inside}</a>'
        f"<figcaption><b>{escape(name)}</b><br>{escape(words)}</figcaption></figure>"
    )
