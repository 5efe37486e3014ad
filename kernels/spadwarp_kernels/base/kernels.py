"""Kernels: made once for each choice, launched over all cores of a CPU, compiled ahead of their first use."""

import contextlib
import functools
import json
import os
import platform
import re
import secrets
import threading
import zipfile
import zlib
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import warp as wp

__all__ = ["unpack_kernels"]

P = ParamSpec("P")
R = TypeVar("R")

_making = threading.RLock()


def _free() -> None:
    global _making
    _making = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_free)  # a thread that made something is not in the child


def memoised(make: Callable[P, R]) -> Callable[P, R]:
    """`functools.cache` for what makes Warp functions and kernels: in all threads one after the other.

    Where two threads make a function of one name, Warp may give both the later one, and a kernel is then made of the
    parts of another.
    """
    made = functools.cache(make)

    @functools.wraps(make)
    def once(*args: P.args, **kwargs: P.kwargs) -> R:
        with _making:
            return made(*args, **kwargs)

    return once


# ---- Kernels with one thread a pixel: launches over any number of them, on every core of a CPU.


def launch_pixels(
    kernel: wp.Kernel, count: int, inputs: Sequence[Any], *, device: Any, threads: int = 0, block_dim: int = 256
) -> None:
    """Launch a kernel over `count` pixels; its first argument is the first pixel of the launch, `inputs` follow.

    On the CPU, where a launch runs on one core and releases the GIL, the pixels are shared out over threads (0: one for
    each core); but not while a graph is captured, which records the launches of one thread.
    """
    device = wp.get_device(device)
    if count == 0:
        return
    if device.is_cuda or device.is_capturing or threads == 1:
        wp.launch(kernel, count, [0, *inputs], device=device, block_dim=block_dim)
        return
    wp.load_module(kernel.module, device=device)  # compiled once, before the threads
    workers = threads or os.cpu_count() or 1
    parts = min(count, 8 * workers if workers > 1 else 1)
    edges = [count * part // parts for part in range(parts + 1)]

    def launch(low: int, high: int) -> None:
        wp.launch(kernel, high - low, [low, *inputs], device=device)

    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(launch, edges, edges[1:]))


# ---- Kernels that were compiled when the package was built: a first run then compiles nothing on common CPUs and GPUs.


# Made by .ci/compile_kernels.py; a checkout has none.
ARCHIVE = Path(__file__).parents[1] / "compiled.zip"
MANIFEST = "manifest.json"

TARGET = "x86-64-v3"
"""The processors whose instructions the objects use: Intel since 2013 and AMD since 2017, but for the smallest."""
FEATURES = ("avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe")
"""These instructions by their names in /proc/cpuinfo."""
PTX, CUBIN = 75, (80, 90, 100, 120)
"""Compute capabilities. Drivers as new as Warp's compiler read PTX, for any GPU from this one on; older ones read only
machine code, for GPUs of its own major version."""

# An archive that is damaged, or a cache that cannot be written: kernels are then compiled as without it.
_UNUSABLE = (OSError, RuntimeError, ValueError, KeyError, zipfile.BadZipFile, zlib.error)


def unpack_kernels() -> int:
    """Puts the compiled kernels of this package into Warp's kernel cache, where they are not there already.

    For programs of their own, before their first kernel; `spadwarp` calls it.

    Returns:
        The number of modules added, those of CPUs, PTX and machine code apart: 0 where the package has none for this
        version of Warp, system, processor and GPUs, and where it is damaged or the cache cannot be written.
    """
    if not ARCHIVE.exists():
        return 0
    wp.init()
    with contextlib.suppress(*_UNUSABLE), zipfile.ZipFile(ARCHIVE) as archive:
        if this_system() == json.loads(archive.read(MANIFEST)):
            endings, members = _endings(), map(_MEMBER.fullmatch, archive.namelist())
            return sum(_unpack(archive, found, endings[found["kind"]]) for found in members if found)
    return 0


# Module and kind of what Warp has compiled.
_MEMBER = re.compile(r"(?P<module>.+)\.(?P<kind>o|sm\d+\.ptx|sm\d+\.cubin)")


def _endings() -> defaultdict[str, set[str]]:
    """What Warp adds to the name of a module that it compiles here, by kinds of what is compiled already."""
    endings = defaultdict[str, set[str]](set)
    if set(FEATURES) <= _processor_features():
        # The end of this key is what Warp adds to the names of objects for the processor at hand.
        endings["o"].add(f"cpu{wp.get_cpu_kernel_cache_key().rpartition('-')[2]}.o")
    for device in wp.get_cuda_devices():
        with contextlib.suppress(RuntimeError):  # of a GPU that this Warp cannot compile for
            kind, arch = device.get_cuda_output_format(), device.get_cuda_compile_arch()
            for other in [PTX] if kind == "ptx" else [one for one in CUBIN if one // 10 == arch // 10 and one <= arch]:
                endings[f"sm{other}.{kind}"].add(f"sm{arch}.{kind}")
    return endings


def this_system() -> dict[str, str]:
    """What an archive must be made for to be of use here, the features of the processor aside."""
    return {"warp": wp.__version__, "system": platform.system(), "machine": platform.machine(), "target": TARGET}


def _processor_features() -> set[str]:
    """With other words of that file."""
    return set(Path("/proc/cpuinfo").read_text(encoding="utf-8").split())


def _unpack(archive: zipfile.ZipFile, found: re.Match[str], endings: Collection[str]) -> bool:
    module = found["module"]
    folder = Path(wp.config.kernel_cache_dir) / module
    missing = {ending: found.string for ending in endings if not (folder / f"{module}.{ending}").exists()}
    if endings and not (folder / f"{module}.meta").exists():
        missing["meta"] = f"{module}.meta"
    for ending, member in missing.items():
        folder.mkdir(parents=True, exist_ok=True)
        temporary = folder / f".{secrets.token_hex(8)}"
        temporary.write_bytes(archive.read(member))
        os.replace(temporary, folder / f"{module}.{ending}")
    return bool(missing)
