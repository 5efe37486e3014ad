"""Where multiple scattering makes the analytic model wrong: Monte Carlo over analytic, against optical depth.

python docs/figures/analytic_limits.py           # simulates, writes the numbers beside this file, draws
python docs/figures/analytic_limits.py --redraw  # from the numbers
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
OPTICAL_DEPTHS = (0.1, 0.2, 0.4, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
DISTANCE = 5.0  # of the target [m]
ALBEDO = 0.833  # Petzold's harbour
RUNS = 8  # independent, behind each error bar
METRE = 1e9 / 299_792_458.0  # time in which light goes a metre at index 1 [ns]

# What is compared, in the order of `ratios`.
BALLISTIC, TARGET, TARGET_SOON, BACKSCATTER, BACKSCATTER_GATED = range(5)
SOON = 0.1  # path [m] by which the target's light may be late: 5 cm of range
GATED = (9.0, 11.0)  # path [m]: half a metre of range before and behind the target


def scene(optical_depth: float, *, gate: tuple[float, float] = (1.0, 15.0)) -> spadwarp.Scene:
    """A grey wall at 5 m, lit by a cone that overfills the view; `gate` in metres of path."""
    width = 0.05  # of a bin [m]
    return spadwarp.Scene.from_dict(
        {
            "medium": {
                "extinction": optical_depth / DISTANCE,
                "albedo": ALBEDO,
                "anisotropy": 0.924,
                "group_index": 1.0,
                "phase_index": 1.0,
            },
            "laser": {"position": [-0.1, 0.0, 0.0], "half_angle_deg": 10.0},
            "camera": {"width": 16, "height": 16, "horizontal_fov_deg": 10.0, "aperture_diameter": 0.01},
            "gate": {
                "start_ns": gate[0] * METRE,
                "bin_width_ps": width * METRE * 1e3,
                "bins": round((gate[1] - gate[0]) / width),
            },
            "targets": [
                {"builtin": "plane", "size": [8.0, 8.0], "translation": [0.0, 0.0, DISTANCE], "reflectance": 0.5}
            ],
            "transport": {"max_collisions": 200, "axis_threshold": 1.0},
        }
    )


def monte_carlo(optical_depth: float, *, photons: int, seed: int) -> NDArray[np.float64]:
    """Detections per pulse, sums over the image `[5]`."""
    wet = scene(optical_depth)
    result = spadwarp.simulate(wet, photons=photons, seed=seed, device="cpu")
    ballistic, water = result.component("ballistic"), result.component("backscatter")
    target = ballistic + result.component("forward_scattered")
    path = result.path_edges[:-1] + 1e-6
    soon = path < result.true_path()[..., None] + SOON
    gated = (path > GATED[0]) & (path < GATED[1])
    sums = [ballistic.sum(), target.sum(), target[soon].sum(), water.sum(), water[..., gated].sum()]
    return np.array(sums) * wet.laser.photons_per_pulse * wet.detector.pde


def analytic(optical_depth: float) -> NDArray[np.float64]:
    """The same sums by the analytic model."""
    whole = spadwarp.simulate_analytic(scene(optical_depth), frames=0, device="cpu")
    gated = spadwarp.simulate_analytic(scene(optical_depth, gate=GATED), frames=0, device="cpu")
    signal = whole.signal.sum()
    return np.array([signal, signal, signal, whole.backscatter.sum(), gated.backscatter.sum()])


def ratios(optical_depth: float, *, photons: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Monte Carlo over analytic and its standard error, `[5]` each."""
    # Turbid water needs more: fewer photons reach the target.
    count = int(photons * max(optical_depth, 0.5) / 2.0) // RUNS
    first = RUNS * OPTICAL_DEPTHS.index(optical_depth)  # random numbers of its own for each depth
    batches = np.stack([monte_carlo(optical_depth, photons=count, seed=first + run) for run in range(RUNS)])
    batches /= analytic(optical_depth)
    return batches.mean(axis=0), batches.std(axis=0, ddof=1) / np.sqrt(RUNS)


@style.paper()
def draw(mean: NDArray[np.float64], error: NDArray[np.float64]) -> Any:
    """The figure from ratios and errors, `[optical depth, 5]`."""
    curves = (
        (
            "Target return",
            "Monte Carlo / signal S of eq 7",
            (
                (BALLISTIC, "ballistic", "black", "o"),
                (TARGET_SOON, "all that is less than 5 cm late", style.BLUE, "s"),
                (TARGET, "all", style.RED, "^"),
            ),
        ),
        (
            "Water backscatter",
            "Monte Carlo / single scattering",
            (
                (BACKSCATTER, "gate from 0.5 m to 7.5 m of range", style.GREEN, "o"),
                (BACKSCATTER_GATED, "gate ±0.5 m about the target", style.PURPLE, "s"),
            ),
        ),
    )
    figure = style.new_figure(style.PAGE, 3.3)
    for axes, (title, label, rows) in zip(figure.subplots(1, 2, sharey=True), curves, strict=True):
        axes.axhline(1.0, color="0.6", lw=0.8)
        if rows[0][0] == BALLISTIC:
            # What the target would return if light scattered once or more went on as if nothing had happened.
            depths = np.array((0.0, OPTICAL_DEPTHS[-1]))
            axes.plot(
                depths,
                np.exp(2.0 * ALBEDO * depths),
                color="0.5",
                ls="--",
                label="exp(2ωτ): no loss by scattering",
            )
        for k, name, colour, marker in rows:
            axes.errorbar(
                OPTICAL_DEPTHS,
                mean[:, k],
                yerr=error[:, k],
                label=name,
                color=colour,
                marker=marker,
            )
        axes.set(title=title, xlabel="one-way optical depth τ of the target", ylabel=label, yscale="log")
        axes.legend(loc="upper left")
        axes.xaxis.minorticks_on()
        style.plain_axis(axes)
    style.log_axis(figure.axes[0], "y")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photons", type=int, default=2_000_000, help="at an optical depth of 2")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "images" / "analytic_limits.png")
    parser.add_argument("--redraw", action="store_true", help="from the numbers of the last run")
    arguments = parser.parse_args()
    numbers = Path(__file__).with_suffix(".json")
    if not arguments.redraw:
        points = [ratios(depth, photons=arguments.photons) for depth in OPTICAL_DEPTHS]
        kept = {name: np.stack(part) for name, part in zip(("mean", "error"), zip(*points, strict=True), strict=True)}
        rounded = {name: [[float(f"{x:.5g}") for x in row] for row in values] for name, values in kept.items()}
        numbers.write_text(json.dumps({"optical_depth": OPTICAL_DEPTHS, **rounded}) + "\n")
    read = json.loads(numbers.read_text())
    mean, error = np.array(read["mean"]), np.array(read["error"])
    print("depth  ballistic         target, on time   target            backscatter       gated")
    for depth, m, e in zip(OPTICAL_DEPTHS, mean, error, strict=True):
        columns = (BALLISTIC, TARGET_SOON, TARGET, BACKSCATTER, BACKSCATTER_GATED)
        print(f"{depth:5.1f}  " + "  ".join(f"{m[k]:8.4f} ±{e[k]:7.4f}" for k in columns))
    style.save(draw(mean, error), arguments.out)


if __name__ == "__main__":
    main()
