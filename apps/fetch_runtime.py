"""make web: fetches onnxruntime-web through the machine's own npm, for `ia-play --web`."""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from apps.terminal.console import Console
from apps.terminal.exit_codes import DONE, exit_code
from capture.errors import BadInput
from export.web import runtime


def main() -> int:
    """The command; returns its exit code."""
    return exit_code("make web", lambda: fetch(Console()))


def fetch(console: Console) -> int:
    """Fetches, checks and keeps the pinned release, unless it is there.

    Raises:
        BadInput: If npm is missing, cannot fetch it, or fetches something else.
    """
    try:
        runtime.runtime_files()
    except BadInput:
        with console.waiting(f"fetching onnxruntime-web {runtime.VERSION}"):
            runtime.install(_tarball())
    console.made("onnxruntime-web", runtime.FOLDER)
    return DONE


def _tarball() -> bytes:
    npm = shutil.which("npm")
    if npm is None:
        raise BadInput("npm was not found. Install Node.js, which brings it, and try again.")
    with tempfile.TemporaryDirectory() as folder:
        package = f"onnxruntime-web@{runtime.VERSION}"
        command = [npm, "pack", package, "--ignore-scripts", "--pack-destination", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
        found = list(Path(folder).glob("*.tgz"))
        if done.returncode or len(found) != 1:
            lines = done.stderr.strip().splitlines() or ["no reason given"]
            raise BadInput(f"npm could not fetch {package}: {lines[-1]}")
        return found[0].read_bytes()


if __name__ == "__main__":
    sys.exit(main())
