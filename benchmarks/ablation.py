"""What each mechanism of training buys.

    python -m benchmarks.ablation [--keep FOLDER] [--quick] [--write PAGE]

Each mechanism is left out in turn on phone-like films (`benchmarks.mechanisms`). There are no
thresholds here.
"""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Literal

import tyro

from benchmarks.mechanisms import (
    MECHANISMS,
    MORE_STEPS,
    CaptureScores,
    Mechanism,
    MechanismScore,
    measured_scores,
)
from benchmarks.sample_training import film_sample

COMMAND = "python -m benchmarks.ablation --write docs/ablation.md"
PHONE_PX = 270
"""Longer side of phone-like pictures."""


@dataclass(frozen=True, kw_only=True)
class Ablation:
    """Trains without each mechanism, and prints the tables."""

    subjects: tuple[Literal[1, 2, 3], ...] = (1, 2)
    """Who is filmed as by a phone."""
    seeds: tuple[int, ...] = (0,)
    """Of training."""
    quick: bool = False
    """Twenty steps each: whether it runs, not what comes out."""
    steps: int = 600
    """Steps without each mechanism."""
    write: Path | None = None
    """Markdown file whose tables are replaced; text outside its marks is kept."""
    keep: Path | None = None
    """Folder for what is filmed; what lies there is used again."""


def main() -> None:
    """The benchmark."""
    job = tyro.cli(Ablation, prog="python -m benchmarks.ablation", description=__doc__)
    if job.quick:
        job = replace(job, steps=20)
    with tempfile.TemporaryDirectory() as temporary:
        folder = job.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        lines = mechanism_lines(list(run_mechanisms(job, folder)))
    print("\n".join(lines))
    if job.write is not None:
        job.write.write_text(written(lines, job.write))


def run_mechanisms(job: Ablation, folder: Path) -> Iterator[CaptureScores]:
    """The mechanisms on phone-like films."""
    for subject in job.subjects:
        film = film_by_phone(folder, subject, quick=job.quick)
        for seed in job.seeds:
            kept = folder / f"{film.name}-seed{seed}.json"
            yield measured_scores(film, kept, size_px=PHONE_PX, steps=job.steps, seed=seed)


def film_by_phone(folder: Path, subject: Literal[1, 2, 3], *, quick: bool) -> Path:
    """A phone-like film of ten seconds, ten frames a second."""
    frames = 30 if quick else 100
    return film_sample(
        folder / f"phone-{subject}", 2 * round(PHONE_PX * 9 / 32),
        like_a_phone=True, subject=subject, frames=frames, fps=10,
    )  # fmt: skip


def mechanism_lines(captures: Sequence[CaptureScores]) -> list[str]:
    """What each mechanism buys, as a table of all films."""
    head = ["without", "core-ms saved", *(f"{c.capture}, seed {c.seed}" for c in captures)]
    head += ["mean loss, dB", "its time would buy, dB", "lines"]
    return [
        f"`{COMMAND}`",
        "",
        "## Mechanisms, one by one",
        "",
        *(
            f"* {each.capture}, {each.size_px} px, seed {each.seed}, {each.steps} steps: "
            f"{each.measured}; with all mechanisms {_levels(each.scores[0])}, "
            f"{each.scores[0].step_ms:.1f} core-ms a step"
            for each in captures
        ),
        "",
        *_table(head, _mechanism_cells(MECHANISMS, captures)),
    ]


def _mechanism_cells(
    rows: Sequence[Mechanism], found: Sequence[CaptureScores]
) -> list[tuple[str, ...]]:
    """What is lost without each mechanism on each capture (novel / held out), and on average."""
    full, longer, *_ = rows
    by_name = [{score.name: score for score in each.scores} for each in found]
    gains = [
        -mean(_loss(each[full.name], each[longer.name])) for each in by_name if longer.name in each
    ]
    slope = mean(gains) / (MORE_STEPS - 1.0) if gains else 0.0
    cells = []
    for row in rows[1:]:
        pairs = [(each[full.name], each[row.name]) for each in by_name if row.name in each]
        if not pairs:
            continue
        saved = mean(a.step_ms - b.step_ms for a, b in pairs)
        lost = [
            _loss_text(each[full.name], each[row.name]) if row.name in each else "-"
            for each in by_name
        ]
        bought = slope * saved / mean(a.step_ms for a, _ in pairs)
        last = ("", "") if row is longer else (f"{bought:+.2f}", str(row.lines or "few"))
        overall = mean(mean(_loss(a, b)) for a, b in pairs)
        cells.append((row.name, f"{saved:.1f}", *lost, f"{overall:+.2f}", *last))
    return cells


def _loss(full: MechanismScore, without: MechanismScore) -> list[float]:
    """What is lost on novel poses, if there are any, and on held-out frames, dB."""
    pairs = [(full.novel, without.novel), (full.held_out, without.held_out)]
    return [a - b for a, b in pairs if a is not None and b is not None]


def _loss_text(full: MechanismScore, without: MechanismScore) -> str:
    """`_loss`, and how much more is fog."""
    losses = _loss(full, without)
    text = " / ".join(f"{loss:+.2f}" for loss in losses)
    if full.half_transparent is None or without.half_transparent is None:
        return text
    return f"{text}, {100.0 * (without.half_transparent - full.half_transparent):+.1f} % fog"


def _levels(score: MechanismScore) -> str:
    novel = "" if score.novel is None else f"{score.novel:.2f} dB novel, "
    fog = score.half_transparent
    firm = "" if fog is None else f", {100.0 * fog:.1f} % of the pixels half transparent"
    return f"{novel}{score.held_out:.2f} dB held out{firm}"


def written(lines: Sequence[str], path: Path) -> str:
    """The file's text with the tables replaced and the text around them kept."""
    begin, end = "<!-- mechanisms: begin -->", "<!-- mechanisms: end -->"
    text = path.read_text() if path.exists() else f"# What each mechanism buys\n\n{begin}{end}\n"
    before, after = text.split(begin)[0], text.split(end)[1]
    return before + "\n".join([begin, *lines, end]) + after


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---", *["--:"] * (len(head) - 1)]
    return ["| " + " | ".join(cells) + " |" for cells in (head, rule, *rows)]


if __name__ == "__main__":
    main()
