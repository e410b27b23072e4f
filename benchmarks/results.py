"""The paper's tables with ours and the baselines, at equal core time: docs/results.md.

    python -m benchmarks.results [--motion TRACK] [--seconds 60 300] [--write docs/results.md]

For each subject an exact and a phone-like sample are filmed and `python -m baselines.compare` is
run on both, as many at a time as there are --jobs. What is in OUT already is not made again: Ctrl-C
and the same command continue. `--seconds 60 --subjects 1` takes half an hour of core time.
"""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import tyro

from apps.cli.exit_codes import run_command
from benchmarks.hardware import ROOT, Hardware
from benchmarks.results_page import BEGIN, END, ComparedSample, results_lines
from capture.atomic_files import write_text_atomically
from studio.shoot import ShootConfig, film_capture

ORDER = ("anim-nerf", "neural-body", "snarf", "instant-ngp", "ours")
"""Methods, in the order of the tables."""
PICTURE_NAME = "results.webp"
"""Beside the page: the truth and each method, of the first exact sample."""


@dataclass(frozen=True, kw_only=True)
class ResultsJob:
    """Films the samples, compares the systems on each, and writes the page."""

    subjects: tuple[int, ...] = (1, 2, 3)
    """Actors of the studio: the paper's S1 to S3."""
    seconds: tuple[float, ...] = (60.0,)
    """Core seconds of each method; each is a run of its own, with its own learning-rate decay."""
    methods: tuple[str, ...] = ORDER
    """What is compared."""
    motion: Path | None = None
    """Track whose poses the actors take while they are filmed, such as one of PeopleSnapshot; if
    not given, the studio's own turn."""
    size: int = 128
    """Width and height of the exact samples; the phone-like ones are 9:16 and as high."""
    frames: int = 60
    """Frames of each film."""
    jobs: int = 2
    """Comparisons at a time; each takes one core."""
    out: Path = Path("results")
    """Folder for samples and comparisons."""
    write: Path | None = None
    """Markdown file whose tables are replaced; its picture lies beside it."""


def main() -> None:
    """The benchmark."""
    job = tyro.cli(ResultsJob, prog="python -m benchmarks.results", description=__doc__)
    sys.exit(run_command("python -m benchmarks.results", lambda: run(job)))


def run(job: ResultsJob) -> int:
    """Films, compares and writes; an interrupted comparison leaves what is done."""
    hardware = Hardware.here()
    samples = [
        ComparedSample(subject=subject, kind=kind, seconds=seconds)
        for seconds in job.seconds
        for kind in ("phone", "exact")
        for subject in job.subjects
    ]
    for sample in samples:
        film(job, sample)
    codes = [0]
    with ThreadPoolExecutor(job.jobs) as pool:
        running = [pool.submit(compare, job, sample) for sample in samples]
        try:
            for done in as_completed(running):
                codes.append(done.result())
                write_page(job, samples, hardware.lines())  # an interrupted run has a page, too
        finally:
            pool.shutdown(cancel_futures=True)
    return max(codes)


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
    """Compares all methods on a sample; the exit code."""
    command = [
        sys.executable, "-m", "baselines.compare", str(job.out / sample.name),
        "--seconds", f"{sample.seconds:g}", "--out", str(folder_of(job, sample)),
        "--methods", *job.methods,
    ]  # fmt: skip
    return subprocess.run(command, cwd=ROOT, stdout=subprocess.DEVNULL, check=False).returncode


def folder_of(job: ResultsJob, sample: ComparedSample) -> Path:
    """Where the comparison of a sample lies."""
    return (job.out / f"{sample.name}-{sample.seconds:g}s").resolve()


def write_page(job: ResultsJob, samples: list[ComparedSample], conditions: list[str]) -> None:
    """The page with new tables and a new picture; the text around the tables is kept."""
    found = {
        sample: [json.loads(path.read_text()) for path in scores]
        for sample in samples
        if (scores := [path for name in ORDER if (path := scores_of(job, sample, name)).is_file()])
    }
    if not found:
        return
    track = "the studio's own turn" if job.motion is None else f"{job.motion.name}, on the spot"
    commits = sorted({each["commit"] for results in found.values() for each in results})
    told = [f"trained at {', '.join(commits)}", f"filmed: {job.frames} frames, {track}"]
    lines = results_lines(found, [*conditions, *told])
    if job.write is None:
        print("\n".join(lines))
        return
    before, after = "# Results\n\n", "\n"
    if job.write.exists() and BEGIN in (text := job.write.read_text()):
        before, after = text.split(BEGIN)[0], text.split(END)[1]
    write_text_atomically(job.write, before + "\n".join([BEGIN, *lines, END]) + after)
    sheet = cv2.imread(
        str(folder_of(job, min(found, key=lambda sample: sample.kind)) / "pictures.png")
    )
    if sheet is not None:
        _, code = cv2.imencode(".webp", sheet, [cv2.IMWRITE_WEBP_QUALITY, 80])
        (job.write.parent / PICTURE_NAME).write_bytes(code.tobytes())


def scores_of(job: ResultsJob, sample: ComparedSample, method: str) -> Path:
    """Where the scores of a method on a sample lie."""
    return folder_of(job, sample) / method / "scores.json"


if __name__ == "__main__":
    main()
