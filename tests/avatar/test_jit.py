"""Compiled code that is kept on disk is not used when what it calls has changed."""

import subprocess
import sys
from pathlib import Path

from avatar.kernels.jit import compile_kernel

CALLEE = """
from avatar.kernels.jit import compile_kernel

@compile_kernel(inline="always")
def scale(x):
    return {factor} * x
"""
CALLER = """
from avatar.kernels.jit import compile_kernel
from callee import scale

@compile_kernel()
def twice(x):
    return scale(x) + scale(x)

print(twice(1.0), sum(twice.stats.cache_hits.values()))
"""


def run(folder: Path) -> list[str]:
    root = Path(__file__).parents[2]
    code = f"import sys; sys.path[:0] = [{str(root)!r}, {str(folder)!r}]; import caller"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_a_kernel_is_compiled_again_when_a_kernel_it_calls_has_changed(tmp_path):
    (tmp_path / "caller.py").write_text_atomically(CALLER)
    (tmp_path / "callee.py").write_text_atomically(CALLEE.format(factor=3.0))
    assert run(tmp_path) == ["6.0", "0"]
    assert run(tmp_path) == ["6.0", "1"]
    (tmp_path / "callee.py").write_text_atomically(CALLEE.format(factor=5.0))
    assert run(tmp_path) == ["10.0", "0"]


def test_where_nothing_can_be_kept_it_is_compiled_all_the_same():
    """As where neither the project's folder nor the home folder can be written to."""
    names: dict = {}
    exec(compile("def twice(x): return 2.0 * x", "<nowhere>", "exec"), names)
    assert compile_kernel()(names["twice"])(3.0) == 6.0
