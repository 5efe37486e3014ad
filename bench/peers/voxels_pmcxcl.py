"""Water that varies from place to place: a block of voxels on MCX-CL and on spadwarp, compared by what leaves it.

Three layers and a dense ball, each with its own absorption, scattering and mean cosine, matched at the faces. A pencil
beam goes in; of each photon that leaves, face, place, time of flight and weight are known to both. Compared are the
mean weights by face and time gate and by place on two faces, with standard errors of both from the photons' weights.
"""

import argparse
import math
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from _common import captured_output, options, peer, skip
from _cube60 import CPU_OPTIONS, opencl_device
from scipy import stats

EDGE = 40  # voxels of 1 mm
FACES = ("x_low", "x_high", "y_low", "y_high", "z_low", "z_high")
# Absorption and scattering [1/mm], mean cosine: of the layers, and of the ball.
WATERS = ((0.002, 0.3, 0.9), (0.02, 1.0, 0.7), (0.005, 0.15, 0.8), (0.1, 2.0, 0.4))
SOURCE = (19.4, 20.7)
GATES = 1e-12 * np.array([0.0, 30.0, 60.0, 100.0, 140.0, 170.0, 200.0, 250.0, 300.0, 400.0, 600.0, 3000.0])
PATCHES = np.linspace(0.0, EDGE, 6)
FEWEST = 200  # photons of a bin
SPEED = 299_792_458_000.0  # of light [mm/s]

Values = np.ndarray


def labels() -> Values:
    """Which water each voxel holds, `[x, y, z]`."""
    x, y, z = np.meshgrid(*[np.arange(EDGE) + 0.5] * 3, indexing="ij")
    found = np.where(z < 12.0, 0, np.where(z < 24.0, 1, 2))
    found[(x - 24.0) ** 2 + (y - 18.0) ** 2 + (z - 17.0) ** 2 < 7.0**2] = 3
    return found


def binned(exit_point: Values, time: Values, weight: Values, photons: int) -> tuple[Values, Values, Values]:
    """Mean weight of a photon in each bin, its standard error, and the number of photons there.

    exit_point: `[P, 3]` [mm]; time: `[P]` [s]; weight: `[P]`, of the photons that left.
    """
    beyond = np.stack([-exit_point, exit_point - EDGE], axis=2).reshape(len(time), 6)
    face = beyond.argmax(axis=1)
    gate = np.digitize(time, GATES) - 1
    number = face * (len(GATES) - 1) + gate
    bins = 6 * (len(GATES) - 1)
    last = len(PATCHES) - 2
    i, j = (np.clip(np.digitize(exit_point[:, k], PATCHES) - 1, 0, last) for k in (0, 1))
    patch = (i * (last + 1) + j) + (last + 1) ** 2 * (face == 5)
    columns = [(number, weight, bins), (patch, np.where(face >= 4, weight, 0.0), 2 * (last + 1) ** 2)]
    means, squares, counts = [], [], []
    for index, values, size in columns:
        means.append(np.bincount(index, values, size) / photons)
        squares.append(np.bincount(index, values**2, size) / photons)
        counts.append(np.bincount(index[values > 0.0], minlength=size))
    mean, square = np.concatenate(means), np.concatenate(squares)
    return mean, np.sqrt(np.maximum(square - mean**2, 0.0) / photons), np.concatenate(counts)


def run_mcx(pmcxcl: ModuleType, photons: int, seed: int, device: dict[str, Any]) -> tuple[Values, Values, Values]:
    """Bins of one run of MCX-CL, without the fast approximate functions of its default."""
    settings = {
        "nphoton": photons,
        "vol": (labels() + 1).astype(np.uint8),
        "prop": [[0.0, 0.0, 1.0, 1.0], *([a, b, g, 1.0] for a, b, g in WATERS)],
        "srcpos": [*SOURCE, 0.0],
        "srcdir": [0.0, 0.0, 1.0],
        "issrcfrom0": 1,
        "tstart": 0.0,
        "tend": float(GATES[-1]),
        "tstep": float(GATES[-1]),
        "isreflect": 0,
        "issave2pt": 0,
        "issavedet": 1,
        "bc": "aaaaaa111111",
        "savedetflag": "PX",
        "maxdetphoton": photons,
        "optlevel": 0,
        "seed": seed,
        **device,
    }
    with captured_output():
        found = pmcxcl.run(settings)["detp"]
    rows = found if isinstance(found, dict) else {"ppath": found[: len(WATERS)].T, "p": found[len(WATERS) :].T}
    ways = np.asarray(rows["ppath"], np.float64)
    weight = np.exp(-ways @ np.array([water[0] for water in WATERS]))
    return binned(np.asarray(rows["p"], np.float64), ways.sum(axis=1) / SPEED, weight, photons)


