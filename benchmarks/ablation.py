"""The paper's ablations side by side: losses, empty-space skipping, root finding, refinement.

    python -m benchmarks.ablation [--quick] [--seconds S] [--json FILE] [--write docs/ablation.md]

All variants of a table are trained in turns in one process, with one thread, each for the same
seconds of one core and then again for the same number of steps; they are scored by the exact
renderer on held-out frames and on poses that were never filmed. There are no thresholds here.
"""

import json
import sys
import tempfile
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import torch
import tyro

from apps.recording.recording import Recording
from avatar.hold import HeldOut
from avatar.model import Avatar
from avatar.prepare import PreparedFrame
from avatar.rig import Rig
from benchmarks.ablation_page import Page, written
from benchmarks.hardware import Hardware
from benchmarks.in_turns import Budget, Outcome, Run, Variant, outcome, trained
from benchmarks.quality import NOISE, novel_pictures, truly_posed
from benchmarks.schemes import Drawn, drawn
from benchmarks.stage import assembled, filmed, opened, recipe
from benchmarks.stopwatch import use_threads

DRAWN = 3
"""Novel poses that every scheme draws."""
PAPER = "union grid, Broyden (the paper)"
GIVEN = {"refine_poses": False}
LOSSES = [
    Variant(name="full", changes=GIVEN),
    Variant(name="w/o alpha loss", changes={**GIVEN, "alpha_weight": 0.0}),
    Variant(name="w/o hard surface", changes={**GIVEN, "hard_weight": 0.0}),
    Variant(name="w/o occupancy-based regulariser", changes={**GIVEN, "empty_weight": 0.0}),
    Variant(name="w/o total variation", changes={**GIVEN, "variation_weight": 0.0}),
    Variant(name="global sparsity instead", changes={**GIVEN, "empty_term": "global"}),
]
CELLS = [
    Variant(name="union grid, cells", changes={**GIVEN, "skipping": "union"}),
    Variant(name="per-frame grids, cells", changes={**GIVEN, "skipping": "frame"}),
    Variant(name="no skipping, cells", changes={**GIVEN, "skipping": "none", "empty_weight": 0.0}),
]
BROYDEN = [
    Variant(name="canonical occupancy, Broyden", changes={**GIVEN, "roots": "broyden"}),
    Variant(
        name=PAPER,
        changes={**GIVEN, "roots": "broyden", "skipping": "union"},
    ),
    Variant(
        name="no skipping, Broyden",
        changes={**GIVEN, "roots": "broyden", "skipping": "none", "empty_weight": 0.0},
    ),
]
REFINEMENT = [
    Variant(name="poses as given", changes=GIVEN),
    Variant(name="poses refined", changes={"refine_poses": True}),
]


@dataclass(frozen=True, kw_only=True)
class Ablation:
    """Trains every variant, and prints the tables."""

    quick: bool = False
    """Two seconds and twenty steps each: whether it runs, not what comes out."""
    size: int = 128
    """Width and height of the pictures."""
    seconds: float = 20.0
    """Core seconds for each variant."""
    steps: int = 400
    """Steps for each variant, where they are counted."""
    device: str = "cpu"
    """Where to train."""
    json: Path | None = None
    """File for the figures."""
    write: Path | None = None
    """Markdown file whose tables are written anew; what stands outside its marks is kept."""
    keep: Path | None = None
    """Folder for what is filmed; what lies there is used again."""


class Scene(NamedTuple):
    """What is trained on, and what is scored."""

    recording: Recording
    rig: Rig
    frames: list[PreparedFrame]
    held: list[HeldOut]
    novel: list[HeldOut]


def main() -> None:
    """The benchmark."""
    job = tyro.cli(Ablation, prog="python -m benchmarks.ablation", description=__doc__)
    if job.quick:
        job = Ablation(**{**vars(job), "seconds": 2.0, "steps": 20})
    hardware = Hardware.here()
    with tempfile.TemporaryDirectory() as temporary:
        page = measured(job, hardware, job.keep or Path(temporary))
    print("\n".join(page.lines()))
    if job.json is not None:
        job.json.write_text(json.dumps(asdict(page), indent=1) + "\n")
    if job.write is not None:
        job.write.write_text(written(page, job.write))


