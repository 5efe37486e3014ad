"""Kernels with one thread a pixel: launches over any number of them, on every core of a CPU."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp


def launch_pixels(kernel: wp.Kernel, count: int, inputs: Sequence[Any], *, device: Any) -> None:
    """Launch a kernel over `count` pixels; its first argument is the first pixel of the launch, `inputs` follow.

    On the CPU, where a launch runs on one core and releases the GIL, the pixels are shared out over threads; but not
    while a graph is captured, which records the launches of one thread.
    """
    device = wp.get_device(device)
    if count == 0:
        return
    if device.is_cuda or device.is_capturing:
        wp.launch(kernel, count, [0, *inputs], device=device)
        return
    wp.load_module(kernel.module, device=device)  # compiled once, before the threads
    workers = os.cpu_count() or 1
    edges = np.unique(np.linspace(0, count, 8 * workers + 1).astype(int)) if workers > 1 else np.array([0, count])

    def part(index: int) -> None:
        low, high = int(edges[index]), int(edges[index + 1])
        wp.launch(kernel, high - low, [low, *inputs], device=device)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(part, range(len(edges) - 1)))
