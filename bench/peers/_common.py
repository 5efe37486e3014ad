"""What the peers' scripts share: options, our figure of the same run, and how a ratio is told."""

import argparse
import importlib
import sys
import time
from collections.abc import Callable
from types import ModuleType


def options(about: str, *, photons: int, more: dict[str, tuple[int, str]] | None = None) -> argparse.Namespace:
    """What every script takes, and integers of its own: name -> (default, help)."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--device", help='ours: "cpu", "cuda:0", ...; by default the first GPU, else the CPU')
    parser.add_argument("--photons", type=lambda text: int(float(text)), default=photons, help="of one run, each")
    parser.add_argument("--repeats", type=int, default=3, help="runs, the fastest of which counts")
    for name, (default, text) in (more or {}).items():
        parser.add_argument(f"--{name}", type=int, default=default, help=text)
    return parser.parse_args()


def peer(name: str, hint: str) -> ModuleType:
    """The installed package, or the end of the script: a peer that is not there is no failure."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        skip(f"{name} cannot be imported ({error}); {hint}")


def skip(reason: str) -> None:
    print(f"not run: {reason}")
    sys.exit(0)


def fastest(run: Callable[[], object], repeats: int) -> tuple[float, object]:
    """Seconds of the fastest of several runs, after one that loads what has to be loaded, and what it returned."""
    run()
    best, outcome = float("inf"), None
    for _ in range(repeats):
        began = time.perf_counter()
        got = run()
        seconds = time.perf_counter() - began
        if seconds < best:
            best, outcome = seconds, got
    return best, outcome


def compare(case: str, theirs: float, *, name: str, unit: str, args: argparse.Namespace) -> None:
    """Runs our case now, on this machine, and prints both rates and their ratio."""
    import spadwarp

    (ours,) = spadwarp.bench([case], device=args.device, photons=args.photons, repeats=args.repeats)
    rate = ours.rates["photons"]
    print(f"{name:<12} {theirs:.4g} {unit}/s")
    print(f"{'spadwarp':<12} {rate:.4g} photons/s on {ours.device}")
    if ours.check is not None:
        print(f"{'spadwarp':<12} {ours.check['name']} {ours.check['value']:.5f} ± {ours.check['standard_error']:.5f}")
    print(f"ratio        {rate / theirs:.3g}")
