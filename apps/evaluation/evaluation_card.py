"""The evaluation card: conditions, scores, quality by time, pictures; as MD, CSV, JSON and HTML."""

from collections.abc import Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path

from apps.cli.hardware import Hardware
from apps.evaluation.frame_scoring import LARGEST_SHOWN_ERROR, REGIONS, choose_shown
from apps.evaluation.score_table import (
    NOT_MEASURED,
    AvatarEvaluation,
    ScoreRow,
    align_markdown,
    evaluations_to_csv,
    evaluations_to_json,
    table_cells,
)
from apps.report.report_figures import CurvePoint, curve_svg, psnr_at
from apps.report.report_page import html_note, html_page, html_section, html_table
from apps.report.report_schema import format_psnr
from avatar.evaluation.image_metrics import overall_verdict
from avatar.evaluation.perceptual import LPIPS_CONVENTIONS, Lpips
from avatar.evaluation.skin_patches import SCORED_PARTS
from capture.atomic_files import atomic_folder

CURVE_SECONDS = {5.0: "5 s", 10.0: "10 s", 60.0: "1 min", 180.0: "3 min", 300.0: "5 min"}
"""Training times at which the quality is listed (Fig. 4 of the paper)."""
CLOCKS = {"wall_seconds": "wall clock", "cpu_seconds": "core-seconds"}
"""Clocks of the learning curve."""
POSES = {
    "given": "given (of the capture, as fitted before training)",
    "fitted": "fitted (to each scored frame, with its exposure; the avatar is frozen)",
    "theirs": "theirs (of the other system; whether they were fitted is not known here)",
}
"""What the kinds of poses are."""
TIME_NOTE = (
    "Held-out PSNR during training, from report.json, estimated from a sample of pixels; linear "
    "between points of the curve, n/a before the first and after the last."
)
Table = list[list[str]]


def write_card(folder: Path, evaluations: Sequence[AvatarEvaluation], lpips: Lpips) -> None:
    """Write card.md, card.csv, card.json and card.html into a folder, all or none.

    Raises:
        InputError: If something in the folder must stay.
        OSError: If the disk is full.
    """
    conditions = card_conditions(evaluations, lpips)
    content = {
        "card.md": card_markdown(evaluations, conditions),
        "card.csv": evaluations_to_csv(evaluations),
        "card.json": evaluations_to_json(evaluations, conditions),
        "card.html": card_page(evaluations, conditions),
    }
    with atomic_folder(folder) as part:
        for name, text in content.items():
            (part / name).write_text(text, encoding="utf-8")


def card_conditions(evaluations: Sequence[AvatarEvaluation], lpips: Lpips) -> dict[str, str]:
    """Return what the scores depend on, by name."""
    here, rows = Hardware.here(), [row for each in evaluations for row in each.rows]
    sizes = dict.fromkeys("{}x{}".format(*each.size) for each in evaluations if each.size)
    package = f"instant-avatar-stream {version('instant-avatar-stream')}"
    conditions = {
        "poses": "; ".join(POSES[poses] for poses in dict.fromkeys(row.poses for row in rows)),
        "background": " and ".join(dict.fromkeys(row.background for row in rows)),
        "resolution": f"{', '.join(sizes)} px",
    }
    for each in evaluations:
        scored = max(len(row.scores) for row in each.rows)
        conditions[f"frames of {each.name}"] = f"{scored} of {each.capture}"
        conditions[f"training of {each.name}"] = _describe_training(each)
    return conditions | {
        "PSNR, SSIM": f"{package}: values in [0, 1]; SSIM on RGB, Gaussian of 11 pixels, σ 1.5",
        **lpips.versions,
        **({} if lpips.unavailable is None else {"LPIPS not measured": lpips.unavailable}),
        "machine": f"{here.processor}, {here.cores} cores, {here.memory_gb} GB, load {here.load}",
        "software": here.software,
        "commit": here.commit,
        "date": here.date,
    }


def card_markdown(evaluations: Sequence[AvatarEvaluation], conditions: dict[str, str]) -> str:
    """Return the card without its pictures."""
    listed = "".join(f"* **{name}**: {value}\n" for name, value in conditions.items())
    parts = [f"# Evaluation of {_names(evaluations)}\n", f"## Conditions\n\n{listed}"]
    for heading, table, note in _tables(evaluations):
        parts.append(f"## {heading}\n\n{align_markdown(table)}" + (f"\n{note}\n" if note else ""))
    return "\n".join(parts)


def card_page(evaluations: Sequence[AvatarEvaluation], conditions: dict[str, str]) -> str:
    """Return the card as a self-contained page."""
    listed = html_table(list(conditions.items()), header=False)
    sections = [html_section("Conditions", f'<div class="card">{listed}</div>')]
    for heading, table, note in _tables(evaluations):
        shown = f'<div class="card scores">{html_table(table)}</div>{html_note(note)}'
        sections.append(html_section(heading, shown))
        if heading == "Quality by time":
            sections += [_curve(each) for each in evaluations]
    sections += [_pictures(each) for each in evaluations] + [_dances(each) for each in evaluations]
    title = f"Evaluation of {_names(evaluations)}"
    body = "\n".join(
        [
            f"<h1>{escape(title)}</h1>",
            '<p class="lead">Compare with other results only under equal conditions.</p>',
            *filter(None, sections),
            "<footer>Written by ia-evaluate of instant-avatar-stream. The same values: card.md, "
            "card.csv (means), card.json (every frame).</footer>",
        ]
    )
    return html_page(title, body)


