"""cube60 for MCX, MCX-CL and MMC, which print the absorbed fraction; lengths in mm."""

import argparse
import math
import re
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from _common import captured_output, compare, skip

# Of MCX-CL on a CPU: its additions of floats need OpenCL 3.
CPU_OPTIONS = {"compileropt": "-cl-std=CL3.0"}


def settings(photons: int) -> dict[str, Any]:
    """The cube of 60 mm without reflections; without a fluence map and detectors, like our case."""
    return {
        "nphoton": photons,
        "vol": np.ones((60, 60, 60), np.uint8),
        "prop": [[0.0, 0.0, 1.0, 1.0], [0.005, 1.0, 0.01, 1.37]],
        "srcpos": [29.0, 29.0, 0.0],
        "srcdir": [0.0, 0.0, 1.0],
        "issrcfrom0": 1,
        "tstart": 0.0,
        "tend": 5e-9,
        "tstep": 5e-9,
        "isreflect": 0,
        "issave2pt": 0,
        "issavedet": 0,
        "seed": 29012392,
        "autopilot": 1,
    }


def opencl_device(package: ModuleType, name: str, cpu: bool) -> int:
    """1-based number of the first OpenCL device that is, or is not, a CPU; leaves where there is none."""
    try:
        with captured_output():
            found: Sequence[dict[str, Any]] = package.gpuinfo()
    except RuntimeError as error:
        skip(f"{name} finds no OpenCL device ({error})")
    if not found:
        skip(f"{name} finds no OpenCL device")
    for i, device in enumerate(found):
        # PoCL's names begin with how it runs threads, Intel's and AMD's CPU drivers have the name of the processor.
        name_of = device["name"]
        if (name_of.startswith("pthread") or "CPU" in name_of or "Processor" in name_of) == cpu:
            print(f"{name} on {name_of}")
            return i + 1
    skip(f"there is no OpenCL {'CPU' if cpu else 'GPU'} among {', '.join(device['name'] for device in found)}")


def number(label: str, text: str) -> float:
    """What MCX and MMC print after a label; NaN where they do not."""
    found = re.search(rf"{label}:\s*([0-9.]+)", text)
    return float(found[1]) if found else math.nan


def measure(package: ModuleType, name: str, args: argparse.Namespace, settings: dict[str, Any]) -> None:
    """Times `package.run(settings)` against our cube60, and compares what is absorbed."""
    fractions: list[float] = []

    def run() -> float | None:
        """Seconds by MCX's own clock, which leaves out its setup as ours does; MMC, whose setup is short, returns
        none."""
        with captured_output() as output:
            result = package.run(settings)
        if result.get("stat"):
            fractions.append(result["stat"]["energyabs"] / result["stat"]["energytot"])
            return 1e-3 * float(result["stat"]["runtime"])
        if "flux" in result:  # fluence rate [1/(mm^2 s)] in voxels of 1 mm; times absorption [1/mm] and time [s]
            fractions.append(float(result["flux"].sum()) * settings["prop"][1][0] * settings["tend"])
            return None
        fractions.append(number("absorbed", output.text) / 100.0)
        return 1e-3 * args.photons / number("simulation speed", output.text)

    try:
        run()
    except RuntimeError as error:
        skip(f"{name} cannot run on this machine's devices ({' '.join(str(error).split())})")
    ours = compare("cube60", run, name=name, unit="photons", work=args.photons, args=args)

    # One seed, since MCX compiles it in: its runs repeat each other, ours do not.
    import spadwarp
    from spadwarp.benchmark import CASES

    scene = spadwarp.Scene.from_dict(CASES["cube60"].scene)
    spread = float(spadwarp.transport.trace(scene, photons=50_000, device=args.device).weight.std())
    error = spread * math.sqrt((1.0 + 1.0 / args.repeats) / args.photons)
    theirs = fractions[-1]
    print(f"absorbed     {theirs:.5f}, ours {ours:.5f}: {(ours - theirs) / error:+.2f} combined standard errors apart")
