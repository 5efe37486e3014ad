"""Sediment between the camera and the target: where it lies, and what the camera sees with and without a gate.

python docs/figures/sediment.py
"""

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import spadwarp
from spadwarp.mesh import build_mesh
from spadwarp.result import Result
from spadwarp.viz import style
from spadwarp.viz.scenes import draw_slice

GATE = (34.5, 38.5)  # [ns], about the target

Floats = NDArray[np.float64]


def _times(result: Result) -> Floats:
    """Middles of the bins [ns]."""
    return 0.5e9 * (result.bin_edges[1:] + result.bin_edges[:-1])


def images(result: Result) -> tuple[Floats, Floats]:
    """Expected detections per pulse by pixel: of all light, as the eye or a camera without a gate sees it, and within
    the gate."""
    values = result.detections
    times = _times(result)
    return values.sum(axis=-1), values[..., (times >= GATE[0]) & (times < GATE[1])].sum(axis=-1)


def target_share(result: Result) -> tuple[float, float]:
    """Part of the light that comes from the target, of all light and within the gate."""
    times = _times(result)
    inside = (times >= GATE[0]) & (times < GATE[1])
    water, whole = result.component("backscatter"), result.histogram
    return 1.0 - float(water.sum() / whole.sum()), 1.0 - float(water[..., inside].sum() / whole[..., inside].sum())


@style.paper()
def draw(path: Path, photons: int, device: str | None) -> None:
    """Writes the figure."""
    scene = spadwarp.load_scene("sediment_4m")
    result = spadwarp.simulate(scene, photons=photons, device=device)
    print("part of the light that comes from the target: all light {:.3f}, gate {:.3f}".format(*target_share(result)))
    figure = style.new_figure(style.PAGE, 4.4)
    (side, histogram), (whole, gated) = figure.subplots(2, 2)
    image = draw_slice(side, scene, build_mesh(scene), 1)
    figure.colorbar(image, ax=side, label="extinction [1/m]")
    side.set_title("from the side")
    side.legend(fontsize=6)
    times = _times(result)
    for name, (label, colour) in style.COMPONENTS.items():
        values = result.component(name)[18:30, 18:30].mean(axis=(0, 1))
        histogram.semilogy(times, np.where(values > 0, values, np.nan), color=colour, label=label, lw=1.0)
    histogram.axvspan(*GATE, color="0.9")
    histogram.set_ylim(bottom=1e-19)
    histogram.set_xlabel("time of flight [ns]")
    histogram.set_ylabel("light per bin")
    histogram.set_title("middle of the image; grey: the gate")
    histogram.legend(fontsize=6)
    for axis, values, title in zip((whole, gated), images(result), ("all light", "light of the gate"), strict=True):
        drawn = axis.imshow(values, cmap=style.INTENSITY_MAP, vmin=0.0, vmax=np.percentile(values, 99.5))
        figure.colorbar(drawn, ax=axis, label="detections per pulse")
        axis.set_title(title)
        axis.set_xticks([])
        axis.set_yticks([])
    style.save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "images" / "sediment.png")
    parser.add_argument("--photons", type=int, default=20_000_000)
    parser.add_argument("--device")
    options = parser.parse_args()
    draw(options.out, options.photons, options.device)


if __name__ == "__main__":
    main()
