"""What a port does to the view, and what a camera model that does not know it makes of times of flight.

python docs/figures/ports.py
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene import Scene
from spadwarp.scene.sight import LinesOfSight, lines_of_sight, pixel_directions, range_from_path
from spadwarp.viz import style

PORTS: dict[str, dict[str, Any]] = {
    "flat, 50 mm before the lens": {"preset": "flat-glass"},
    "dome, lens in its centre": {"preset": "dome-acrylic"},
    "dome, lens 5 mm in front": {"preset": "dome-acrylic", "offset": [0.0, 0.0, -0.005]},
}
COLOURS = (style.BLUE, style.GREEN, style.RED)
DEPTH = 5.0  # of the plane that is measured [m]
CALIBRATED = 2.0  # at which a pinhole model was fitted in the water [m]

Floats = NDArray[np.float64]


def scene(port: dict[str, Any]) -> Scene:
    """A camera of 60 degrees in air, the laser in its lens."""
    return Scene.from_dict(
        {
            "medium": {"extinction": 0.3, "albedo": 0.8},
            "laser": {"port": "camera"},
            "camera": {"width": 241, "height": 1, "horizontal_fov_deg": 60.0, "aperture_diameter": 0.005, "port": port},
            "gate": {"start_ns": 0.0, "bin_width_ps": 100.0, "bins": 10},
        }
    )


def on_plane(lines: LinesOfSight, depth: float) -> tuple[Floats, Floats]:
    """Points that the pixels see on a plane across the axis, and the path of their light."""
    distance = lines.range_from_depth(np.full(lines.lead.shape, depth))
    return lines.points(distance), lines.path_from_range(distance)


def errors(port: dict[str, Any]) -> tuple[Floats, Floats, Floats, Floats]:
    """Angle in air and in water [degrees]; error of depth and of position across by a calibration in air [m]."""
    one = scene(port)
    lines, view = lines_of_sight(one)[0], pixel_directions(one.camera)[0]
    points, path = on_plane(lines, DEPTH)
    taken_for = range_from_path(path, view, np.zeros(3))[:, None] * view
    in_air, in_water = (np.degrees(np.arctan2(u[:, 0], u[:, 2])) for u in (view, lines.direction))
    return in_air, in_water, taken_for[:, 2] - points[:, 2], taken_for[:, 0] - points[:, 0]


def pinhole_error(port: dict[str, Any], depth: float) -> Floats:
    """Error across [m] of a pinhole in the lens whose directions are right at the depth of its calibration."""
    lines = lines_of_sight(scene(port))[0]
    fitted = on_plane(lines, CALIBRATED)[0][:, 0] / CALIBRATED
    return fitted * depth - on_plane(lines, depth)[0][:, 0]


@style.paper()
def draw(path: Path) -> None:
    """Writes the figure."""
    figure = style.new_figure(style.PAGE, 2.7)
    angle, depth, across = figure.subplots(1, 3)
    for (label, port), colour in zip(PORTS.items(), COLOURS, strict=True):
        in_air, in_water, error, _ = errors(port)
        angle.plot(in_air, in_water, color=colour, label=label)
        depth.plot(in_air, 1e3 * error, color=colour)
    flat = PORTS["flat, 50 mm before the lens"]
    for far, line in ((1.0, ":"), (5.0, "-"), (10.0, "--")):
        across.plot(in_air, 1e3 * pinhole_error(flat, far), line, color="0.2", label=f"at {far:g} m")
    angle.set(ylabel="angle in water [°]")
    angle.legend(loc="upper left", fontsize=6.5)
    depth.set(ylabel=f"error of depth at {DEPTH:g} m [mm]")
    across.set(ylabel="error across [mm]")
    across.legend(title=f"pinhole fitted at {CALIBRATED:g} m")
    for axis in (angle, depth, across):
        axis.set(xlabel="angle in air [°]", xlim=(0.0, 30.0))
        axis.xaxis.minorticks_on()
        axis.yaxis.minorticks_on()
        style.plain_axis(axis)
    angle.set(ylim=(0.0, 30.0))
    depth.set(ylim=(None, 20.0))
    style.save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    here = Path(__file__).parents[1] / "images" / "ports.png"
    parser.add_argument("--out", type=Path, default=here, help="the picture to write")
    draw(parser.parse_args().out)
    for label, port in PORTS.items():
        in_air, in_water, error, aside = errors(port)
        print(
            f"{label}: {in_air[-1]:.2f} -> {in_water[-1]:.2f} degrees; depth {1e3 * error[120]:.1f} mm on the axis, ",
            end="",
        )
        print(f"{1e3 * error[-1]:.1f} mm at the edge; across {1e3 * aside[-1]:.1f} mm")
    print(
        "pinhole in water:",
        *(
            f"{1e3 * pinhole_error(PORTS['flat, 50 mm before the lens'], far)[-1]:.2f} mm at {far} m"
            for far in (1.0, 5.0, 10.0)
        ),
    )


if __name__ == "__main__":
    main()
