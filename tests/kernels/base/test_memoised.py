"""Warp functions that threads make at the same time."""

import sys
from concurrent.futures import ThreadPoolExecutor

import warp as wp

from spadwarp_kernels.base.kernels import memoised


def test_each_thread_gets_its_own_function():
    @memoised
    def make(number):
        @wp.func
        def one() -> int:
            return wp.static(number)

        return one

    before = sys.getswitchinterval()
    try:
        sys.setswitchinterval(1e-6)  # threads take turns all the time
        with ThreadPoolExecutor(8) as pool:
            made = list(pool.map(make, range(100)))
    finally:
        sys.setswitchinterval(before)
    assert [function.func.__closure__[0].cell_contents for function in made] == list(range(100))
    assert [make(number) for number in range(100)] == made
