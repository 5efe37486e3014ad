"""Bits of results: hashes of arrays of small runs on a CPU, which a change of the code keeps or says that it changes.

    python tests/bits.py           # all cases against bits.json; --write records them anew, --only WORD takes some

They hold for one processor's instructions and for the versions that stand in bits.json. `tests/test_bits.py` compares
those that are quick.
"""

import argparse
import functools
import hashlib
import json
import platform
import sys
import tempfile
from pathlib import Path
from unittest import mock

import numpy as np

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).parent)]

import spadwarp
from helpers.scenes import PLATE, TREE, scene
from spadwarp.dataset import FrameReader, make_dataset

RECORD = Path(__file__).with_name("bits.json")
ESTIMATORS = ("analog", "next_event", "guided")

GLOSSY = {**TREE, "specular": 0.3, "roughness": 0.2, "reflectance": 0.4}
FLAT = {"shape": "flat", "distance": 0.1, "thickness": 0.01, "material": "acrylic"}
WALLS = {
    "shape": "box",
    "lower": [-0.9, -0.5, -0.5],
    "upper": [0.7, 0.6, 2.6],
    "outside_index": {"x_high": 1.49, "y_low": 1.0},
}
CELLS = {"shape": "plume", "size": 1.2, "cells": 12, "extinction": 3.0, "seed": 5, "translation": [0.0, 0.0, 1.2]}
DOME = {"shape": "dome", "radius": 0.3, "thickness": 0.01, "material": "acrylic"}
TWO_TERMS = {"phase_function": "two_term_henyey_greenstein", "g1": 0.9, "g2": -0.3, "alpha": 0.9}
LAYERS = {"layers": [{"start": 1.2, "extinction": 1.5, "albedo": 0.6}]}
SEA = {"point": [0.0, 0.0, 1.0], "up": [0.0, 0.0, -1.0]}
STOKES = {"medium": {"scattering_matrix": "scaled_rayleigh"}, "camera": {"polarisation": "stokes"}}

# Sections that make a scene of those of `helpers.scenes.scene`.
SCENES = {
    "water": {"targets": []},
    "plate": {},
    "tree": {"targets": [TREE]},
    "glossy": {"targets": [GLOSSY, {**PLATE, "translation": [0.0, 0.0, 2.5]}]},
    "flat port": {"camera": {"port": FLAT}},
    "dome": {"camera": {"port": DOME}, "laser": {"port": "camera"}},
    "walls": {"domain": WALLS, "targets": [{**PLATE, "size": [1.0, 0.8], "translation": [-0.1, 0.0, 2.0]}]},
    "cells": {"medium": {"grid": CELLS}},
    "cells by regular tracking": {"medium": {"grid": {**CELLS, "tracking": "regular"}}, "targets": [TREE]},
    "layers": {"medium": LAYERS},
    "table": {"medium": {"phase_function": "fournier_forand"}},
    "two-term table in layers": {"medium": {**TWO_TERMS, **LAYERS}, "targets": [TREE]},
    "polarised": {**STOKES, "laser": {"polarisation": "linear"}},
    "polarised walls": {**STOKES, "domain": WALLS},
    "near axis": {"transport": {"axis_threshold": 0.97}},
    "random albedo and roulette": {"medium": {"albedo": "lu2024"}, "transport": {"termination": "roulette"}},
    "thin lens": {"camera": {"focus_distance": 2.0, "aperture_diameter": 0.1}, "targets": [TREE]},
    "calm sea": {"surface": {**SEA, "preset": "calm"}},
    "facets": {"surface": {**SEA, "preset": "breeze"}},
    "waves": {"surface": {**SEA, "preset": "breeze", "waves": {"size": 2.0, "cells": 64, "fetch": 300.0}}},
    "confocal": {"scan": {"mode": "confocal"}, "laser": {"half_angle_deg": 2.0}},
}  # fmt: skip
EVERY = ("water", "plate", "tree", "flat port", "walls", "cells", "layers", "polarised")
QUICK = (
    "tree analog", "plate next_event", "plate guided", "tree guided", "cells guided", "polarised next_event",
    "layers guided", "detect", "depth", "analytic frames",
)  # fmt: skip


def traced(name, estimator="guided", **options):
    one = scene(**SCENES[name]).with_overrides({"transport.estimator": estimator})
    return spadwarp.simulate(one, photons=10_000, seed=5, device="cpu", **options)


def of_run(name, estimator="guided", **options):
    result = traced(name, estimator, **options)
    return [result.tallies, *(np.array(sorted(part.values())) for part in (result.energy_balance, result.counters))]


