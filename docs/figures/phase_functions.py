"""Henyey–Greenstein, Fournier–Forand and Petzold's average particle, over the scattering angle.

python docs/figures/phase_functions.py
"""

import argparse
from pathlib import Path

import numpy as np

import spadwarp
from spadwarp.scene import Medium
from spadwarp.viz import style

WATER = {"extinction": 0.3, "albedo": 0.8}
LAWS = {
    "Petzold's average particle": {"phase_function": "tabulated", "phase_table": "petzold-average-particle"},
    "Fournier–Forand, n 1.10, µ 3.5835": {"phase_function": "fournier_forand"},
    "Henyey–Greenstein, g 0.924": {"anisotropy": 0.924},
}
COLOURS = ("black", style.RED, style.BLUE)
STYLES = ("-", "-", "--")


def densities(angles: np.ndarray) -> dict[str, np.ndarray]:
    """p [1/sr] of each law at angles [°]."""
    return {
        name: spadwarp.scene.phase_function(Medium(**WATER, **fields)).density(np.radians(angles))
        for name, fields in LAWS.items()
    }


@style.paper()
def draw(path: Path) -> None:
    """Writes the figure."""
    figure = style.new_figure(style.PAGE, 3.1)
    for axis, angles in zip(
        figure.subplots(1, 2), (np.geomspace(0.01, 180.0, 2000), np.linspace(90.0, 180.0, 500)), strict=True
    ):
        for (name, values), colour, line in zip(densities(angles).items(), COLOURS, STYLES, strict=True):
            axis.plot(angles, values, line, color=colour, label=name)
        axis.set_xlabel("scattering angle [°]")
        style.plain_axis(axis)
    forward, backward = figure.axes
    forward.set(xscale="log", yscale="log", xlim=(0.01, 180.0), ylabel="phase function [1/sr]")
    backward.set(xlim=(90.0, 180.0), ylim=(0.0, None), xticks=range(90, 181, 15), ylabel="phase function [1/sr]")
    backward.minorticks_on()
    style.log_axis(forward, "x")
    style.log_axis(forward, "y", most=9)
    forward.legend()
    style.save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "images" / "phase_functions.png")
    draw(parser.parse_args().out)


if __name__ == "__main__":
    main()
