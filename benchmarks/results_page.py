"""docs/results.md: tables of all subjects, and the paper's own figures beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from baselines.comparison_scores import CURVE_FRAMES
from baselines.comparison_table import markdown, number, step_cost, time_to_reach, with_better_poses

BEGIN, END = "<!-- tables: begin -->", "<!-- tables: end -->"
REQUIRED_GAIN_DB = 5.0
"""What ours must win over Anim-NeRF in a minute, novel poses; the paper shows 15 on its data."""
PAPER_SURREAL = {
    "Anim-NeRF": ("21.66 / .9450", "20.00 / .9483", "20.06 / .9326"),
    "InstantAvatar": ("24.48 / .9353", "23.94 / .9354", "25.08 / .9494"),
}
"""The paper, table of synthetic subjects: PSNR / SSIM in novel poses of S1 to S3."""
PAPER_SNAPSHOT = {
    "Neural Body, ~14 h": ("24.94 / .9428", "24.71 / .9469", "23.87 / .9504", "24.37 / .9451"),
    "Anim-NeRF, ~13 h": ("29.37 / .9703", "28.37 / .9605", "28.91 / .9743", "28.90 / .9678"),
    "InstantAvatar, 1 min": ("29.65 / .9730", "27.97 / .9649", "27.90 / .9722", "28.92 / .9692"),
}
"""The paper, Tab. 1: PSNR / SSIM of PeopleSnapshot's test frames, in poses fitted to them."""


@dataclass(frozen=True, kw_only=True)
class ComparedSample:
    """A sample, and for how long the methods were trained on it."""

    subject: int
    kind: Literal["phone", "exact"]
    seconds: float

    @property
    def actor(self) -> Literal[1, 2, 3]:
        """Number of the studio's actor."""
        return 1 if self.subject == 1 else 2 if self.subject == 2 else 3

    @property
    def name(self) -> str:
        """Of the sample's folder."""
        return f"S{self.subject}-{self.kind}"


Found = Mapping[ComparedSample, Sequence[Mapping[str, Any]]]


def results_lines(found: Found, conditions: Sequence[str]) -> list[str]:
    """The tables as Markdown; phone-like samples come first in each."""
    found = {sample: [with_better_poses(each) for each in some] for sample, some in found.items()}
    told = [*_made_on_lines(found), *conditions]
    lines = ["`python -m benchmarks.results`", "", *(f"* {line}" for line in told)]
    for seconds in sorted({sample.seconds for sample in found}):
        part = {sample: results for sample, results in found.items() if sample.seconds == seconds}
        budget = f"{seconds:g} core-seconds"
        for kind, title in (("novel", "Novel poses"), ("held_out", "Held-out frames")):
            lines += ["", f"## {title} after {budget}"]
            for poses, what in (("_fitted", "In fitted poses"), ("", "In the poses given")):
                lines += ["", f"{what}: PSNR in dB / SSIM, on white.", ""]
                lines += [*_score_table(part, kind + poses)]
                lines += _gain_lines(part, kind + poses)
        lines += ["", f"## Novel poses over time, in runs of {budget}", ""]
        lines += [
            f"PSNR in fitted poses on {CURVE_FRAMES} of the twelve, within a run of {budget}. Last "
            "column: core time until a method is as good as ours at the end; beyond the run it is "
            "extrapolated by the gain of its last doubling of time.", "",
            *_time_table(part), "",
            f"Core-ms of a step, and steps, in runs of {budget}:", "",
            *_step_table(part),
        ]  # fmt: skip
    return [*lines, "", *_paper_lines()]


