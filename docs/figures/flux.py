"""The picture of docs/flux.md: a beam in harbour water, and sun and sky over a clear sea.

python docs/figures/flux.py
"""

from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm

import spadwarp
from spadwarp.scene import Scene
from spadwarp.viz import style

IMAGES = Path(__file__).parents[1] / "images"
BEAM = {
    "medium": {"preset": "petzold-nuc-2040"},
    "laser": {"half_angle_deg": 1.0},
    "camera": {"width": 1, "height": 1, "horizontal_fov_deg": 10.0, "aperture_diameter": 0.01},
    "gate": {"bin_width_ps": 1e3, "bins": 1},
    "flux": [{"name": "beam", "voxels": [80, 1, 160], "lower": [-1.0, -0.1, 0.0], "upper": [1.0, 0.1, 4.0]}],
    "transport": {"estimator": "none", "axis_threshold": 1.0},
}


@style.paper()
def main() -> None:
    figure = style.new_figure(style.PAGE, 2.9)
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.5, 1, 1))
    beam = spadwarp.simulate(Scene.from_dict(BEAM), photons=1_000_000, seed=1).flux["beam"]["fluence"]
    image = beam.values[0, :, 0]
    top = float(image.max())
    shown = left.imshow(
        np.maximum(image, 1e-5 * top), norm=LogNorm(1e-5 * top, top), cmap=style.INTENSITY_MAP, extent=(0, 4, 1, -1)
    )
    left.set(xlabel="z [m]", ylabel="x [m]", title="laser, c = 2.19 1/m")
    figure.colorbar(shown, ax=left, label="fluence [1/m²]", orientation="horizontal", shrink=0.9)
    sea = spadwarp.simulate("configs/scenes/sea_noon.toml", photons=1_000_000, seed=1)
    light, seen = sea.flux["depths"]["irradiance"], spadwarp.result.apparent(sea)
    for k, kind in enumerate(light.dimensions["kind"][0]):
        middle.plot(light.values[:, k], seen.position, ".-", color=style.SERIES[k], label=kind.replace("_", " "))
    for k, name in enumerate(("attenuation", "reflectance", "mean_cosine")):
        places = seen.middle if name == "attenuation" else seen.position
        label = {"attenuation": "K_d [1/m]", "reflectance": "R", "mean_cosine": "mean cosine"}[name]
        right.errorbar(
            getattr(seen, name), places, xerr=seen.errors[name], fmt=".-", color=style.SERIES[k], label=label
        )
    for axis, label in ((middle, "over that on the surface"), (right, "apparent optical properties")):
        style.plain_axis(axis)
        style.log_axis(axis, "x")
        axis.set(xlabel=label, ylabel="depth [m]", ylim=(30, 0))
        axis.legend(fontsize=6, loc="lower left" if axis is middle else "lower center")
    middle.set_title("sun and sky, c = 0.177 1/m")
    style.save(figure, IMAGES / "flux.png")


if __name__ == "__main__":
    main()
