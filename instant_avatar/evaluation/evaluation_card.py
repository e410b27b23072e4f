"""The evaluation's page: conditions, scores and images."""

from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version

from avatar.evaluation.perceptual import Lpips
from instant_avatar.cli.hardware import describe_machine
from instant_avatar.evaluation.frame_scoring import LARGEST_SHOWN_ERROR, choose_shown
from instant_avatar.evaluation.score_table import AvatarEvaluation, compare_avatars, table_cells
from instant_avatar.report.page_rendering import render_template

POSES = {
    "given": "given (in a file, fitted before training)",
    "tracked": "tracked (by ia-ingest in the video, fitted before training)",
    "fitted": "fitted (to each scored frame, with its exposure; the avatar is frozen)",
}
"""Kinds of poses, for the reader of the page."""


def evaluation_conditions(evaluations: Sequence[AvatarEvaluation], lpips: Lpips) -> dict[str, str]:
    """Return what the scores depend on, by name."""
    here, rows = describe_machine(), [row for each in evaluations for row in each.rows]
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
        "LPIPS": lpips.describe(),
        "machine": "{processor}, {cores} cores, {memory_mb} MB".format(**here),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    }


def evaluation_page(evaluations: Sequence[AvatarEvaluation], conditions: dict[str, str]) -> str:
    """Return the self-contained page."""
    return render_template(
        "evaluation.html",
        title=f"Evaluation of {', '.join(each.name for each in evaluations)}",
        conditions=conditions,
        table=table_cells(evaluations),
        comparison=compare_avatars(evaluations),
        shown={each.name: choose_shown(each.shown) for each in evaluations if each.shown},
        largest_error=LARGEST_SHOWN_ERROR,
    )


def _describe_training(evaluation: AvatarEvaluation) -> str:
    if evaluation.report is None:
        return "not known here"
    training, machine = evaluation.report["training"], evaluation.report["machine"]
    return (
        f"{training['wall_seconds']:.1f} s wall clock, {training['cpu_seconds']:.1f} core-seconds, "
        f"{training['steps']} steps, device {machine['device']}, threads: {machine['threads']}"
    )
