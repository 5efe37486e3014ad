"""Published networks for single-photon histograms, and ours, on the same Middlebury scenes at low resolution.

    python bench/peers/run_single_photon.py DATA --peer "PRSNet=python infer.py --in {mat} --out {npy}"

DATA: folder with the files LR_*.mat that the authors of STIN publish (GitHub: ewellchen/DA-STIN): sparse `spad`
[width · height, 1024] in bins of 80 ps, `depth` [m]. A peer is a name and a command, run once for each file: it reads
{mat} and writes depth [m], [height, width], to {npy}. Its code and weights are yours to get; nothing of them is here.
A constant offset (the median difference) is taken off everybody's error, as the authors do.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from spadwarp.denoise import estimate
from spadwarp.denoise.baselines import CLASSICAL

BIN = 80e-12  # [s]
RESPONSE = np.array([0.029, 0.096, 0.229, 0.394, 0.462, 0.384, 0.247, 0.099, 0.030])
RESPONSE /= RESPONSE.sum()
GATE = (0.0, 0.5 * 299_792_458.0 * BIN * 1024)


def read(path):
    """Counts `[H, W, 1024]` and true depth `[H, W]` [m]."""
    content = loadmat(path)
    depth = content["depth"]
    height, width = depth.shape
    counts = np.asarray(content["spad"].todense()).reshape(width, height, -1).transpose(1, 0, 2)
    return counts, depth


def own(counts, model):
    """Depth of every pixel by a method of ours, from counts alone."""
    places = np.argmax(np.apply_along_axis(np.convolve, -1, counts, RESPONSE[::-1], mode="same"), axis=-1)
    depth = GATE[1] * (places + 0.5) / counts.shape[-1]
    return estimate(depth, gate=GATE, model=model, counts=counts, response=RESPONSE, min_significance=0.0).depth


def peer(command, path):
    """Depth by the command of a peer."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "depth.npy"
        subprocess.run(command.format(mat=path, npy=out), shell=True, check=True)
        return np.load(out)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--peer", action="append", default=[], metavar="NAME=COMMAND")
    arguments = parser.parse_args()
    peers = dict(item.split("=", 1) for item in arguments.peer)
    files = sorted(arguments.data.glob("LR_*.mat"))
    if not files:
        print(f"{arguments.data}: no LR_*.mat there")
        return
    errors = {}
    for path in files:
        counts, truth = read(path)
        for name in ("histograms", *CLASSICAL, *peers):
            began = time.perf_counter()
            depth = peer(peers[name], path) if name in peers else own(counts, name)
            seconds = time.perf_counter() - began
            error = depth - truth
            rmse = 1e3 * float(np.sqrt(np.mean((error - np.median(error)) ** 2)))
            errors.setdefault(name, []).append(rmse)
            print(f"{path.stem:14s} {name:16s} {rmse:8.1f} mm {seconds:8.2f} s", flush=True)
    for name, values in errors.items():
        print(f"{'mean':14s} {name:16s} {np.mean(values):8.1f} mm")


if __name__ == "__main__":
    main()
