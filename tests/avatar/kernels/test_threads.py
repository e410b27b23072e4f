"""Threads that run a kernel: each share once, small numbers, errors; and what is kept on disk."""

import importlib
import sys
import threading

import numba
import numpy as np
import pytest
import torch

from avatar.kernels import kernel_compiler
from avatar.kernels.kernel_compiler import (
    FAST_MATH,
    add4,
    claim,
    compile_kernel,
    dot4,
    load4,
    scale4,
    store4,
)
from avatar.kernels.threads import run_blocks, run_threads


@compile_kernel(cache=False, **FAST_MATH)
def count_shares(thread, threads, counts):
    """Counts each place of a thread's share."""
    for place in range(thread, counts.shape[0], threads):
        counts[place] += 1


@compile_kernel(cache=False, **FAST_MATH)
def count_blocks(claimed, counts):
    """Counts each block that a thread claims."""
    block = claim(claimed)
    while block < counts.shape[0]:
        counts[block] += 1
        block = claim(claimed)


@compile_kernel(cache=False, **FAST_MATH)
def halve(thread, threads, numbers):
    """Halves the numbers of a thread's share."""
    for place in range(thread, numbers.shape[0], threads):
        numbers[place] *= np.float32(0.5)


@pytest.fixture(params=range(1, min(4, numba.config.NUMBA_NUM_THREADS) + 1))
def threads(request):
    before = numba.get_num_threads()
    numba.set_num_threads(request.param)
    yield request.param
    numba.set_num_threads(before)


def test_each_share_is_run_once(threads):
    counts = np.zeros(101, dtype=np.int64)
    for _ in range(20):
        run_threads(count_shares, counts)
    assert (counts == 20).all()


def test_each_block_is_claimed_once(threads):
    counts = np.zeros(1000, dtype=np.int64)
    for _ in range(20):
        run_blocks(count_blocks, counts)
    assert (counts == 20).all()


def test_while_the_threads_are_in_use_the_shares_are_run_all_the_same(threads):
    counts = np.zeros(10, dtype=np.int64)

    def within(thread, number):
        if thread == 0:
            run_threads(count_shares, counts)

    run_threads(within)
    assert (counts == 1).all()


def test_an_error_of_any_thread_is_raised_and_the_threads_work_on(threads):
    def fail(thread, number, which):
        if thread == which:
            raise ValueError("this share")

    counts = np.zeros(7, dtype=np.int64)
    for which in range(threads):
        with pytest.raises(ValueError, match="this share"):
            run_threads(fail, which)
        run_threads(count_shares, counts)
    assert (counts == threads).all()


def test_denormal_numbers_are_zero_in_kernels_alone(threads):
    if not torch.set_flush_denormal(False):
        pytest.skip("this processor cannot take denormal numbers for zero")
    numbers = np.full(64, 1.5e-38, dtype=np.float32)
    run_threads(halve, numbers)
    assert not numbers.view(np.int32).any()
    assert (np.full(4, 1.5e-38, dtype=np.float32) * np.float32(0.5)).view(np.int32).all()


def test_two_threads_of_a_program_may_run_kernels_at_once(threads):
    counts = np.zeros((2, 1000), dtype=np.int64)

    def repeat(row):
        numba.set_num_threads(threads)
        for _ in range(50):
            run_threads(count_shares, counts[row])

    both = [threading.Thread(target=repeat, args=(row,)) for row in range(2)]
    for one in both:
        one.start()
    for one in both:
        one.join()
    assert (counts == 50).all()


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
