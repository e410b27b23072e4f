"""make web: fetches onnxruntime-web through the machine's own npm, for `ia-play --web`."""

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from apps.cli.command_line import parse_arguments
from apps.cli.console import Console
from apps.cli.exit_codes import DONE, run_command
from capture.input_error import InputError
from export.web import onnxruntime_web

PROGRAM = "python -m apps.fetch_runtime"


@dataclass(frozen=True, kw_only=True)
class FetchArguments:
    """Fetches onnxruntime-web, pinned, which `ia-play --web` needs; `make web` calls it.

    It comes through this machine's npm (33 MB, once), is compared with the sum that we know, and
    kept beside the page. Nothing is done if it is there already.

    Exit codes: 0 done; 2 no npm, or it could not fetch; 3 disk full; 130 Ctrl-C.
    """


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    parse_arguments(FetchArguments, PROGRAM, argv)
    return run_command("make web", lambda: fetch_runtime(Console()))


def fetch_runtime(console: Console) -> int:
    """Fetches, checks and keeps the pinned release, unless it is there.

    Raises:
        InputError: If npm is missing, cannot fetch it, or fetches something else.
    """
    try:
        onnxruntime_web.runtime_files()
    except InputError:
        with console.status(f"fetching onnxruntime-web {onnxruntime_web.ORT_WEB_VERSION}"):
            onnxruntime_web.install_runtime(_fetch_tarball())
    console.print_artifact("onnxruntime-web", onnxruntime_web.FOLDER)
    return DONE


def _fetch_tarball() -> bytes:
    npm = shutil.which("npm")
    if npm is None:
        raise InputError("npm was not found. Install Node.js, which brings it, and try again.")
    with tempfile.TemporaryDirectory() as folder:
        package = f"onnxruntime-web@{onnxruntime_web.ORT_WEB_VERSION}"
        command = [npm, "pack", package, "--ignore-scripts", "--pack-destination", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
        found = list(Path(folder).glob("*.tgz"))
        if done.returncode or len(found) != 1:
            lines = done.stderr.strip().splitlines() or ["no reason given"]
            raise InputError(f"npm could not fetch {package}: {lines[-1]}")
        return found[0].read_bytes()


if __name__ == "__main__":
    sys.exit(main())
