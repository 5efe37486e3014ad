"""A plume of sediment, from counts of one view: blocks of its cells by Gauss-Newton, with derivatives by block.

python docs/figures/plume.py
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

import spadwarp
from spadwarp.scene import Scene
from spadwarp.scene.medium import grid_cells
from spadwarp.viz import style

Floats = NDArray[np.float64]

SIZE = (1.2, 0.9, 0.9)  # edges of the box: across, down, along the view [m]
BLOCKS = (12, 9, 9)
CLEAR = 0.15  # extinction of the water around the plume [1/m]
STEP = 1.5  # how much neighbouring blocks may differ, as a standard deviation [1/m]
DETECTIONS = 4e5  # of the exposure, all pixels together
STEPS, LARGEST = 5, 3.0  # of Gauss-Newton, and what a block may change by in one [1/m]


def view(grid: dict[str, object]) -> Scene:
    """A flash lights the whole view; a gate from before to behind the box; nothing but water."""
    return Scene.from_dict(
        {
            "medium": {
                "extinction": CLEAR,
                "albedo": 0.8,
                "anisotropy": 0.85,
                "grid": {"translation": [0.0, 0.0, 1.6], "tracking": "regular", **grid},
            },
            "laser": {"position": [-0.08, 0.0, 0.0], "half_angle_deg": 30.0, "pulse_energy": 2e-10},
            "camera": {"width": 16, "height": 12, "horizontal_fov_deg": 50.0, "aperture_diameter": 0.03},
            "gate": {"start_ns": 10.0, "bin_width_ps": 500.0, "bins": 20},
            "targets": [],
            "transport": {"estimator": "guided", "max_collisions": 60},
        }
    )


def plume() -> Scene:
    """What is to be found: 48 x 36 x 36 cells of a turbulent plume."""
    shape = {"shape": "plume", "size": SIZE, "cells": [48, 36, 36], "extinction": 12.0, "albedo": 0.8}
    return view({**shape, "anisotropy": 0.85, "turbulence": 0.5, "eddy_size": 0.4, "seed": 2})


def in_blocks(cells: Floats) -> Floats:
    """Means of the cells of each block."""
    shape = [n for count, along in zip(BLOCKS, cells.shape, strict=True) for n in (count, along // count)]
    return cells.reshape(shape).mean(axis=(1, 3, 5))


def of_blocks(extinction: Floats, folder: Path) -> Scene:
    """The view with one cell for each block."""
    np.savez(folder / "blocks.npz", extinction=extinction, albedo=np.full(BLOCKS, 0.8), size=SIZE)
    return view({"file": str(folder / "blocks.npz")})


def differences() -> Floats:
    """Of all neighbouring blocks, and of the outermost ones from clear water: one row each."""
    rows = []
    for axis, count in enumerate(BLOCKS):
        along = np.eye(count + 1, count) - np.eye(count + 1, count, k=-1)
        x, y, z = (along if k == axis else np.eye(n) for k, n in enumerate(BLOCKS))
        rows.append(np.kron(np.kron(x, y), z))
    return np.vstack(rows)


def gauss_newton(scene: Scene, extinction: Floats, counts: Floats, pulses: float, **run: Any) -> tuple[Floats, Floats]:
    """A step from blocks of an extinction, none below that of the clear water, and the standard error there [1/m]."""
    result = spadwarp.simulate(scene, derivatives=["medium.grid.extinction"], blocks=BLOCKS, **run)
    scale = pulses * scene.laser.photons_per_pulse * scene.detections_per_photon
    expected, noise = scale * result.histogram.ravel(), scale * result.standard_error.ravel()
    slopes = scale * result.derivatives["medium.grid.extinction"].sum(axis=3).reshape(extinction.size, -1).T
    weight = 1.0 / np.sqrt(np.maximum(expected, 1.0) + noise**2)  # of the counts and of the simulation
    smooth, given = differences() / STEP, extinction.ravel()
    rows = np.vstack([weight[:, None] * slopes, smooth])
    misfit = np.concatenate([weight * (counts.ravel() - expected), smooth @ (CLEAR - given)])
    lower = np.maximum(CLEAR - given, -LARGEST) - 1e-9
    change = lsq_linear(rows, misfit, (lower, np.full(given.size, LARGEST))).x.reshape(BLOCKS)
    print(
        f"chi2 {np.mean(misfit[: weight.size] ** 2):.3g} a bin, largest change {np.abs(change).max():.2g} 1/m",
        flush=True,
    )
    return change, np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))).reshape(BLOCKS)


def invert(counts: Floats, pulses: float, photons: int, device: str | None) -> tuple[Floats, Floats]:
    """Extinction of the blocks and its standard error [1/m], starting from clear water."""
    extinction = np.full(BLOCKS, CLEAR)
    with tempfile.TemporaryDirectory() as folder:
        for step in range(STEPS):
            run = {"photons": photons, "seed": 100 + step, "device": device}
            change, error = gauss_newton(of_blocks(extinction, Path(folder)), extinction, counts, pulses, **run)
            extinction = extinction + change
    return extinction, error


def compare(true: Floats, found: Floats, error: Floats) -> str:
    """In numbers."""
    off = found - true
    return (
        f"blocks: {np.sqrt(np.mean((true - CLEAR) ** 2)):.2f} 1/m above clear water, r.m.s.; found to "
        f"{np.sqrt(np.mean(off**2)):.2f} 1/m, {np.sqrt(np.mean((off / error) ** 2)):.2f} standard errors, r.m.s.; "
        f"correlation {np.corrcoef(found.ravel(), true.ravel())[0, 1]:.3f}"
    )


def expose(scene: Scene, photons: int, device: str | None) -> tuple[Floats, float]:
    """Counts of an exposure, and its pulses."""
    detections = spadwarp.simulate(scene, photons=photons, seed=1, device=device).detections
    pulses = DETECTIONS / float(detections.sum())
    print(f"{pulses:.3g} pulses; brightest pixel {detections.sum(axis=-1).max():.2g} detections a pulse")
    return np.random.default_rng(1).poisson(pulses * detections).astype(np.float64), pulses


def _maps(figure: Figure, axes: list[Any], cubes: tuple[Floats, Floats], axis: int) -> None:
    """Means of true and found blocks along an axis of the box."""
    (x, y, z), middle = (0.5 * np.array(SIZE), 1.6)
    limits = (-x, x, y, -y) if axis == 2 else (-x, x, middle - z, middle + z)
    top = max(float(cube.mean(axis=axis).max()) for cube in cubes)
    for panel, cube, name in zip(axes, cubes, ("true", "found"), strict=True):
        values = cube.mean(axis=axis).T
        choices = {"origin": "upper" if axis == 2 else "lower", "extent": limits}
        image = panel.imshow(values, cmap="magma_r", vmin=0.0, vmax=top, **choices)
        panel.set_title(f"{'from the camera' if axis == 2 else 'from above'}: {name}")
        panel.set_xticks([-0.5, 0.0, 0.5])
        panel.set_xlabel("x [m]")
        panel.set_ylabel("y [m]" if axis == 2 else "z [m]")
    figure.colorbar(image, ax=axes, label="extinction [1/m]")


@style.paper()
def draw(path: Path, photons: int, device: str | None) -> None:
    """Writes the figure."""
    scene = plume()
    true = in_blocks(np.asarray(grid_cells(scene.medium).extinction, np.float64))
    counts, pulses = expose(scene, 8 * photons, device)
    found, error = invert(counts, pulses, photons, device)
    print(compare(true, found, error))
    figure = style.new_figure(style.PAGE, 4.2)
    panels = figure.subplots(2, 3, width_ratios=(1.15, 1.0, 1.0))
    image = panels[0, 0].imshow(counts.sum(axis=-1), cmap=style.INTENSITY_MAP, vmin=0.0)
    figure.colorbar(image, ax=panels[0, 0], label="counts")
    panels[0, 0].set_title("the camera's image")
    panels[0, 0].set_xticks([])
    panels[0, 0].set_yticks([])
    behind = np.broadcast_to(np.arange(BLOCKS[2]) >= BLOCKS[2] // 2, BLOCKS)
    for part, colour, label in ((~behind, style.BLUE, "front half"), (behind, style.ORANGE, "rear half")):
        panels[1, 0].errorbar(
            true[part], found[part], error[part], fmt="o", ms=1.5, lw=0.3, capsize=0, color=colour, label=label
        )
    panels[1, 0].plot([CLEAR, true.max()], [CLEAR, true.max()], color="black", lw=0.8, zorder=3)
    panels[1, 0].set(xscale="log", yscale="log", xlim=(0.1, 15.0), ylim=(0.1, 15.0))
    panels[1, 0].set_xlabel("true [1/m]")
    panels[1, 0].set_ylabel("found [1/m]")
    panels[1, 0].set_title("extinction of each block")
    panels[1, 0].legend()
    _maps(figure, list(panels[0, 1:]), (true, found), 2)
    _maps(figure, list(panels[1, 1:]), (true, found), 1)
    style.save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "images" / "plume.png")
    parser.add_argument("--photons", type=int, default=400_000, help="of a step")
    parser.add_argument("--device")
    options = parser.parse_args()
    draw(options.out, options.photons, options.device)


if __name__ == "__main__":
    main()
