"""Peak memory of this process alone."""

import subprocess
import sys

from capture.hardware import peak_memory_mb

SAID = "from capture.hardware import peak_memory_mb as p; {}; print(p())"


def said(held: str) -> float:
    command = [sys.executable, "-c", SAID.format(held)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def test_what_was_held_is_counted_and_what_the_parent_holds_is_not():
    block = bytearray(b"\1") * (200 << 20)
    assert peak_memory_mb() > 200.0
    alone = said("pass")
    assert alone < 150.0
    assert said("bytearray(b'x') * (200 << 20)") > alone + 180.0
    del block
