"""A video played at its own speed: what is learnt when it ends, and how soon it is ready.

    python -m benchmarks.streaming [--json FILE] [--keep DIR]

Films the sample turning twice in 20 s, plays it into ia-ingest as a user would, and looks at it
from outside; then again from inside, for what no report says. There are no thresholds here.
"""

import itertools
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

from benchmarks.measurements import Measurement, print_measurements
from benchmarks.realtime_run import measure_realtime
from benchmarks.sample_training import film_sample
from benchmarks.streaming_quality import measure_streaming_quality


@dataclass(frozen=True, kw_only=True)
class StreamingOptions:
    """Measures streaming and prints one table."""

    size: int = 270
    """Width and height of the pictures."""
    frames: int = 600
    """Frames of the video, at 30 a second."""
    json: Path | None = None
    """File for the figures."""
    keep: Path | None = None
    """Folder for what is filmed; what lies there is used again."""


def main() -> None:
    """The benchmark."""
    job = tyro.cli(StreamingOptions, prog="python -m benchmarks.streaming", description=__doc__)
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Path(temporary)
        print_measurements(measure_all(job, job.keep or scratch, scratch), job.json)


def measure_all(job: StreamingOptions, folder: Path, scratch: Path) -> Iterator[Measurement]:
    """All rows."""
    capture = film_sample(folder / f"turning{job.size}", job.size, frames=job.frames, turns=2.0)
    groups = [measure_realtime(capture, scratch / "played"), measure_streaming_quality(capture)]
    return itertools.chain.from_iterable(groups)


if __name__ == "__main__":
    main()