def _made_on_lines(found: Found) -> list[str]:
    """Commits, machines, versions and times, from the score files."""
    made = [each["made_on"] for results in found.values() for each in results]
    commits = sorted({each["commit"] for each in made})
    dates, loads = sorted(each["date"] for each in made), [each["load"] for each in made]
    machines = dict.fromkeys(
        f"{each['processor']}, {each['cores']} cores, {each['memory_gb']} GB; {each['software']}"
        for each in made
    )
    lines = [f"commit {', '.join(commits)}; {dates[0]} to {dates[-1]}", *machines]
    lines.append(f"{min(loads):g} to {max(loads):g} processes wanted a core when each method began")
    newest = max(made, key=lambda each: each["date"])["commit"]
    for commit in (each for each in commits if each != newest):
        cells = []
        for sample, results in found.items():
            names = [r["method"] for r in results if r["made_on"]["commit"] == commit]
            if names:
                cells.append(f"{', '.join(names)} on {_title(sample)}, {sample.seconds:g} s")
        lines.append(f"of another commit, {commit}: {'; '.join(cells)}")
    return lines


def _score_table(found: Found, kind: str) -> list[str]:
    rows = []
    for method in _methods(found):
        cells = [_result(results, method) for results in found.values()]
        rows.append([method, *(_scores(None if each is None else each[kind]) for each in cells)])
    return markdown(["", *(_title(sample) for sample in found)], rows)


def _scores(scores: Mapping[str, float] | None) -> str:
    return "-" if scores is None else f"{number(scores['psnr'], 2)} / {number(scores['ssim'], 4)}"


def _gain_lines(found: Found, kind: str) -> list[str]:
    """What ours wins over Anim-NeRF on each sample."""
    gains = {}
    for sample, results in found.items():
        ours, theirs = _result(results, "ours"), _result(results, "anim-nerf")
        if ours is not None and theirs is not None:
            gains[_title(sample)] = ours[kind]["psnr"] - theirs[kind]["psnr"]
    if not gains:
        return []
    told = ", ".join(f"{title} {gain:+.1f} dB" for title, gain in gains.items())
    met = sum(gain >= REQUIRED_GAIN_DB for gain in gains.values())
    return [
        "",
        f"Ours over Anim-NeRF: {told}. At least +{REQUIRED_GAIN_DB:g} dB on {met} of {len(gains)}.",
    ]


def _step_table(found: Found) -> list[str]:
    rows = []
    for method in _methods(found):
        each = [_result(results, method) for results in found.values()]
        cells = ("-" if one is None else f"{step_cost(one)}: {one['steps']:,}" for one in each)
        rows.append([method, *cells])
    return markdown(["", *(_title(sample) for sample in found)], rows)


def _time_table(found: Found) -> list[str]:
    rows, times = [], [0.0]
    for sample, results in found.items():
        ours = _result(results, "ours")
        for each in results:
            times = [point["core_seconds"] for point in each["curve"]] or times
            missing = "-"
            if ours is not None and each["method"] != "ours" and each["curve"]:
                wanted = ours["curve"][-1]["novel"]
                missing = time_to_reach(each["curve"], "novel", wanted)
            values = [number(point["novel"], 2) for point in each["curve"]]
            rows.append([_title(sample), each["method"], *values, missing])
    head = ["", "", *(f"{time:.0f} s" for time in times), "as good as ours at the end"]
    width = len(head)
    return markdown(head, [[*row[:-1], *["-"] * (width - len(row)), row[-1]] for row in rows])


def _paper_lines() -> list[str]:
    """The paper's figures, as theirs."""
    return [
        "## The paper's own figures",
        "",
        "On their data and machine (RTX 3090). SURREAL's bodies, novel poses, PSNR / SSIM:",
        "",
        *markdown(["", "S1", "S2", "S3"], [[name, *row] for name, row in PAPER_SURREAL.items()]),
        "",
        "PeopleSnapshot's test frames in poses fitted to them, PSNR / SSIM:",
        "",
        *markdown(
            ["", "male-3", "male-4", "female-3", "female-4"],
            [[name, *row] for name, row in PAPER_SNAPSHOT.items()],
        ),
    ]


def _methods(found: Found) -> list[str]:
    return list(dict.fromkeys(each["method"] for results in found.values() for each in results))


def _result(results: Sequence[Mapping[str, Any]], method: str) -> Mapping[str, Any] | None:
    return next((each for each in results if each["method"] == method), None)


def _title(sample: ComparedSample) -> str:
    return f"S{sample.subject} {'phone-like' if sample.kind == 'phone' else 'exact'}"
