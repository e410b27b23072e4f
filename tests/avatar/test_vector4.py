"""Four numbers in one register are what numpy makes of them one by one."""

import numpy as np

from avatar.kernels.jit import compile_kernel
from avatar.kernels.vector4 import dot4, load4, add4, store4, scale4


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
