"""Devices on which photons can be traced, cores, memory."""

from __future__ import annotations

import ctypes
import functools
import json
import os
import platform
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spadwarp.values import DeviceError, address_space, guarded, need_memory, shown

if TYPE_CHECKING:
    import warp as wp

__all__ = ["core_count", "devices", "nvidia_driver", "physical_memory", "pick_device", "pick_devices"]
__all__ += ["processor_name", "start_devices", "start_warp"]


def pick_devices(names: str | None = None) -> list[wp.Device]:
    """The Warp devices of a list such as "cuda:0,cuda:2"; "cuda:all" are the GPUs of this host.

    A device that is named twice is used twice, with tallies of its own each time.

    Raises `DeviceError`: there is no such device; the text names those that exist.
    """
    import warp as wp

    start_warp()
    if isinstance(names, str) and names == "cuda:all":
        return wp.get_cuda_devices() or [pick_device("cuda:0")]
    return [pick_device(name) for name in (names.split(",") if isinstance(names, str) else [names])]


def pick_device(name: str | wp.Device | None = None) -> wp.Device:
    """The Warp device of that name, or as it is; by default the first GPU, else the CPU.

    Raises `DeviceError`: there is no such device; the text names those that exist.
    """
    import warp as wp

    start_warp()
    if isinstance(name, wp.Device):
        return name
    names = [device.alias for device in wp.get_devices()]
    if name is None:
        name = next((alias for alias in names if alias.startswith("cuda")), "cpu")
    if isinstance(name, str) and name == "cuda" and "cuda:0" in names:
        name = "cuda:0"
    if not isinstance(name, str) or name not in names:
        hint = "" if len(names) > 1 else "; Warp sees no NVIDIA GPU with driver R580 or newer"
        raise DeviceError(f"device = {shown(name)} is not one of {', '.join(names)}{hint}")
    return wp.get_device(name)


def devices() -> list[dict[str, Any]]:
    """Devices that `device=` may be, in plain values.

    Returns for each device `name` ("cpu", "cuda:0"), `description`, `memory` [bytes], `compute_capability` (None for
    the CPU), `threads` (CPU; None for a GPU) and `default`.
    """
    import warp as wp

    default, threads = pick_device().alias, core_count()
    return [
        {
            "name": device.alias,
            "description": ("" if device.is_cuda else f"{threads} threads, ") + processor_name(device),
            "memory": device.total_memory if device.is_cuda else physical_memory(),
            "compute_capability": f"{device.arch // 10}.{device.arch % 10}" if device.is_cuda else None,
            "threads": None if device.is_cuda else threads,
            "default": device.alias == default,
        }
        for device in wp.get_devices()
    ]


def processor_name(device: wp.Device | None = None) -> str:
    """The name of a device's processor; by default the CPU's, or its architecture where the system has no more."""
    return device.name if device is not None and device.is_cuda else _cpu_name()


@functools.cache
def _cpu_name() -> str:
    try:  # Linux gives Python the architecture alone
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()


@functools.cache
def kernel_thread() -> ThreadPoolExecutor:
    """The thread that loads kernels beside others. One for all: in each thread that compiles Warp first prepares its
    headers, 1.5 s on a CPU."""
    return ThreadPoolExecutor(1, "spadwarp-kernels")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=kernel_thread.cache_clear)  # a child has none of its parent's threads


def start_devices(names: str | None = None) -> None:
    """Begins to start the devices of `pick_devices`; returns at once.

    NVIDIA's driver takes half a second for it, and on a CPU what is compiled first takes the time of Warp's headers, in
    which a program can import the rest of what it needs. What fails here fails again where a device is used.
    """
    if address_space() is not None:
        return

    def start() -> None:
        with suppress(Exception):
            devices = pick_devices(names)
            import warp as wp

            import spadwarp_kernels.tally

            for device in devices:
                if device.is_cuda:
                    device.context  # noqa: B018, made when first read
                else:
                    wp.load_module(f"{spadwarp_kernels.tally.__name__}.tally", device=device)

    kernel_thread().submit(start)


_starting = threading.Lock()


def start_warp() -> None:
    """`wp.init()` without Warp's start-up text, nor its warning where there is no GPU.

    Raises `DeviceError` where the kernel cache cannot be used; so do kernels when they are loaded. Raises `MemoryError`
    where a limit leaves too little memory to compile kernels.
    """
    with _starting:
        _start_warp()


@functools.cache
def _start_warp() -> None:
    need_memory(1.0, "Warp")
    import warp as wp

    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    with _kernel_cache():
        _init_quietly()
    from spadwarp_kernels import unpack_kernels

    unpack_kernels()
    load = wp.Module.load

    @functools.wraps(load)
    def explained(*args: Any, **options: Any) -> Any:
        with _kernel_cache():
            return load(*args, **options)

    wp.Module.load = explained  # type: ignore[method-assign]  # the one place that all kernels pass


@contextmanager
def _kernel_cache() -> Iterator[None]:
    """Errors of Warp's kernel cache name its folder, and what to do about it."""
    import warp as wp

    try:
        yield
    except Exception as error:
        if not (isinstance(error, OSError | json.JSONDecodeError) or str(error).startswith("Failed to load C")):
            raise
        folder = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH")
        where = "Warp's kernel cache" + (f" {folder}" if folder else "")
        raise DeviceError(
            f"{where} cannot be used: {error}; remove it if it is damaged, or set WARP_CACHE_PATH to a folder that can "
            "be written"
        ) from error


def _init_quietly() -> None:
    import warp as wp

    if cuda_driver() is not None:
        wp.init()
        return
    # The warning is written by native code, past Python's streams.
    try:
        stderr = os.dup(2)
    except OSError:  # a program without one
        wp.init()
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        wp.init()
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)


def cuda_driver() -> ctypes.CDLL | None:
    """NVIDIA's driver library, where the system's loader finds it."""
    for library in ("nvcuda.dll",) if os.name == "nt" else ("libcuda.so", "libcuda.so.1"):
        with suppress(OSError):
            return ctypes.CDLL(library)
    return None


def core_count() -> int:
    """CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def physical_memory() -> int | None:
    """Memory of the machine [bytes]; None where the system does not report it."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else None


def nvidia_driver() -> str | None:
    """Release of the NVIDIA driver, such as "580.65.06", where Linux reports it; else None."""
    try:
        words = Path("/proc/driver/nvidia/version").read_text().split()
    except OSError:
        return None
    return next((word for word in words if word[0].isdigit() and "." in word), None)


guarded(__name__)