def _tables(evaluations: Sequence[AvatarEvaluation]) -> list[tuple[str, Table, str]]:
    """Return heading, cells and note of each table with content."""
    regions = (
        "The box is cut out as an image of its own; in the mask, the map of the metric is averaged."
    )
    parts = "PSNR of the pixels nearest to each part of the posed body in view, dB."
    found = [
        ("Scores", table_cells(evaluations), ""),
        ("Image, box and mask", _region_cells(evaluations), regions),
        ("Body parts", _part_cells(evaluations), parts),
        ("Quality by time", _time_cells(evaluations), TIME_NOTE),
    ]
    return [each for each in found if len(each[1]) > 1]


def _region_cells(evaluations: Sequence[AvatarEvaluation]) -> Table:
    """Return SSIM and LPIPS over the image, the box and the mask."""
    metrics = {"ssim": "SSIM"} | {
        f"lpips_{name}": way.label
        for name, way in LPIPS_CONVENTIONS.items()
        if any(row.mean_of(f"lpips_{name}") is not None for e in evaluations for row in e.rows)
    }
    places = ["", " box", " mask"]
    header = [label + place for label in metrics.values() for place in places]
    names = [f"{metric}{region}" for metric in metrics for region in REGIONS]
    return _cells_of_rows(evaluations, header, names, ".4f")


def _part_cells(evaluations: Sequence[AvatarEvaluation]) -> Table:
    names = [f"psnr_{part}" for part in SCORED_PARTS]
    return _cells_of_rows(evaluations, list(SCORED_PARTS), names, ".2f")


def _cells_of_rows(
    evaluations: Sequence[AvatarEvaluation], header: list[str], metrics: list[str], form: str
) -> Table:
    """Return the means of some metrics, a line per row that has any."""
    lines = [["avatar", "drawn by", "poses", "on", *header]]
    for each in evaluations:
        for row in each.rows:
            cells = [_cell(row, metric, form) for metric in metrics]
            if any(cell != NOT_MEASURED for cell in cells):
                lines.append([each.name, row.renderer, row.poses, row.background, *cells])
    return lines


def _cell(row: ScoreRow, metric: str, form: str) -> str:
    mean = row.mean_of(metric)
    return NOT_MEASURED if mean is None else format(mean, form)


def _time_cells(evaluations: Sequence[AvatarEvaluation]) -> Table:
    lines = [["avatar", "clock", "region", *CURVE_SECONDS.values()]]
    for each in evaluations:
        curve = learning_curve(each)
        if not any(point.psnr is not None for point in curve):
            continue
        for clock, label in CLOCKS.items():
            for score, region in (("psnr", "image"), ("psnr_mask", "mask")):
                at = (psnr_at(curve, s, clock=clock, score=score) for s in CURVE_SECONDS)
                cells = (NOT_MEASURED if each is None else f"{each:.2f}" for each in at)
                lines.append([each.name, label, region, *cells])
    return lines


def learning_curve(evaluation: AvatarEvaluation) -> list[CurvePoint]:
    """Return the learning curve in a run's report; empty without one."""
    points = [] if evaluation.report is None else evaluation.report.get("curve", [])
    return [CurvePoint.from_checkpoint(point) for point in points]


def _describe_training(evaluation: AvatarEvaluation) -> str:
    if evaluation.report is None:
        return "not known here"
    training, machine = evaluation.report["training"], evaluation.report["machine"]
    return (
        f"{training['wall_seconds']:.1f} s wall clock, {training['cpu_seconds']:.1f} core-seconds, "
        f"{training['steps']} steps, device {machine['device']}, threads: {machine['threads']}"
    )


def _names(evaluations: Sequence[AvatarEvaluation]) -> str:
    return ", ".join(each.name for each in evaluations)


def _curve(evaluation: AvatarEvaluation) -> str:
    svg = curve_svg(learning_curve(evaluation))
    legend = (
        f'<p class="legend">{escape(evaluation.name)}: mean PSNR of held-out frames'
        '<i style="background:var(--whole)"></i>whole image'
        '<i style="background:var(--masked)"></i>inside the mask</p>'
    )
    return f'<div class="card">{svg}{legend}</div>' if svg else ""


def _pictures(evaluation: AvatarEvaluation) -> str:
    """Frames from the worst to the best: truth, avatar and error."""
    figures = "".join(
        f'<figure style="width:{3 * shown.width + 2}px"><div class="three">'
        + "".join(
            f'<img src="{uri}" alt="frame {shown.score.frame}: {what}">'
            for uri, what in (
                (shown.truth, "truth"),
                (shown.rendering, "avatar"),
                (shown.error, "error"),
            )
        )
        + f"</div><figcaption>frame {shown.score.frame}: "
        f"{format_psnr(shown.score.psnr, overall_verdict([shown.score]))}, "
        f"{shown.score.psnr_mask:.2f} dB in the mask</figcaption></figure>"
        for shown in choose_shown(evaluation.shown)
    )
    heading = f"Truth, avatar, error: {escape(evaluation.name)}"
    note = html_note(
        "From the worst to the best frame in the mask, at the resolution of the scores where the "
        f"page is wide enough. Error: mean over RGB, brightest from {LARGEST_SHOWN_ERROR:.2f} of 1."
    )
    return html_section(heading, f'<div class="shown">{figures}</div>{note}' if figures else "")


def _dances(evaluation: AvatarEvaluation) -> str:
    figures = "".join(
        f'<figure class="novel"><img src="{uri}" alt="{escape(name)}"><figcaption>{escape(name)}, '
        "drawn by the player</figcaption></figure> "
        for name, uri in evaluation.dances.items()
    )
    return html_section(f"Novel poses: {escape(evaluation.name)}", figures)
