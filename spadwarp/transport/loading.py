"""Kernels of transport are compiled, or loaded from Warp's cache, in a thread of their own beside the rest of a run.

On CPUs alone: with CUDA, Warp ends the process now and then where one thread builds a mesh while another loads a module
(https://github.com/NVIDIA/warp/issues/1491).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from spadwarp.device import pick_devices
from spadwarp.errors import address_space

if TYPE_CHECKING:
    import warp as wp

__all__ = ["load_transport_kernel", "prepare_kernels"]


@functools.cache
def _thread() -> ThreadPoolExecutor:
    # One for all runs: in each thread that compiles Warp first prepares its headers, 1.5 s on a CPU.
    return ThreadPoolExecutor(1, "spadwarp-kernels")


def _beside(devices: Sequence[wp.Device]) -> bool:
    # Where memory is limited, two threads that compile may be too many.
    return address_space() is None and not any(device.is_cuda for device in devices)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_thread.cache_clear)  # a child has none of its parent's threads


def prepare_kernels(device: str | None = None) -> None:
    """Begins to load a kernel that all runs need, and with it the compiler; returns at once.

    A run that follows has its kernels sooner where they must be compiled. `device`: as for `simulate`. Raises
    `DeviceError` for one that does not exist.
    """
    import warp as wp

    import spadwarp_kernels as sk

    devices = pick_devices(device)
    if not _beside(devices):
        return

    def load() -> None:
        for one in devices:
            sk.has_overflowed(wp.zeros(1, dtype=wp.int64, device=one))

    _thread().submit(load)  # what fails here fails again in the run


def load_transport_kernel(spec: Any, devices: Sequence[wp.Device]) -> Callable[[], None]:
    """Begins to load the kernel of a spec on CPUs; the function returned waits for it, or raises its error.

    On GPUs, and where memory is limited, it does nothing: `DeviceWorker` loads the kernel. On a GPU that may be another
    one, for a large histogram.
    """
    import spadwarp_kernels as sk

    if not _beside(devices):
        return lambda: None

    def load() -> None:
        for device in devices:
            sk.load_transport_kernel(spec, device)

    return _thread().submit(load).result
