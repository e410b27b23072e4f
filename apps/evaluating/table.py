"""Evaluations as a table: aligned for the eye, and Markdown as it stands."""

from collections.abc import Sequence

from apps.evaluating.rows import Evaluation, Row

HEAD = (
    "avatar", "frames", "drawn by", "poses", "PSNR", "in the box", "in the mask", "SSIM", "ms",
    "looks",
)  # fmt: skip
WORDS = (0, 2, 3, 9)
"""Columns that are aligned to the left."""
FORMATS = {"psnr": ".2f", "psnr_box": ".2f", "psnr_mask": ".2f", "ssim": ".4f", "cpu_ms": ".0f"}
PAPER = "InstantAvatar (paper)"


def table(evaluations: Sequence[Evaluation]) -> str:
    """All rows of all avatars, and their means where several were evaluated alike."""
    lines = [HEAD]
    for each in evaluations:
        lines += [_line(each.name, row) for row in each.rows]
        if each.paper is not None:
            lines.append(_paper(each))
    if len(evaluations) > 1:
        lines += _means(evaluations)
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEAD))]
    rule = [
        "-" * width if i in WORDS else "-" * (width - 1) + ":" for i, width in enumerate(widths)
    ]
    drawn = [_padded(lines[0], widths), rule, *(_padded(line, widths) for line in lines[1:])]
    return "\n".join(f"| {' | '.join(line)} |" for line in drawn) + "\n"


def _padded(line: Sequence[str], widths: Sequence[int]) -> list[str]:
    return [
        text.ljust(width) if column in WORDS else text.rjust(width)
        for column, (text, width) in enumerate(zip(line, widths, strict=True))
    ]


def _line(name: str, row: Row) -> tuple[str, ...]:
    figures = (_told(row.figure(figure), form) for figure, form in FORMATS.items())
    looks = row.verdict or ""
    return (name, str(len(row.scores)), row.drawn_by, row.poses, *figures, looks)


def _paper(each: Evaluation) -> tuple[str, ...]:
    """The paper's own row, beside ours."""
    assert each.paper is not None
    figures = (_told(each.paper.get(figure), form) for figure, form in FORMATS.items())
    return (each.name, "", PAPER, "fitted", *figures, "")


def _means(evaluations: Sequence[Evaluation]) -> list[tuple[str, ...]]:
    """For each way to draw that all avatars have, the mean of their means."""
    ways = [(row.drawn_by, row.poses) for row in evaluations[0].rows]
    lines = []
    for way in ways:
        alike = [r for each in evaluations for r in each.rows if (r.drawn_by, r.poses) == way]
        if len(alike) != len(evaluations):
            continue
        figures = []
        for figure, form in FORMATS.items():
            values = [value for row in alike if (value := row.figure(figure)) is not None]
            figures.append(_told(sum(values) / len(values) if values else None, form))
        lines.append(("mean", str(sum(len(row.scores) for row in alike)), *way, *figures, ""))
    return lines


def _told(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
