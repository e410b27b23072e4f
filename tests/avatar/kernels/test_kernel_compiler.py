"""Compiled code that is kept on disk is not used when what it calls has changed.

Four numbers in one register are what numpy makes of them one by one.
"""

import importlib
import sys

import numpy as np

from avatar.kernels import kernel_compiler
from avatar.kernels.kernel_compiler import add4, compile_kernel, dot4, load4, scale4, store4

CALLEE = """
from avatar.kernels.kernel_compiler import compile_kernel

@compile_kernel(forceinline=True)
def scale(x):
    return {factor} * x
"""
CALLER = """
from avatar.kernels.kernel_compiler import compile_kernel
from callee import scale

@compile_kernel()
def twice(x):
    return scale(x) + scale(x)
"""


def called_as_by_a_new_process() -> tuple[float, int]:
    """What the caller gives, and how often its machine code was found on disk."""
    for name in ("caller", "callee"):
        sys.modules.pop(name, None)
    kernel_compiler._source_digest.cache_clear()
    twice = importlib.import_module("caller").twice
    return twice(1.0), sum(twice.stats.cache_hits.values())


def test_a_kernel_is_compiled_again_when_a_kernel_it_calls_has_changed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "callee.py").write_text(CALLEE.format(factor=3.0))
    assert called_as_by_a_new_process() == (6.0, 0)
    assert called_as_by_a_new_process() == (6.0, 1)
    (tmp_path / "callee.py").write_text(CALLEE.format(factor=5.0))
    assert called_as_by_a_new_process() == (10.0, 0)


def test_where_nothing_can_be_kept_it_is_compiled_all_the_same():
    """As where neither the project's folder nor the home folder can be written to."""
    names: dict = {}
    exec(compile("def twice(x): return 2.0 * x", "<nowhere>", "exec"), names)
    assert compile_kernel()(names["twice"])(3.0) == 6.0


@compile_kernel(cache=False)
def blend(array, one, other, share, out):
    first, second = load4(array, one, 1), load4(array, other, 1)
    store4(out, 0, 2, add4(first, scale4(share, second)))
    return dot4(first, second)


def test_four_numbers_are_read_added_multiplied_and_written_where_they_lie():
    array = np.random.default_rng(0).normal(size=(5, 7)).astype(np.float32)
    out = np.zeros((1, 8), dtype=np.float32)
    dot = blend(array, 4, 2, np.float32(0.3), out)
    first, second = array[4, 1:5], array[2, 1:5]
    np.testing.assert_allclose(out[0, 2:6], first + np.float32(0.3) * second, atol=1e-6)
    np.testing.assert_allclose(dot, first @ second, rtol=1e-5)
    assert (out[0, [0, 1, 6, 7]] == 0.0).all()
