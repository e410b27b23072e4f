"""Threads that run a kernel: each share once, also where they are in use; errors; small numbers."""

import threading

import numba
import numpy as np
import pytest
import torch

from avatar.kernels.kernel_compiler import FAST_MATH, claim, compile_kernel
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
