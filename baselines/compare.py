"""python -m baselines.compare: train several systems for equal core time, and score them alike."""

import json
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from baselines.comparison_table import comparison_table
from capture.atomic_files import OutputFileList, atomic_file, atomic_folder, write_text_atomically
from capture.input_error import InputError
from instant_avatar.cli.command_line import (
    DONE,
    INTERRUPTED,
    parse_arguments,
    run_command,
    stop_on_interrupt,
)
from instant_avatar.cli.console import Console

if TYPE_CHECKING:  # torch is loaded after --help has been answered
    from baselines.systems.compared_capture import ComparedCapture

PROGRAM = "python -m baselines.compare"
Method = Literal["anim-nerf", "ours"]
MARKS_S = (5.0, 10.0, 30.0, 60.0, 180.0, 300.0)
"""Core seconds after which the curve is scored."""
STEP_MARKS = (1 / 12, 1 / 6, 1 / 2)
"""The same where steps are counted, as shares of them."""
MIN_COLUMN_PX = 100
"""Width of a column of the sheet above which pictures are not enlarged."""


@dataclass(frozen=True, kw_only=True)
class CompareArguments:
    """Train other systems' methods and ours for equal core time, and score them by one ruler.

    Try it:

        ia-sample sample --size 128 --frames 60

        python -m baselines.compare sample --out comparison --seconds 20

    All systems get the same capture (poses and body fitted to its masks as by ia-ingest), the same
    frames, rays and decay of learning rates, and one thread. Time is that of the processor, so that
    other programs hardly count; scoring is not charged, and neither is compiling kernels. Baselines
    are our own implementations of their papers, in plain torch. Scores are those in the given poses
    and in poses fitted to the scored pictures; the fit is the same for all systems, has the same
    budget, and uses nothing of a system but its pictures.

        anim-nerf   inverse skinning by the nearest vertices, a NeRF, poses optimized
        ours        the product

    The preset "small" is each method at the size that learns most in a minute of one core; "paper"
    has the paper's sizes, of which a step takes seconds to minutes (Anim-NeRF: 8 GB of memory).

    OUT then holds table.md, pictures.png (truth, then each method), and for each method scores.json
    (with commit, machine, versions and the curve) and its pictures of held-out frames and, for a
    sample, of novel poses. A method that is there already is not trained again; Ctrl-C keeps those
    that are done.

    Exit codes: 0 done, 2 bad input, 3 disk full, 130 Ctrl-C.
    """

    capture: Annotated[Positional[Path], arg(metavar="CAPTURE", help_behavior_hint="")]
    """Folder of a capture: a sample, or what ia-ingest takes (poses included)."""
    methods: tuple[Method, ...] = ("anim-nerf", "ours")
    """What is compared, in the order of the table."""
    seconds: float = 60.0
    """Core seconds of each method."""
    steps: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Steps of each method, instead of --seconds."""
    preset: Literal["small", "paper"] = "small"
    """Sizes of the baselines."""
    size: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Longer side of the images (default: as they are)."""
    seed: int = 0
    """Seed of all random numbers."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("comparison")
    """Folder to write."""
    overwrite: Annotated[bool, FlagCreatePairsOff] = False
    """Train methods again that are in OUT already."""

    def validate(self) -> None:
        """Checks ranges and folders.

        Raises:
            InputError: Naming the option.
        """
        if not 0.0 < self.seconds < float("inf"):
            raise InputError(f"--seconds is {self.seconds}, but must be positive.")
        if self.steps is not None and self.steps < 1:
            raise InputError(f"--steps is {self.steps}, but must be at least 1.")
        if self.size is not None and self.size < 16:
            raise InputError(f"--size is {self.size}, but must be at least 16 pixels.")
        if not self.methods:
            raise InputError("--methods is empty; name at least one, such as anim-nerf ours.")
        if not self.capture.exists():
            raise InputError(f"{self.capture} does not exist; expected a capture's folder.")
        if self.out.is_file():
            raise InputError(f"--out is {self.out}, which is a file, but must be a folder.")
        if self.out.is_dir() and any(self.out.iterdir()) and not OutputFileList(self.out).exists():
            raise InputError(
                f"--out is {self.out}, which holds files of others. Name a new or an empty folder."
            )

    def conditions(self, method: str) -> dict[str, Any]:
        """What a method's result depends on, by option."""
        return {
            "capture": str(self.capture.resolve()),
            "seconds": None if self.steps else self.seconds,
            "steps": self.steps,
            "preset": None if method == "ours" else self.preset,
            "size": self.size,
            "seed": self.seed,
        }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    given = parse_arguments(CompareArguments, PROGRAM, argv)
    return run_command(PROGRAM, lambda: compare(given, Console()))


