"""Arguments of ia-batch; the text under each field is its --help."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from capture.hardware import usable_cores
from capture.input_error import InputError
from instant_avatar.batching.capture_discovery import BatchCapture, parse_options
from instant_avatar.batching.remote_files import is_url
from instant_avatar.cli.shared_options import Flag, check_disjoint_from_inputs, check_writable

RAY_LOCAL = "local"
"""Address that starts a Ray cluster of this machine alone."""


@dataclass(frozen=True, kw_only=True)
class BatchArguments:
    """Learn an avatar from each of many captures, each as ia-ingest would, in its own process.

    Try it:

        ia-batch captures/ --out avatars

        ia-batch captures/ --out avatars --ray auto -- --steps 3000

    Captures are folders (a video or images/ with poses or masks), bare videos, and rows of a table
    (.csv with a column capture, and options of ia-ingest). Words after -- are options of ia-ingest
    for all captures.

    The folder then holds a folder per capture, results.jsonl (a line per capture) and summary.html.
    Run the same command again to go on: what is done is left alone, what is new or has changed is
    learnt. Requires the extras [learn,cluster]. See docs/batch.md.

    Exit codes: 0 every capture has an avatar; 1 some were refused or have failed; 2 bad input,
    nothing was started; 3 the disk is full, or another batch is writing into --out; 130 stopped.
    """

    captures: Annotated[
        Positional[tuple[str, ...]], arg(metavar="PLACE ...", help_behavior_hint="")
    ]
    """Folders, videos, tables, or their URLs (s3://, gs://, https://)."""
    out: Annotated[str, arg(metavar="DIR", help_behavior_hint="")]
    """Folder, or URL, for avatars and results."""
    cores: int = 2
    """Cores per capture. One core per capture makes the most avatars per hour; give --steps then,
    because --seconds makes fewer steps on fewer cores."""
    memory: Annotated[float, arg(metavar="GB")] = 2.5
    """Memory that is set aside per capture; Ray ends and repeats attempts where it runs out."""
    limit: float = 3600.0
    """Seconds after which an attempt is ended; 0 for none."""
    retries: int = 2
    """Attempts after the first failed one; bad input is never tried again."""
    again: Flag = False
    """Try captures that were refused or have failed before again, too."""
    ray: Annotated[str, arg(metavar="ADDRESS")] = RAY_LOCAL
    """Ray cluster to run on: auto, or HOST:PORT; local starts one on this machine."""
    checkpoints: Flag = False
    """Keep checkpoints, too, about 35 MB each: ia-ingest --resume continues from them."""

    def validate(self) -> None:
        """Check ranges and combinations; an `InputError` names the option."""
        if not self.captures:
            raise InputError("No captures were named; name a folder, a video or a table.")
        for name, least in (("cores", 1), ("retries", 0), ("limit", 0), ("memory", 0)):
            if not getattr(self, name) >= least:
                raise InputError(
                    f"--{name} is {getattr(self, name)}, but must be at least {least}."
                )
        if not is_url(self.out):
            self.check_apart(self.captures)
            if Path(self.out).is_file():
                raise InputError(f"--out {self.out} is a file; a folder was expected.")
            check_writable(Path(self.out), "--out")

    def check_apart(self, inputs: Iterable[str]) -> None:
        """Check that --out does not lie in an input, or the other way round."""
        if not is_url(self.out):
            local = sorted({Path(place) for place in inputs if not is_url(place)})
            check_disjoint_from_inputs(Path(self.out), "--out", local)

    def cores_of(self, capture: BatchCapture) -> int:
        """Return the cores of a capture: its own --threads, or --cores, or all of this machine."""
        cores = min(self.cores, usable_cores()) if self.ray == RAY_LOCAL else self.cores
        return parse_options(capture.options).threads or cores
