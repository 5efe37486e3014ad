"""Absorption, scattering and group index of water over the wavelength, for some chlorophyll concentrations.

python docs/figures/water.py
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import spadwarp
from spadwarp.viz import style

CHLOROPHYLL = (0.0, 0.05, 0.5, 5.0)  # [mg/m³]
COLOURS = ("0.45", style.BLUE, style.GREEN, style.RED)
WATERS = {"sea, 20 °C": (20.0, 35.0), "sea, 5 °C": (5.0, 35.0), "fresh, 20 °C": (20.0, 0.0)}


@style.paper()
def draw(path: Path) -> None:
    """Writes the figure."""
    wavelength = np.linspace(400.0, 700.0, 301)
    figure = style.new_figure(style.PAGE, 2.7)
    absorption, scattering, index = figure.subplots(1, 3)
    for chlorophyll, colour in zip(CHLOROPHYLL, COLOURS, strict=True):
        optics = [spadwarp.water.water_optics(float(one), chlorophyll=chlorophyll) for one in wavelength]
        label = f"{chlorophyll:g} mg/m³" if chlorophyll else "pure seawater"
        absorption.semilogy(wavelength, [one.absorption for one in optics], color=colour, label=label)
        scattering.semilogy(wavelength, [one.scattering for one in optics], color=colour, label=label)
    for (label, (temperature, salinity)), line in zip(WATERS.items(), ("-", "--", ":"), strict=True):
        group = spadwarp.water.group_index(wavelength, temperature=temperature, salinity=salinity)
        index.plot(wavelength, group, line, color="0.2", label=label)
    for axis, title in ((absorption, "absorption a [1/m]"), (scattering, "scattering b [1/m]"), (index, "group index")):
        _finish(axis, title)
    for axis in (absorption, scattering):
        style.log_axis(axis, "y")
    index.yaxis.minorticks_on()
    absorption.legend(title="chlorophyll", frameon=True, framealpha=1.0, edgecolor="none", borderpad=0.1)
    index.legend()
    style.save(figure, path)


def _finish(axis: Any, title: str) -> None:
    axis.set(xlabel="vacuum wavelength [nm]", ylabel=title, xlim=(400.0, 700.0))
    axis.axvline(532.0, color="0.7", linewidth=0.8, zorder=0)
    axis.xaxis.minorticks_on()
    style.plain_axis(axis)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    here = Path(__file__).parents[1] / "images" / "water.png"
    parser.add_argument("--out", type=Path, default=here, help="the picture to write")
    draw(parser.parse_args().out)


if __name__ == "__main__":
    main()
