"""What not knowing the water costs in depth: Cramér–Rao bounds with known and with unknown water.

python docs/figures/water_unknown.py
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import spadwarp
from spadwarp.inverse import Bounds, bounds
from spadwarp.scene import Scene
from spadwarp.viz import style

EXTINCTIONS = (0.1, 0.3, 0.6, 1.0)
DISTANCE = 5.0
WATER = "absorption,scattering,reflectance"
PULSES = 1000


def scene(extinction: float) -> Scene:
    """The wall of `plane_5m` with the response and the bins of a SPAD camera."""
    changes: dict[str, Any] = {
        "medium": {"extinction": extinction, "albedo": 0.8, "group_index": "seawater"},
        "laser": {"preset": "picoquant-visuv-532", "half_angle_deg": 6.0},
        "camera": {"width": 16, "height": 16},
        "detector": {"preset": "photon-force-pf32-microlens"},
        "gate": {"start_ns": 30.0, "bin_width_ps": 55.0, "bins": 363},
        "transport": {"estimator": "guided", "max_collisions": 128, "weight_cutoff": 1e-6},
    }
    return spadwarp.load_scene("plane_5m", changes)


def bound(extinction: float, depth: str, photons: int) -> Bounds:
    """Bounds of the depth and the water together."""
    found = bounds(scene(extinction), unknown=f"{WATER},{depth}", pulses=PULSES, photons=photons)
    for text in found.warnings:
        print(f"{extinction:g} 1/m: {text}")
    return found


@style.paper()
def main(photons: int = 4_000_000, path: Path = Path("docs/images/water_unknown.png")) -> None:
    """Draws the figure and prints its numbers."""
    figure = style.new_figure(style.PAGE, 2.9)
    left, right = figure.subplots(1, 2)
    depths = DISTANCE * np.array(EXTINCTIONS)
    for depth, label, colour in (("depth:pixel", "a pixel's own", style.BLUE), ("depth", "common", style.RED)):
        found = [bound(extinction, depth, photons).bounds["depth"] for extinction in EXTINCTIONS]
        together = 1e3 * np.array([one.standard_error for one in found])
        alone = 1e3 * np.array([one.alone for one in found])
        print(label, "mm", together.round(4), "known water", alone.round(4), "ratio", (together / alone).round(3))
        left.set_yscale("log")
        left.plot(depths, together, "o-", color=colour, markersize=3, label=f"{label}, water unknown")
        left.plot(depths, alone, linestyle=style.DASHED, color=colour, label=f"{label}, water known")
        right.plot(depths, together / alone, "o-", color=colour, markersize=3, label=label)
    left.set_ylim(top=30 * together.max())  # for the legend
    style.log_axis(left, "y")
    for axis, name in ((left, "bound of the depth [mm]"), (right, "unknown over known water")):
        axis.set(xlabel="optical depth c · 5 m, one way", ylabel=name)
        style.plain_axis(axis)
        axis.legend(loc="upper left" if axis is left else "upper right")
    style.save(figure, path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photons", type=float, default=4e6)
    main(int(parser.parse_args().photons))