def measured(job: Ablation, hardware: Hardware, folder: Path) -> Page:
    """Everything, table after table; each row is told on standard error as it comes."""
    began, device = time.process_time(), torch.device(job.device)
    scene = staged(filmed(folder / f"sample{job.size}", job.size), device)
    runs = trained_on(scene, [*LOSSES, *CELLS, *BROYDEN], Budget(seconds=job.seconds), device)
    by_time = told(runs, scene)
    occupancy_ms, ours = upkeep_ms(runs[0]), runs[0].trainer.avatar
    del runs
    counted = Budget(steps=job.steps)
    runs = trained_on(scene, [LOSSES[0], *CELLS, *BROYDEN], counted, device)
    by_steps = told(runs, scene)
    schemes = by_schemes(ours, _of(runs, PAPER).trainer.avatar, scene)
    del runs
    noisy_capture = filmed(folder / f"noisy{job.size}", job.size, **NOISE)
    noisy = staged(noisy_capture, device)
    noisy = noisy._replace(held=truly_posed(noisy_capture, noisy.held, noisy.rig))
    budget = Budget(seconds=job.seconds)
    return Page(
        hardware=hardware.lines(),
        size=job.size,
        seconds=job.seconds,
        steps=job.steps,
        pictures=(len(scene.frames), len(scene.held), len(scene.novel), DRAWN),
        occupancy_ms=occupancy_ms,
        losses=by_time[: len(LOSSES)],
        by_time=[by_time[0], *by_time[len(LOSSES) :]],
        by_steps=by_steps,
        drawn=schemes,
        exact=told(trained_on(scene, REFINEMENT, budget, device), scene),
        noisy=told(trained_on(noisy, REFINEMENT, budget, device), noisy),
        core_minutes=(time.process_time() - began) / 60.0,
    )


def staged(capture: Path, device: torch.device) -> Scene:
    """A filmed sample, every frame made ready."""
    use_threads(1)
    recording = opened(capture)
    rig = Rig.of(recording.shaped)
    seen = assembled(recording, rig, recipe(recording, 60.0), device)
    return Scene(recording, rig, seen.frames, seen.held, novel_pictures(capture, rig))


def trained_on(
    scene: Scene, variants: list[Variant], budget: Budget, device: torch.device
) -> list[Run]:
    """Every variant after its budget."""
    return trained(variants, budget, scene.recording, scene.rig, scene.frames, device)


def told(runs: Iterable[Run], scene: Scene) -> list[Outcome]:
    """What became of them."""
    outcomes = []
    for run in runs:
        outcomes.append(outcome(run, scene.held, scene.novel))
        print(outcomes[-1], file=sys.stderr, flush=True)
    return outcomes


def upkeep_ms(run: Run) -> float:
    """What keeping the canonical occupancy costs a step: every variant pays it, ours alone must."""
    every = run.trainer.config.occupancy_every
    began = time.process_time()
    for _ in range(3):
        run.trainer._update_occupancy(0.0)
    return 1000.0 * (time.process_time() - began) / 3 / every


def _of(runs: list[Run], name: str) -> Run:
    return next(run for run in runs if run.variant.name == name)


def by_schemes(ours: Avatar, theirs: Avatar, scene: Scene) -> list[Drawn]:
    """Two avatars, ours and that of the paper's own training, drawn by each scheme."""
    step = max(1, len(scene.novel) // DRAWN)
    pictures = scene.novel[::step][:DRAWN]
    rows = [
        drawn("canonical occupancy, cells", ours, pictures, skipping="canonical", roots="cells"),
        drawn("per-frame grid, cells", ours, pictures, skipping="frame", roots="cells"),
        drawn("no skipping, cells", ours, pictures, skipping="none", roots="cells"),
        drawn(
            "per-frame grid, Broyden (the paper)", theirs, pictures,
            skipping="frame", roots="broyden",
        ),
        drawn("no skipping, Broyden", theirs, pictures, skipping="none", roots="broyden"),
    ]  # fmt: skip
    for row in rows:
        print(row, file=sys.stderr, flush=True)
    return rows


if __name__ == "__main__":
    main()
