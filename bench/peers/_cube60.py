"""cube60 for MCX and MCX-CL, which take the same settings: a volume of 1 mm voxels, lengths in mm."""

from types import ModuleType
from typing import Any

import numpy as np
from _common import compare, fastest, options, skip


def settings(photons: int) -> dict[str, Any]:
    """The cube of 60 mm without reflections; no map of the fluence and no detectors: what our case tallies."""
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
        "gpuid": 1,
    }


def measure(package: ModuleType, name: str, photons: int) -> None:
    args = options(f"cube60 on {name} and on spadwarp", photons=photons)
    try:
        seconds, got = fastest(lambda: package.run(settings(args.photons)), args.repeats)
    except RuntimeError as error:
        skip(f"{name} cannot run on this machine's devices ({' '.join(str(error).split())})")
    stat = got.get("stat", {}) if isinstance(got, dict) else {}
    # MCX's own clock leaves out its setup, as ours does.
    own = float(stat.get("runtime", 0.0)) * 1e-3
    print(f"{name:<12} {seconds:.3g} s a run, {own:.3g} s by its own clock")
    if stat.get("energytot"):
        print(f"{name:<12} absorbed fraction {stat['energyabs'] / stat['energytot']:.5f}")
    compare("cube60", args.photons / (own or seconds), name=name, unit="photons", args=args)