def compare(arguments: CompareArguments, console: Console) -> int:
    """Train, score and write what is not there yet, then table and pictures.

    Raises:
        InputError: If the capture cannot be used, or OUT holds other results.
        OSError: If the disk is full; the methods that are done are kept.
    """
    arguments.validate()
    names = list(dict.fromkeys(arguments.methods))
    missing = [name for name in names if arguments.overwrite or not _is_done(arguments, name)]
    arguments.out.mkdir(parents=True, exist_ok=True)
    OutputFileList(arguments.out).create()
    data = None
    with stop_on_interrupt(console, "the methods that are done are kept") as stop:
        if missing:
            with console.status("opening the capture, compiling kernels"):
                import numba
                import torch

                from baselines.systems.compared_capture import ComparedCapture

                torch.set_num_threads(1)
                numba.set_num_threads(1)
                data = ComparedCapture.open(arguments.capture, arguments.size)
        for name in missing:
            if data is not None and not stop.is_set():
                _train_method(name, data, arguments, console, stop)
    done = [name for name in names if (arguments.out / name / "scores.json").is_file()]
    results = [json.loads((arguments.out / name / "scores.json").read_text()) for name in done]
    if results:
        table = comparison_table(results)
        write_text_atomically(arguments.out / "table.md", table)
        _write_sheet(arguments.out, done)
        print(table, end="")  # noqa: T201 - the table goes to stdout, for scripts
    return INTERRUPTED if stop.is_set() else DONE


def _is_done(arguments: CompareArguments, name: str) -> bool:
    """Whether a method was trained before, under the same conditions, and is to be kept."""
    scores = arguments.out / name / "scores.json"
    if not scores.is_file():
        return False
    kept = json.loads(scores.read_text())
    before, now = kept["conditions"], arguments.conditions(name)
    changed = [
        f"{key} {before.get(key)}, now {now[key]}" for key in now if before.get(key) != now[key]
    ]
    if changed and not arguments.overwrite:
        raise InputError(
            f"{scores.parent} was trained with {'; '.join(changed)}. Choose another --out, or "
            "train again with --overwrite."
        )
    return not changed


def _train_method(
    name: str,
    data: "ComparedCapture",
    arguments: CompareArguments,
    console: Console,
    stop: threading.Event,
) -> None:
    """Trains a method, and writes its folder whole; nothing if it is stopped."""
    from baselines.comparison_scores import curve_point, score_all
    from baselines.hardware import Hardware
    from baselines.systems.compared_systems import make_system, train_config

    made_on = asdict(Hardware.here())
    config = train_config(data, arguments.seconds, arguments.steps, seed=arguments.seed)
    began = time.process_time()
    system = make_system(name, data, config, preset=arguments.preset, seed=arguments.seed)
    spent = time.process_time() - began + (data.ready_seconds if name == "ours" else 0.0)
    curve: list[dict[str, Any]] = []
    marks = _marks(arguments)
    with console.progress(f"training {name}", 1.0) as bar:
        while (progress := _progress(arguments, spent, system.steps)) < 1.0 and not stop.is_set():
            began = time.process_time()
            system.step(progress)
            spent += time.process_time() - began
            progress = _progress(arguments, spent, system.steps)
            bar.update(progress, f"{system.steps} steps, {spent:.0f} core-s")
            if marks and progress >= marks[0]:
                curve.append(asdict(curve_point(system, data, spent)))
                marks = [mark for mark in marks if mark > progress]
    if stop.is_set():
        return
    began = time.process_time()
    with atomic_folder(arguments.out / name) as folder, console.status(f"scoring {name}"):
        found = {
            "method": name,
            "conditions": arguments.conditions(name),
            "made_on": made_on,
            "core_seconds": spent,
            "steps": system.steps,
            "training_frames": len(data.frames),
            "picture_px": data.held_out[0].observation.camera.size_px,
            "poses": "estimated" if data.capture.pose_uncertainty > 0.5 else "exact",
            "curve": curve,
            **score_all(system, data, folder),
            "scoring_core_seconds": time.process_time() - began,
        }
        (folder / "scores.json").write_text(json.dumps(found, indent=1) + "\n")
    novel = found["novel_fitted"]["psnr"]
    shown = found["held_out_fitted"]["psnr"] if novel is None else novel
    console.info(f"{name}: {system.steps} steps, {shown:.2f} dB in fitted poses")


def _progress(arguments: CompareArguments, spent: float, steps: int) -> float:
    return steps / arguments.steps if arguments.steps else spent / arguments.seconds


def _marks(arguments: CompareArguments) -> list[float]:
    """Shares of the budget at which the curve is scored."""
    if arguments.steps:
        return [*STEP_MARKS, 1.0]
    return [*(mark / arguments.seconds for mark in MARKS_S if mark < arguments.seconds), 1.0]


def _write_sheet(out: Path, done: list[str]) -> None:
    """pictures.png: a row for a few frames, a column for the truth and for each method, fitted."""
    import cv2
    import numpy as np

    kind = "novel" if any((out / done[0] / "novel").glob("*.png")) else "held_out"
    names = sorted(path.name for path in (out / done[0] / kind).glob("*.png"))
    names = names[:: max(1, len(names) // 4)][:4]
    columns = {
        "truth": out / done[0] / kind / "truth",
        **{name: out / name / f"{kind}_fitted" for name in done},
    }
    rows = [
        np.hstack([np.asarray(cv2.imread(str(folder / name))) for folder in columns.values()])
        for name in names
    ]
    scale = max(1, -(-MIN_COLUMN_PX * len(columns) // rows[0].shape[1]))
    rows = [cv2.resize(row, None, fx=scale, fy=scale) for row in rows]
    width = rows[0].shape[1] // len(columns)
    head = np.full((24, rows[0].shape[1], 3), 255, dtype=np.uint8)
    for place, title in enumerate(columns):
        cv2.putText(
            head, title, (place * width + 4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1,
            cv2.LINE_AA,
        )  # fmt: skip
    with atomic_file(out / "pictures.png") as part:
        cv2.imwrite(str(part), np.vstack([head, *rows]))


if __name__ == "__main__":
    sys.exit(main())
