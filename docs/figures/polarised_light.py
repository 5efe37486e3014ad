"""What cross-polarised reception gains: signal to backscatter against optical depth, with and without an analyser.

python docs/figures/polarised_light.py           # simulates, writes the numbers beside this file, draws
python docs/figures/polarised_light.py --redraw  # from the numbers
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import spadwarp
from spadwarp.viz import style

# One-way optical depths from laser to target.
OPTICAL_DEPTHS = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0)
DISTANCE = 5.0  # of the target [m]
ALBEDO = 0.833  # Petzold's harbour
RUNS = 8  # independent, behind each error bar
METRE = 1e9 / 299_792_458.0  # time in which light goes a metre at index 1 [ns]
GATED = (9.0, 11.0)  # path [m]: half a metre of range before and behind the target

# Absorption and scattering [1/m] under an airborne lidar: Petzold's coastal water, and a more turbid one.
WATERS = ((0.179, 0.219), (0.25, 0.75))

CHANNELS = ("I", "co", "cross")
LOOKS = {
    "I": ("without an analyser", "black", "o"),
    "co": ("co-polarised", style.BLUE, "s"),
    "cross": ("cross-polarised", style.RED, "^"),
}


def scene(optical_depth: float) -> spadwarp.Scene:
    """A grey wall at 5 m in ocean particles, lit by a horizontally polarised cone that overfills the view."""
    width = 0.05  # of a bin [m]
    return spadwarp.Scene.from_dict(
        {
            "medium": {
                "extinction": optical_depth / DISTANCE,
                "albedo": ALBEDO,
                "phase_function": "fournier_forand",
                "scattering_matrix": "voss_fry",
                "group_index": 1.0,
                "phase_index": 1.0,
            },
            "laser": {"position": [-0.1, 0.0, 0.0], "half_angle_deg": 10.0, "polarisation": "linear"},
            "camera": {
                "width": 16,
                "height": 16,
                "horizontal_fov_deg": 10.0,
                "aperture_diameter": 0.01,
                "polarisation": "analyser",
            },
            "gate": {"start_ns": METRE, "bin_width_ps": width * METRE * 1e3, "bins": round(14.0 / width)},
            "targets": [
                {"builtin": "plane", "size": [8.0, 8.0], "translation": [0.0, 0.0, DISTANCE], "reflectance": 0.5}
            ],
            "transport": {"max_collisions": 200, "axis_threshold": 1.0},
        }
    )


def ratios(optical_depth: float, *, photons: int, seed: int) -> NDArray[np.float64]:
    """Signal to backscatter in each channel, then cross over co of the water about the target and of all the water."""
    result = spadwarp.simulate(scene(optical_depth), photons=photons, seed=seed, device="cpu")
    path = result.path_edges[:-1] + 1e-6
    gated = (path > GATED[0]) & (path < GATED[1])
    target, near, water = (np.zeros(len(CHANNELS)) for _ in range(3))
    for k, channel in enumerate(CHANNELS):
        seen = spadwarp.result.analyser_channel(result, channel)
        back = seen.component("backscatter")
        target[k] = (seen.component("ballistic") + seen.component("forward_scattered"))[..., gated].sum()
        near[k], water[k] = back[..., gated].sum(), back.sum()
    return np.array([*(target / near), near[2] / near[1], water[2] / water[1]])


def measure(optical_depth: float, *, photons: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means of `ratios` over independent runs, and their standard errors."""
    first = RUNS * OPTICAL_DEPTHS.index(optical_depth)  # random numbers of its own for each depth
    runs = np.stack([ratios(optical_depth, photons=photons // RUNS, seed=first + run) for run in range(RUNS)])
    return runs.mean(axis=0), runs.std(axis=0, ddof=1) / np.sqrt(RUNS)


def attenuation(absorption: float, scattering: float, *, photons: int, seed: int = 0) -> NDArray[np.float64]:
    """By what the light of a wide lidar, 100 m above the water, decays with depth in the channels [1/m].

    From 1 to 9 m of depth, without the decrease with the square of the distance; beam and view are 5 m wide at the
    surface, which does not refract.
    """
    above, step = 100.0, 0.5
    lidar = spadwarp.Scene.from_dict(
        {
            "medium": {
                "absorption": 1e-6,
                "scattering": 1e-9,
                "phase_function": "fournier_forand",
                "scattering_matrix": "voss_fry",
                "group_index": 1.0,
                "phase_index": 1.0,
                "layers": [{"start": above, "absorption": absorption, "scattering": scattering}],
            },
            "laser": {"profile": "collimated", "beam_radius": 2.5, "polarisation": "linear"},
            "camera": {
                "width": 2,
                "height": 2,
                "horizontal_fov_deg": float(np.degrees(2.0 * np.arctan(2.5 / above))),
                "aperture_diameter": 0.15,
                "polarisation": "analyser",
            },
            "gate": {"start_ns": 2.0 * (above + 1.0) * METRE, "bin_width_ps": 2.0 * step * METRE * 1e3, "bins": 16},
            "targets": [],
            "transport": {"max_collisions": 300, "axis_threshold": 1.0},
        }
    )
    result = spadwarp.simulate(lidar, photons=photons, seed=seed, device="cpu")
    depth = 1.0 + step * (np.arange(16) + 0.5)
    light = np.stack([result.channels[name].sum(axis=(0, 1, 2)) for name in ("co", "cross")])
    return -0.5 * np.polyfit(depth, np.log(light * (above + depth) ** 2).T, 1)[0]


@style.paper()
def draw(mean: NDArray[np.float64], error: NDArray[np.float64]) -> Any:
    """The figure from means and errors, `[optical depth, 5]`."""
    figure = style.new_figure(style.PAGE, 3.0)
    left, right = figure.subplots(1, 2)
    for k, channel in enumerate(CHANNELS):
        label, colour, marker = LOOKS[channel]
        left.errorbar(OPTICAL_DEPTHS, mean[:, k], yerr=error[:, k], label=label, color=colour, marker=marker)
    left.set(title="Signal to backscatter", ylabel="target over water, gate ±0.5 m", yscale="log")
    style.log_axis(left, "y")
    for k, label, colour, marker in (
        (3, "gate ±0.5 m about the target", style.PURPLE, "s"),
        (4, "from 0.5 m of range on", style.GREEN, "^"),
    ):
        right.errorbar(OPTICAL_DEPTHS, mean[:, k], yerr=error[:, k], label=label, color=colour, marker=marker)
    right.axhline(_single_backscatter(), color="0.5", ls="--", label="one scattering by 180°")
    right.set(title="Depolarisation of the backscatter", ylabel="cross- over co-polarised light", ylim=(0.0, 0.35))
    right.legend(loc="upper left")
    left.legend(loc="upper right")
    for axes in (left, right):
        axes.set_xlabel("one-way optical depth τ of the target")
        axes.xaxis.minorticks_on()
    return figure


def _single_backscatter() -> float:
    """(1 − m22)/(1 + m22) of the water's matrix at 180°."""
    m22 = spadwarp.water.voss_fry_matrix(np.array([-1.0]))[0, 1]
    return float((1.0 - m22) / (1.0 + m22))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photons", type=int, default=1_600_000, help="at each optical depth")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "images" / "polarised_light.png")
    parser.add_argument("--redraw", action="store_true", help="from the numbers of the last run")
    arguments = parser.parse_args()
    numbers = Path(__file__).with_suffix(".json")
    if not arguments.redraw:
        points = [measure(depth, photons=arguments.photons) for depth in OPTICAL_DEPTHS]
        kept = {name: np.stack(part) for name, part in zip(("mean", "error"), zip(*points, strict=True), strict=True)}
        rounded = {name: np.vectorize(lambda x: float(f"{x:.5g}"))(values).tolist() for name, values in kept.items()}
        rounded["attenuation"] = {
            f"{a}, {b}": attenuation(a, b, photons=4 * arguments.photons).round(4).tolist() for a, b in WATERS
        }
        numbers.write_text(json.dumps({"optical_depth": OPTICAL_DEPTHS, **rounded}) + "\n")
    read = json.loads(numbers.read_text())
    mean, error = np.array(read["mean"]), np.array(read["error"])
    print("depth  signal to backscatter: I, co, cross     cross/co: water about the target, all water")
    for depth, m, e in zip(OPTICAL_DEPTHS, mean, error, strict=True):
        print(f"{depth:5.2f}", *(f"{x:9.4g} ±{dx:8.2g}" for x, dx in zip(m, e, strict=True)))
    for water, both in read["attenuation"].items():
        print(f"a, b = {water} 1/m: co {both[0]:.4g} 1/m, cross {both[1]:.4g} 1/m, ratio {both[1] / both[0]:.3f}")
    style.save(draw(mean, error), arguments.out)


if __name__ == "__main__":
    main()
