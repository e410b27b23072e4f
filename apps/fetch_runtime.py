"""make web: fetch onnxruntime-web with npm, for `ia-play --web`."""

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
from export import player_page

PROGRAM = "python -m apps.fetch_runtime"
"""Name of the command in its --help."""


@dataclass(frozen=True, kw_only=True)
class FetchArguments:
    """Fetch the pinned release of onnxruntime-web that `ia-play --web` needs (`make web`).

    npm downloads it once (33 MB); its checksum is verified, and it is stored next to the page. An
    existing copy is kept.

    Exit codes: 0 done; 2 npm is missing or failed; 3 disk full; 130 Ctrl-C.
    """


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parse_arguments(FetchArguments, PROGRAM, argv)
    return run_command("make web", lambda: fetch_runtime(Console()))


def fetch_runtime(console: Console) -> int:
    """Fetch, verify and store the pinned release, unless it exists.

    Raises:
        InputError: If npm is missing or fails, or the checksum differs.
    """
    try:
        player_page.runtime_files()
    except InputError:
        with console.status(f"fetching onnxruntime-web {player_page.ORT_WEB_VERSION}"):
            player_page.install_runtime(_fetch_tarball())
    console.print_artifact("onnxruntime-web", player_page.RUNTIME_FOLDER)
    return DONE


def _fetch_tarball() -> bytes:
    npm = shutil.which("npm")
    if npm is None:
        raise InputError("npm was not found. Install Node.js, which includes it, and try again.")
    with tempfile.TemporaryDirectory() as folder:
        package = f"onnxruntime-web@{player_page.ORT_WEB_VERSION}"
        command = [npm, "pack", package, "--ignore-scripts", "--pack-destination", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
        found = list(Path(folder).glob("*.tgz"))
        if done.returncode or len(found) != 1:
            lines = done.stderr.strip().splitlines() or ["no reason given"]
            raise InputError(f"npm could not fetch {package}: {lines[-1]}")
        return found[0].read_bytes()


if __name__ == "__main__":
    sys.exit(main())
