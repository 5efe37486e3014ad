"""Shared by the scripts of the peers: options, alternating runs of both simulators, and the ratio of their rates."""

import argparse
import ctypes
import importlib
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from statistics import median
from types import ModuleType, SimpleNamespace


def options(
    summary: str, *, photons: int, more: dict[str, tuple[int, str]] | None = None, repeats: bool = True
) -> argparse.Namespace:
    """The options of every script, and its own integers: name -> (default, help); `repeats`: of scripts that measure
    time."""
    parser = argparse.ArgumentParser(description=summary)
    parser.add_argument("--device", help='both: "cpu", "cuda:0", ...; by default the first GPU, else the CPU')
    parser.add_argument("--photons", type=lambda text: int(float(text)), default=photons, help="of one run of each")
    if repeats:
        parser.add_argument("--repeats", type=int, default=5, help="alternating runs of each; the median counts")
    for name, (default, text) in (more or {}).items():
        parser.add_argument(f"--{name}", type=int, default=default, help=text)
    return parser.parse_args()


def peer(name: str, hint: str) -> ModuleType:
    """The installed package; the script ends without an error where it is missing."""
    try:
        if sys.platform == "linux":
            # The wheels of MCX and MMC contain their own C++ library; loaded first, its symbols would replace those
            # that PoCL needs, which then loses options of its compiler.
            ctypes.CDLL("libstdc++.so.6", mode=ctypes.RTLD_GLOBAL)
        return importlib.import_module(name)
    except (ImportError, OSError) as error:
        skip(f"{name} cannot be imported ({error}); {hint}")


def skip(reason: str) -> None:
    print(f"not run: {reason}")
    sys.exit(0)


@contextmanager
def captured_output() -> Iterator[SimpleNamespace]:
    """Captures what C code prints to standard output; afterwards it is `text`."""
    output = SimpleNamespace(text="")
    sys.stdout.flush()
    kept = os.dup(1)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        try:
            yield output
        finally:
            sys.stdout.flush()
            ctypes.CDLL(None).fflush(None)
            os.dup2(kept, 1)
            os.close(kept)
            file.seek(0)
            output.text = file.read().decode(errors="replace")


def compare(
    case: str, theirs: Callable[[], float | None], *, name: str, unit: str, work: int, args: argparse.Namespace
) -> float:
    """Runs both simulators alternately on this machine and prints their rates and the ratio.

    Args:
        case: Of `spadwarp bench`.
        theirs: One run; returns its seconds by its own clock if it has one that leaves out the setup, else None.
        name, unit: Of the peer and of what it counts.
        work: How many of them one run does.
        args: From `options`.

    Returns:
        Our absorbed fraction of the light.
    """
    from spadwarp.benchmark import CASES, TransportRun
    from spadwarp.device import core_count, pick_device, processor_name
    from spadwarp_kernels import LEDGER_UNIT

    device = pick_device(args.device)
    run = TransportRun(CASES[case], device)
    theirs()
    run.run(args.photons)
    wall: dict[str, list[float]] = {name: [], "spadwarp": []}
    cpu: dict[str, list[float]] = {name: [], "spadwarp": []}
    taken = 0
    for repeat in range(args.repeats):
        began, spent = time.perf_counter(), time.process_time()
        own = theirs()
        cpu[name].append(time.process_time() - spent)
        wall[name].append(time.perf_counter() - began if own is None else own)
        spent = time.process_time()
        ledger, _, seconds = run.run(args.photons, first=repeat * args.photons)
        cpu["spadwarp"].append(time.process_time() - spent)
        wall["spadwarp"].append(seconds)
        taken += ledger["absorbed_water"]
    clocks = {"": wall}
    if device.is_cuda:
        print(f"{'':<12} median of {args.repeats} runs in turn on {device.name}")
    else:
        # Other processes on the machine stretch the wall clock's time, but not the processor's.
        clocks = {"": wall, " of processor time": cpu}
        print(f"{'':<12} median of {args.repeats} runs in turn on {core_count()} core(s) of {processor_name()}")
    for clock, seconds_of in clocks.items():
        them, us = work / median(seconds_of[name]), args.photons / median(seconds_of["spadwarp"])
        print(f"{name:<12} {them:.4g} {unit}/s{clock}")
        print(f"{'spadwarp':<12} {us:.4g} photons/s{clock}")
        print(f"ratio        {us / them:.3g}{clock}")
    return taken * LEDGER_UNIT / (args.photons * args.repeats)
