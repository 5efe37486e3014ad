"""The picture of waves in docs/lidar_from_the_air.md: heights, and errors of depths by the mean plane.

python docs/figures/waves.py
"""

import math
from pathlib import Path

import numpy as np

import spadwarp
from spadwarp.transport import wave_errors
from spadwarp.viz import style

ROOT = Path(__file__).parents[2]
PIXELS, SIZE = 256, 20.0
VIEW = {
    "surface.preset": None,
    "surface.waves.size": SIZE,
    "camera.width": PIXELS,
    "camera.height": PIXELS,
    "camera.rotation_deg": [0.0, 0.0, 0.0],
    "camera.horizontal_fov_deg": 2.0 * math.degrees(math.atan(0.5 * SIZE / 200.0)),
    "targets[0].translation": [0.0, 0.0, 208.0],
}


@style.paper()
def main() -> None:
    figure = style.new_figure(style.PAGE, 5.2)
    rows = figure.subplots(2, 2, sharex=True, sharey=True)
    for row, (wind, fetch) in zip(rows, ((5.0, 10e3), (12.0, 2e3)), strict=True):
        bay = spadwarp.load_scene(ROOT / "configs/scenes/bay_200m.toml")
        sea = bay.with_overrides({**VIEW, "surface.wind": wind, "surface.waves.fetch": fetch})
        field = sea.surface.wave_field
        # A pixel's row is the plane's y, a row of the field goes along its x: the camera looks down on both.
        heights = np.roll(field.heights, (256, 256), axis=(0, 1))[::-1]
        for axes, values, label in ((row[0], heights, "height [m]"), (row[1], wave_errors(sea), "error of depth [m]")):
            most = float(np.nanmax(np.abs(values)))
            half = 0.5 * SIZE
            shown = axes.imshow(values, cmap="RdBu_r", vmin=-most, vmax=most, extent=(-half, half, half, -half))
            figure.colorbar(shown, ax=axes, label=label, shrink=0.9)
            spread = float(np.nanstd(values))
            axes.set_title(f"{wind:g} m/s: {label.partition(' [')[0]}, rms {100 * spread:.1f} cm")
        row[0].set_ylabel("y [m]")
    for axes in rows[1]:
        axes.set_xlabel("x [m]")
    style.save(figure, ROOT / "docs/images/waves.png")


if __name__ == "__main__":
    main()
