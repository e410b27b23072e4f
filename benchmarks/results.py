"""The paper's tables with ours and the baselines, at equal core time: docs/results.md.

    python -m benchmarks.results [--motion TRACK] [--write docs/results.md]

For each subject an exact and a phone-like sample are filmed and `python -m baselines.compare` is
run on both, as many at a time as there are --jobs. What is in OUT already is not made again: the
same command continues after Ctrl-C, with the most important comparisons first. Times are the
processor's, so that other programs hardly count; commit, machine and versions come from the score
files.
"""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import tyro

from baselines.hardware import ROOT
from benchmarks.results_page import BEGIN, END, ComparedSample, results_lines
from capture.atomic_files import write_text_atomically
from capture.input_error import InputError
from instant_avatar.cli.command_line import run_command
from instant_avatar.studio.shoot import ShootConfig, film_capture

METHODS = ("anim-nerf", "ours")
"""In the order of the tables."""
PICTURES = {"exact": "results.webp", "phone": "results-phone.webp"}
"""Beside the page: the truth and each method, of the first sample of each kind."""


@dataclass(frozen=True, kw_only=True)
class ResultsJob:
    """Films the samples, compares the systems on each, and writes the page.

    Anim-NeRF and ours on S1 to S3 for a minute, and five minutes on S1: 32 core-minutes of
    training, and scoring.
    """

    motion: Path | None = None
    """Track whose poses the actors take while they are filmed, such as one of PeopleSnapshot; if
    not given, the studio's own turn."""
    size: int = 256
    """Width and height of the exact samples; the phone-like ones are 9:16 and as high."""
    frames: int = 60
    """Frames of each film."""
    jobs: int = 2
    """Comparisons at a time; each takes one core."""
    out: Path = Path("results")
    """Folder for samples and comparisons."""
    write: Path | None = None
    """Markdown file whose tables are replaced; its pictures lie beside it."""


def main() -> None:
    """The benchmark."""
    job = tyro.cli(ResultsJob, prog="python -m benchmarks.results", description=__doc__)
    sys.exit(run_command("python -m benchmarks.results", lambda: run(job)))


def run(job: ResultsJob) -> int:
    """Films, compares and writes; an interrupted comparison leaves what is done.

    Raises:
        InputError: If OUT holds samples that were filmed otherwise.
    """
    samples = plan()
    _claim(job)
    for sample in samples:
        film(job, sample)
    codes, pool = [0], ThreadPoolExecutor(job.jobs)
    running = [pool.submit(compare, job, each) for each in samples]
    try:
        for finished in as_completed(running):
            codes.append(finished.result())
            print(f"{len(codes) - 1} of {len(samples)} comparisons", file=sys.stderr, flush=True)
            write_page(job, samples)
    finally:  # Ctrl-C reaches those that are running, too
        pool.shutdown(cancel_futures=True)
        write_page(job, samples)  # an interrupted run has a page, too
    return max(codes)


def plan() -> list[ComparedSample]:
    """The samples, the most important ones first."""
    kinds: tuple[Literal["phone", "exact"], ...] = ("phone", "exact")
    return [
        ComparedSample(subject=subject, kind=kind, seconds=seconds)
        for subject, seconds in ((1, 60.0), (2, 60.0), (3, 60.0), (1, 300.0))
        for kind in kinds
    ]


def _claim(job: ResultsJob) -> None:
    """Writes into OUT how its samples are filmed, or refuses one where they were otherwise."""
    now = {
        "size": job.size, "frames": job.frames,
        "motion": None if job.motion is None else str(job.motion.resolve()),
    }  # fmt: skip
    path = job.out / "samples.json"
    before = json.loads(path.read_text()) if path.is_file() else now
    if before != now:
        raise InputError(
            f"{job.out} holds samples filmed with {before}, now {now}. Name another --out."
        )
    job.out.mkdir(parents=True, exist_ok=True)
    write_text_atomically(path, json.dumps(now))


def film(job: ResultsJob, sample: ComparedSample) -> None:
    """Films a sample, unless it lies there already."""
    place = job.out / sample.name
    if place.exists():
        return
    config = ShootConfig(size=job.size, frames=job.frames, subject=sample.actor, track=job.motion)
    if sample.kind == "phone":
        config = replace(config, size=round(job.size * 9 / 16), like_a_phone=True)
    print(f"filming {place}", file=sys.stderr, flush=True)
    film_capture(place, config)


def compare(job: ResultsJob, sample: ComparedSample) -> int:
    """Compares the methods on a sample; the exit code."""
    command = [
        sys.executable, "-m", "baselines.compare", str((job.out / sample.name).resolve()),
        "--seconds", f"{sample.seconds:g}", "--out", str(folder_of(job, sample)),
        "--methods", *METHODS,
    ]  # fmt: skip
    code = subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, check=False).returncode
    return code if code >= 0 else 128 - code  # as a shell tells a signal


def folder_of(job: ResultsJob, sample: ComparedSample) -> Path:
    """Where the comparison of a sample lies."""
    return (job.out / f"{sample.name}-{sample.seconds:g}s").resolve()


def write_page(job: ResultsJob, samples: list[ComparedSample]) -> None:
    """The page with new tables and new pictures; the text around the tables is kept."""
    found = {
        sample: scores
        for sample in sorted(samples, key=lambda sample: (sample.kind != "phone", sample.subject))
        if (scores := _scores(job, sample))
    }
    if not found:
        return
    track = "the studio's own turn" if job.motion is None else f"{job.motion.name}, on the spot"
    lines = results_lines(found, [f"filmed: {job.frames} frames of {job.size} px, {track}"])
    if job.write is None:
        print("\n".join(lines))
        return
    before, after = "# Results\n\n", "\n"
    if job.write.exists() and BEGIN in (text := job.write.read_text()):
        before, after = text.split(BEGIN)[0], text.split(END)[1]
    write_text_atomically(job.write, before + "\n".join([BEGIN, *lines, END]) + after)
    for kind, name in PICTURES.items():
        first = next((sample for sample in found if sample.kind == kind), None)
        path = None if first is None else folder_of(job, first) / "pictures.png"
        sheet = None if path is None else cv2.imread(str(path))
        if sheet is not None:
            _, code = cv2.imencode(".webp", sheet, [cv2.IMWRITE_WEBP_QUALITY, 80])
            (job.write.parent / name).write_bytes(code.tobytes())


def _scores(job: ResultsJob, sample: ComparedSample) -> list[dict[str, Any]]:
    """What the score files of a sample hold, in the order of the methods."""
    paths = [folder_of(job, sample) / name / "scores.json" for name in METHODS]
    return [json.loads(path.read_text()) for path in paths if path.is_file()]


if __name__ == "__main__":
    main()
