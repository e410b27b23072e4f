"""The ablation's tables as Markdown; the paper's beside what its own say."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean

from benchmarks.measurements import format_value as number
from benchmarks.mechanisms import (
    FEW_FRAME_MECHANISMS,
    MECHANISMS,
    MORE_STEPS,
    CaptureScores,
    Mechanism,
    MechanismScore,
)
from benchmarks.paired_training import VariantOutcome
from benchmarks.scheme_timing import SchemeTiming

COMMAND = "python -m benchmarks.ablation --tables {} --write docs/ablation.md"
SCORES = ("novel PSNR", "in the mask", "SSIM", "held-out PSNR", "in the mask", "SSIM")


@dataclass(frozen=True, kw_only=True)
class AblationPage:
    """All figures of a run.

    Attributes:
        hardware: Where and when.
        size: Of the pictures, pixels.
        seconds, steps: What each variant was given.
        pictures: Frames learnt, held out; novel poses scored, and drawn by each scheme.
        occupancy_ms: What keeping the canonical occupancy costs a step.
        losses: One by one.
        by_time, by_steps: Skipping and root finding, for both budgets.
        drawn: Rendering by each scheme.
        exact, noisy: Refinement of exact and of noisy poses.
        core_minutes: What all of it took.

    A table without figures (all but `losses` and `by_time` may have none) is left out.
    """

    hardware: list[str]
    size: int
    seconds: float
    steps: int
    pictures: tuple[int, int, int, int]
    occupancy_ms: float
    losses: list[VariantOutcome]
    by_time: list[VariantOutcome]
    by_steps: list[VariantOutcome]
    scheme_timings: list[SchemeTiming]
    exact: list[VariantOutcome]
    noisy: list[VariantOutcome]
    core_minutes: float

    def lines(self) -> list[str]:
        """The tables, and what must be known to read them."""
        learnt, held, novel, some = self.pictures
        return [
            f"`{COMMAND.format('paper')}`",
            "",
            *(f"* {line}" for line in self.hardware),
            f"* `ia-sample` at {self.size} px: {learnt} frames learnt, {held} held out, {novel} "
            f"poses never filmed; one thread, {self.seconds:g} core-seconds or {self.steps} steps "
            f"each, taking turns; {self.core_minutes:.0f} core-minutes in all",
            "",
            *self._losses(),
            *self._skipping(),
            *self._rendering(some),
            *self._refinement(),
        ]

    def _losses(self) -> list[str]:
        rows = [_scored(row, f"{row.steps:,}") for row in self.losses]
        return [
            f"## Losses, one by one ({self.seconds:g} core-seconds)",
            "",
            *_table(("", "steps", *SCORES), rows),
            "",
            "The paper, Tab. 4 (PeopleSnapshot, 100 epochs): without the occupancy-based "
            "regulariser 28.22 dB, SSIM .9680; with it 28.64 dB, .9700. Of global sparsity it "
            "shows a picture (Fig. 5, semi-transparent) and no figure, of the other terms neither.",
            "",
        ]

    def _skipping(self) -> list[str]:
        ours = self.by_time[0]
        by_time = self.by_time
        lines = [f"## Empty-space skipping and root finding in training ({self.seconds:g} core-s)"]
        lines += ["", *self._paced(by_time), ""]
        if self.by_steps:
            lines += [f"The same after {self.steps} steps:", "", *self._paced(self.by_steps), ""]
        longer = self.by_steps or by_time
        paper, none = (
            _named(longer, name)
            for name in ("union grid, Broyden (the paper)", "no skipping, Broyden")
        )
        unskipped = _named(by_time, "no skipping, cells")
        return [
            *lines,
            "The paper, Tab. 3: 100 epochs in 3m10s without skipping, 1m47s with it: 1.78 times. "
            f"Here ours is {number(unskipped.late_ms / ours.late_ms)} times faster with skipping "
            "than without, by the last fifth of the time; the paper's own scheme "
            f"{number(none.late_ms / paper.late_ms)} times, by the last fifth of {paper.steps} "
            "steps. Every row also keeps the canonical occupancy that its avatar is scored with: "
            f"{self.occupancy_ms:.1f} ms of each step, which only ours needs. Broyden is compiled, "
            "and searches nine times for each sample.",
            "",
        ]

    def _paced(self, rows: Sequence[VariantOutcome]) -> list[str]:
        head = ("", "ms a step", "late ones", "samples a ray", "steps", *SCORES)
        full = self.by_time[0].name
        return _table(
            head,
            [
                _scored(
                    row, number(row.step_ms), number(row.late_ms), number(row.samples),
                    f"{row.steps:,}",
                    name="canonical occupancy, cells (ours)" if row.name == full else row.name,
                )
                for row in rows
            ],
        )  # fmt: skip

    def _rendering(self, some: int) -> list[str]:
        if not self.scheme_timings:
            return []
        rows = [
            (
                row.name, number(row.setup_ms), number(row.render_ms),
                f"{row.quality.psnr:.2f}", f"{row.quality.psnr_mask:.2f}",
                f"{row.quality.ssim:.4f}",
            )
            for row in self.scheme_timings
        ]  # fmt: skip
        return [
            f"## Skipping in rendering ({some} novel poses, core-ms, medians)",
            "",
            *_table(("", "a new pose", "its picture", "PSNR", "in the mask", "SSIM"), rows),
            "",
            "The first three draw our avatar, the others that of the paper's own training above. "
            "The paper, Tab. 3: ~1 FPS without skipping, ~15 FPS with it (540×540, RTX 3090).",
            "",
        ]

    def _refinement(self) -> list[str]:
        if not self.exact:
            return []
        rows = [
            *(_scored(row, f"{row.steps:,}", name=f"exact, {row.name}") for row in self.exact),
            *(
                _scored(row, f"{row.steps:,}", name=f"off by 2° and 1 cm, {row.name}")
                for row in self.noisy
            ),
        ]
        return [
            f"## Pose refinement ({self.seconds:g} core-seconds, scored in the true poses)",
            "",
            *_table(("poses", "steps", *SCORES), rows),
            "",
            "The paper keeps Anim-NeRF's poses and has no such table.",
        ]


def mechanism_lines(captures: Sequence[CaptureScores]) -> list[str]:
    """What each mechanism buys: a table of the whole films, and one of the few frames."""
    lines = [f"`{COMMAND.format('mechanisms')}`", ""]
    for title, rows in (
        ("Mechanisms, one by one", MECHANISMS),
        ("Few-frame priors, one by one", FEW_FRAME_MECHANISMS),
    ):
        names = {row.name for row in rows[2:]}
        found = [each for each in captures if names & {score.name for score in each.scores}]
        if not found:
            continue
        lines += [f"## {title}", ""]
        lines += [
            f"* {each.capture}, {each.size_px} px, seed {each.seed}, {each.steps} steps: "
            f"{each.measured}; with all mechanisms {_levels(each.scores[0])}, "
            f"{each.scores[0].step_ms:.1f} core-ms a step"
            for each in found
        ]
        head = ["without", "core-ms saved", *(f"{c.capture}, seed {c.seed}" for c in found)]
        head += ["mean loss, dB", "its time would buy, dB", "lines"]
        lines += ["", *_table(head, _mechanism_cells(rows, found)), ""]
    return lines[:-1]


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
    """`_loss`, how much less the player is like the renderer, and how much more is fog."""
    losses = _loss(full, without)
    if full.player is not None and without.player is not None:
        losses.append(full.player - without.player)
    text = " / ".join(f"{loss:+.2f}" for loss in losses)
    if full.half_transparent is None or without.half_transparent is None:
        return text
    return f"{text}, {100.0 * (without.half_transparent - full.half_transparent):+.1f} % fog"


def _levels(score: MechanismScore) -> str:
    novel = "" if score.novel is None else f"{score.novel:.2f} dB novel, "
    player = "" if score.player is None else f", player to renderer {score.player:.2f} dB"
    fog = score.half_transparent
    firm = "" if fog is None else f", {100.0 * fog:.1f} % of the pixels half transparent"
    return f"{novel}{score.held_out:.2f} dB held out{player}{firm}"


def written(mark: str, lines: Sequence[str], path: Path) -> str:
    """The file's text with the tables of a mark replaced and the text around them kept."""
    begin, end = f"<!-- {mark}: begin -->", f"<!-- {mark}: end -->"
    before, after = "# What each mechanism buys\n\n", "\n"
    if path.exists():
        text = path.read_text()
        before, after = text + "\n", "\n"
        if begin in text and end in text:
            before, after = text.split(begin)[0], text.split(end)[1]
    return before + "\n".join([begin, *lines, end]) + after


def _named(rows: Sequence[VariantOutcome], name: str) -> VariantOutcome:
    return next(row for row in rows if row.name == name)


def _scored(row: VariantOutcome, *first: str, name: str | None = None) -> tuple[str, ...]:
    scores = [
        text
        for quality in (row.novel, row.held_out)
        for text in (f"{quality.psnr:.2f}", f"{quality.psnr_mask:.2f}", f"{quality.ssim:.4f}")
    ]
    return (name or row.name, *first, *scores)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    rule = ["---", *["--:"] * (len(head) - 1)]
    return ["| " + " | ".join(cells) + " |" for cells in (head, rule, *rows)]