@functools.cache
def exposed(**options):
    detector = {"dark_count_rate": 100.0, "jitter_fwhm_ps": 200.0, "wrap": False, **options}
    source = scene(detector=detector, laser={"pulse_energy": 1e-12}).with_overrides(
        {"gate.bins": 64, "gate.bin_width_ps": 400.0}
    )
    return spadwarp.simulate(source, photons=10_000, seed=5, device="cpu")


def counts():
    return spadwarp.detect(exposed(), pulses=2000, frames=2, seed=3, device="cpu")


def of_dataset():
    """Four frames of two targets."""
    recipe = (Path(__file__).parents[1] / "configs" / "datasets" / "small.toml").read_text()
    for changed in (
        ("scenes_per_target = 4", "scenes_per_target = 1"),
        ("per_scene = 10", "per_scene = 2"),
        ('"staircase", "submarine", "amphora", "fish", "anchor", "car"', '"staircase", "fish"'),
        ('validation = ["amphora"]', "validation = []"),
    ):
        assert changed[0] in recipe
        recipe = recipe.replace(*changed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.toml"
        path.write_text(recipe)
        make_dataset(path, Path(folder) / "data", device="cpu")
        items = FrameReader(
            Path(folder) / "data", split="all", fields=("noisy", "clean", "label", "intensity", "bound")
        )
        return [np.asarray(value) for item in items for value in item.values()]


def of_parts():
    """Two runs that go on from each other, and two shards."""
    first = spadwarp.simulate(scene(), photons=5_000, seed=5, device="cpu")
    whole = spadwarp.simulate(scene(), photons=10_000, run=spadwarp.RunOptions(resume=first), device="cpu")
    return [whole.tallies, whole.standard_error]


CASES = {
    **{f"{name} {one}": functools.partial(of_run, name, one) for name in EVERY for one in ESTIMATORS},
    **{f"{name} guided": functools.partial(of_run, name) for name in SCENES if name not in EVERY},
    "derivatives": lambda: list(
        traced("plate", derivatives=("absorption", "scattering", "reflectance")).derivatives.values()
    ),
    "truth": lambda: [
        getattr(spadwarp.truth_maps(scene(targets=[TREE]), device="cpu"), k) for k in ("depth", "range", "normal")
    ],
    "detect": lambda: [counts().counts],
    "depth": lambda: [exposed().depth(device="cpu"), exposed().depth(method="peak", device="cpu")],
    "arrival times": lambda: [
        spadwarp.arrival_time(
            counts().counts, gate_start=0, bin_width=4e-10, method=name, min_significance=0, device="cpu"
        )
        for name in ("centroid", "peak")
    ],
    "analytic frames": lambda: [
        np.asarray(getattr(spadwarp.simulate_analytic(scene(), frames=3, seed=2, device="cpu"), k))
        for k in ("signal", "depth")
    ],
    "plan": lambda: [
        np.asarray(spadwarp.sweep(scene(), vary="medium.extinction=0.2:0.6:3", device="cpu").column("signal"))
    ],
    "bounds": lambda: [spadwarp.crlb(exposed(), device="cpu")],
    "resume": of_parts,
    "dataset": of_dataset,
}


def versions():
    """What the bits hold for."""
    import warp as wp

    return {
        "numpy": np.__version__,
        "warp": wp.__version__,
        "processor": wp.get_cpu_kernel_cache_key(),
        "machine": platform.machine(),
    }


def bits(name):
    digest = hashlib.sha256()
    # Some lasers stand where a housing as wide as the lens would be, which is refused since this was recorded.
    with mock.patch("spadwarp.transport.model.within_port", lambda *_: None):
        for array in CASES[name]():
            array = np.ascontiguousarray(array)
            digest.update(f"{array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()[:16]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", help="record the bits of this code")
    parser.add_argument("--only", default="", help="cases whose name contains this")
    options = parser.parse_args()
    recorded = json.loads(RECORD.read_text()) if RECORD.exists() else {"bits": {}}
    found = {}
    for name in CASES:
        if options.only in name:
            found[name] = bits(name)
            state = "recorded" if options.write else "same" if recorded["bits"].get(name) == found[name] else "DIFFERS"
            print(f"{state:8}  {name}", flush=True)
            if options.write:
                record = {"versions": versions(), "bits": recorded["bits"] | found}
                RECORD.write_text(json.dumps(record, indent=1) + "\n")
    if not options.write and any(recorded["bits"].get(name) != value for name, value in found.items()):
        raise SystemExit(f"bits differ; recorded with {recorded.get('versions')}, now {versions()}")


if __name__ == "__main__":
    main()
