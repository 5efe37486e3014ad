"""The picture of docs/lidar_from_the_air.md: waveform and photons of a lidar 200 m over a bay, on a GPU.

python docs/figures/lidar_from_the_air.py
"""

from pathlib import Path

import numpy as np

import spadwarp
from spadwarp.files import photon_cloud
from spadwarp.viz import style

ROOT = Path(__file__).parents[2]
KINDS = {**style.COMPONENTS, "noise": ("ambient light, dark counts", "#999999")}


@style.paper()
def main() -> None:
    result = spadwarp.simulate(ROOT / "configs/scenes/bay_200m.toml", photons=2_000_000_000, seed=1, device="cuda:0")
    figure = style.new_figure(style.PAGE, 2.9)
    left, right = figure.subplots(1, 2, sharey=True)
    per_pulse = result.detections.sum() / result.histogram.sum()
    for name in result.scene.components:
        light = per_pulse * result.component(name).sum(axis=(0, 1))
        shown = np.where(light > 0.0, light, np.nan)
        left.step(shown, 1e9 * np.asarray(result.bin_centres), where="mid", color=KINDS[name][1])
    left.set(xscale="log", xlim=(3e-7, 8), xlabel="detections per pulse and 0.5 ns, all pixels", title="waveform")
    left.set(ylabel="time of flight [ns]")
    left.invert_yaxis()
    cloud = photon_cloud(result, seed=1)
    for number, name in enumerate(cloud.components):
        those, (label, colour) = cloud.component == number, KINDS[name]
        right.plot(cloud.pulse[those], 1e9 * cloud.time_of_flight[those], ".", ms=1.5, color=colour, label=label)
    right.set(xlabel="pulse", title="photons of one frame")
    left.legend(*right.get_legend_handles_labels(), loc="center left", frameon=False, markerscale=5)
    style.save(figure, ROOT / "docs/images/lidar_from_the_air.png")


if __name__ == "__main__":
    main()
