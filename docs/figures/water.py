"""Absorption, scattering and group index of water over the wavelength, for some chlorophyll concentrations.

python docs/figures/water.py
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import spadwarp

CHLOROPHYLL = (0.0, 0.05, 0.5, 5.0)  # [mg/m³]
COLOURS = ("0.45", "#0072b2", "#009e73", "#d55e00")
WATERS = {"sea, 20 °C": (20.0, 35.0), "sea, 5 °C": (5.0, 35.0), "fresh, 20 °C": (20.0, 0.0)}


def draw(path: Path) -> None:
    """Writes the figure."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib.figure import Figure

    wavelength = np.linspace(400.0, 700.0, 301)
    figure = Figure(figsize=(10.0, 3.6), layout="constrained", dpi=150)
    absorption, scattering, index = figure.subplots(1, 3)
    for chlorophyll, colour in zip(CHLOROPHYLL, COLOURS, strict=True):
        optics = [spadwarp.water.water_optics(float(one), chlorophyll=chlorophyll) for one in wavelength]
        label = f"{chlorophyll:g} mg/m³" if chlorophyll else "pure seawater"
        absorption.semilogy(wavelength, [one.absorption for one in optics], color=colour, label=label)
        scattering.semilogy(wavelength, [one.scattering for one in optics], color=colour, label=label)
    for (label, (temperature, salinity)), style in zip(WATERS.items(), ("-", "--", ":"), strict=True):
        group = spadwarp.water.group_index(wavelength, temperature=temperature, salinity=salinity)
        index.plot(wavelength, group, style, color="0.2", label=label)
    for axis, title in ((absorption, "absorption a [1/m]"), (scattering, "scattering b [1/m]"), (index, "group index")):
        _finish(axis, title)
    absorption.legend(title="chlorophyll", fontsize=8, title_fontsize=8)
    index.legend(fontsize=8)
    figure.savefig(path)


def _finish(axis: Any, title: str) -> None:
    axis.set(xlabel="vacuum wavelength [nm]", title=title, xlim=(400.0, 700.0))
    axis.axvline(532.0, color="0.8", linewidth=0.8, zorder=0)
    axis.grid(alpha=0.25)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    here = Path(__file__).parents[1] / "images" / "water.png"
    parser.add_argument("--out", type=Path, default=here, help="the picture to write")
    draw(parser.parse_args().out)


if __name__ == "__main__":
    main()