def run_spadwarp(tracking: str, args: argparse.Namespace) -> tuple[Values, Values, Values]:
    """Bins of our photons through the same voxels, in metres."""
    import spadwarp

    a, b, g = (np.array([water[k] for water in WATERS])[labels()] for k in range(3))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "voxels.npz"
        np.savez(file, absorption=1e3 * a, scattering=1e3 * b, anisotropy=g, size=[1e-3 * EDGE] * 3, origin=[0.0] * 3)
        scene = spadwarp.Scene.from_dict(
            {
                "medium": {
                    "extinction": 1.0,
                    "albedo": 0.5,
                    "anisotropy": 0.5,
                    "group_index": 1.0,
                    "grid": {"file": str(file), "tracking": tracking},
                },
                "laser": {
                    "profile": "collimated",
                    "beam_radius": 0.0,
                    "position": [1e-3 * SOURCE[0], 1e-3 * SOURCE[1], 0.0],
                },
                "camera": {"width": 1, "height": 1, "horizontal_fov_deg": 1.0, "aperture_diameter": 0.01},  # not used
                "gate": {"bin_width_ps": 5000.0, "bins": 1},
                "domain": {"shape": "box", "lower": 0.0, "upper": 1e-3 * EDGE},
                "transport": {
                    "max_path": 1e-3 * SPEED * float(GATES[-1]),
                    "weight_cutoff": 0.0,
                    "max_collisions": 2**31 - 1,
                    "axis_threshold": 1.0,
                },
            }
        )
        found = spadwarp.transport.trace(scene, photons=args.photons, seed=args.seed, device=args.device)
    left = found.ended(*(f"exit_{face}" for face in FACES))
    time = 1e3 * found.path[left].astype(np.float64) / SPEED
    return binned(1e3 * found.position[left].astype(np.float64), time, found.weight[left], args.photons)


def report(name: str, ours: tuple[Values, Values, Values], theirs: tuple[Values, Values, Values]) -> None:
    """Prints how far both are apart."""
    enough = (ours[2] >= FEWEST) & (theirs[2] >= FEWEST)
    error = np.hypot(ours[1], theirs[1])[enough]
    z = (ours[0] - theirs[0])[enough] / error
    relative = error / theirs[0][enough]
    gated = 6 * (len(GATES) - 1)
    worst = float(np.abs(z).max())
    p = -math.expm1(len(z) * math.log1p(-2.0 * stats.norm.sf(worst)))
    print(f"{name}: {enough[:gated].sum()} gates of faces and {enough[gated:].sum()} places, standard errors", end=" ")
    print(f"{100 * relative.min():.2f} to {100 * relative.max():.1f} %, median {100 * np.median(relative):.2f} %")
    for face, label in enumerate(FACES):
        own, other = (sum_of_face(values[0], face) for values in (ours, theirs))
        errors = [math.sqrt(sum_of_face(values[1] ** 2, face)) for values in (ours, theirs)]
        apart = (own - other) / max(math.hypot(*errors), 1e-300)
        print(f"  out by {label:<7} {own:.6f}, MCX {other:.6f}: {apart:+.2f} combined standard errors apart")
    print(f"  by bins: mean of z^2 {np.mean(z**2):.3f}, largest |z| {worst:.2f}, family-wise p {p:.3g}")


def sum_of_face(values: Values, face: int) -> float:
    """Over the gates of a face."""
    gates = len(GATES) - 1
    return float(values[face * gates : (face + 1) * gates].sum())


if __name__ == "__main__":
    pmcxcl = peer("pmcxcl", "pip install pmcxcl (GPL, needs an OpenCL driver)")
    summary = "a block of voxels on MCX-CL and on spadwarp: do they agree?"
    args = options(summary, photons=2 * 10**6, more={"seed": (1, "of both")}, repeats=False)
    cpu = args.device == "cpu"
    chosen = {"gpuid": opencl_device(pmcxcl, "pmcxcl", cpu), **(CPU_OPTIONS if cpu else {})}
    try:
        theirs = run_mcx(pmcxcl, args.photons, args.seed, chosen)
    except RuntimeError as error:
        skip(f"pmcxcl cannot run on this machine's devices ({' '.join(str(error).split())})")
    print(f"{args.photons} photons each, voxels of {EDGE}^3")
    for tracking in ("regular", "delta"):
        report(tracking, run_spadwarp(tracking, args), theirs)
