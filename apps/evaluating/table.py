"""Evaluations as a table: aligned for the eye, and Markdown as it stands."""

from collections.abc import Sequence

from apps.evaluating.rows import AvatarEvaluation, ScoreRow

HEADER = (
    "avatar", "frames", "drawn by", "poses", "PSNR", "in the box", "in the mask", "SSIM", "ms",
    "looks",
)  # fmt: skip
LEFT_ALIGNED_COLUMNS = (0, 2, 3, 9)
"""Columns that are aligned to the left."""
FORMATS = {"psnr": ".2f", "psnr_box": ".2f", "psnr_mask": ".2f", "ssim": ".4f", "cpu_ms": ".0f"}
PAPER_ROW_NAME = "InstantAvatar (paper)"


def markdown_table(evaluations: Sequence[AvatarEvaluation]) -> str:
    """All rows of all avatars, and their means where several were evaluated alike."""
    lines = [HEADER]
    for each in evaluations:
        lines += [_row_cells(each.name, row) for row in each.rows]
        if each.paper is not None:
            lines.append(_paper_cells(each))
    if len(evaluations) > 1:
        lines += _mean_rows(evaluations)
    widths = [max(len(line[column]) for line in lines) for column in range(len(HEADER))]
    rule = [
        "-" * width if i in LEFT_ALIGNED_COLUMNS else "-" * (width - 1) + ":" for i, width in enumerate(widths)
    ]
    drawn = [_pad_cells(lines[0], widths), rule, *(_pad_cells(line, widths) for line in lines[1:])]
    return "\n".join(f"| {' | '.join(line)} |" for line in drawn) + "\n"


def _pad_cells(line: Sequence[str], widths: Sequence[int]) -> list[str]:
    return [
        text.ljust(width) if column in LEFT_ALIGNED_COLUMNS else text.rjust(width)
        for column, (text, width) in enumerate(zip(line, widths, strict=True))
    ]


def _row_cells(name: str, row: ScoreRow) -> tuple[str, ...]:
    figures = (_format_cell(row.mean_of(figure), form) for figure, form in FORMATS.items())
    looks = row.verdict or ""
    return (name, str(len(row.scores)), row.renderer, row.poses, *figures, looks)


def _paper_cells(each: AvatarEvaluation) -> tuple[str, ...]:
    """The paper's own row, beside ours."""
    assert each.paper is not None
    figures = (_format_cell(each.paper.get(figure), form) for figure, form in FORMATS.items())
    return (each.name, "", PAPER_ROW_NAME, "fitted", *figures, "")


def _mean_rows(evaluations: Sequence[AvatarEvaluation]) -> list[tuple[str, ...]]:
    """For each way to draw that all avatars have, the mean of their means."""
    ways = [(row.renderer, row.poses) for row in evaluations[0].rows]
    lines = []
    for way in ways:
        alike = [r for each in evaluations for r in each.rows if (r.renderer, r.poses) == way]
        if len(alike) != len(evaluations):
            continue
        figures = []
        for figure, form in FORMATS.items():
            values = [value for row in alike if (value := row.mean_of(figure)) is not None]
            figures.append(_format_cell(sum(values) / len(values) if values else None, form))
        lines.append(("mean", str(sum(len(row.scores) for row in alike)), *way, *figures, ""))
    return lines


def _format_cell(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
