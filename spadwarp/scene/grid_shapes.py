"""Suspended matter without a file: its density in a box, in closed form, times turbulence of a seed.

In the box's own coordinates x, y and z run from -1 to 1; y points down, as in the world.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from spadwarp.scene.grid import Grid

__all__ = ["SHAPES", "shape_density", "turbulent_field"]

Floats = NDArray[np.float64]


def cloud(x: Floats, y: Floats, z: Floats) -> Floats:
    """A Gaussian in all directions, of a standard deviation of a third of half the edge; 1 in the middle."""
    return np.exp(-4.5 * (x**2 + y**2 + z**2))


def plume(x: Floats, y: Floats, z: Floats) -> Floats:
    """A Gaussian across, from the middle of the bottom upwards, four times as wide at the top; 1 where it begins."""
    width = 0.1 + 0.15 * (1.0 - y)
    return (0.1 / width) ** 2 * np.exp(-0.5 * (x**2 + z**2) / width**2)


def sediment(x: Floats, y: Floats, z: Floats) -> Floats:
    """Matter stirred up from the bottom: it falls to 1/e in a fifth of the height, and towards the sides."""
    return np.exp(-5.0 * 0.5 * (1.0 - y)) * np.cos(0.5 * np.pi * x) ** 2 * np.cos(0.5 * np.pi * z) ** 2


def gradient(x: Floats, y: Floats, z: Floats) -> Floats:
    """From 0 at the top to 1 at the bottom."""
    return 0.5 * (1.0 + y) + 0.0 * (x + z)


SHAPES: dict[str, Callable[[Floats, Floats, Floats], Floats]] = {
    "cloud": cloud,
    "plume": plume,
    "sediment": sediment,
    "gradient": gradient,
}
"""Densities by the name of `medium.grid.shape`."""


def shape_density(grid: Grid) -> Floats:
    """Density of each cell at its middle, `[x, y, z]`, of a grid with a shape."""
    counts, edges = grid.cell_counts, grid.edges
    assert grid.shape is not None and edges is not None  # see Grid
    axes = [(2.0 * np.arange(count) + 1.0) / count - 1.0 for count in counts]
    density = SHAPES[grid.shape](axes[0][:, None, None], axes[1][:, None], axes[2])
    if grid.turbulence > 0.0:
        eddy = grid.eddy_size or min(edges) / 3.0
        field = turbulent_field(counts, edges, eddy, grid.seed, grid.frame)
        density = density * np.exp(grid.turbulence * field - 0.5 * grid.turbulence**2)
    return density


def turbulent_field(
    counts: tuple[int, int, int], edges: tuple[float, float, float], eddy_size: float, seed: int, time: float = 0.0
) -> Floats:
    """A Gaussian random field of mean 0 and variance 1 with von Kármán's spectrum, (k² + k0²)^(-11/6), k0 = 2π over
    eddy_size.

    Args:
        counts: Cells along the edges.
        edges: Of the box [m].
        eddy_size: Of the largest eddies [m].
        seed: Same seed, same field.
        time: In turnovers of the largest eddies; a mode changes at the rate of its own, as k^(2/3).
    """
    rng = np.random.default_rng(seed)
    waves = [2.0 * np.pi * np.fft.fftfreq(n, edge / n) for n, edge in zip(counts, edges, strict=True)]
    waves[2] = np.abs(waves[2][: counts[2] // 2 + 1])
    k2 = waves[0][:, None, None] ** 2 + waves[1][:, None] ** 2 + waves[2] ** 2
    k0 = 2.0 * np.pi / eddy_size
    amplitude = (k2 + k0**2) ** (-11.0 / 12.0)
    amplitude[0, 0, 0] = 0.0
    # The second field before the first: at time 0 the field is that of the first, whatever comes with time.
    first, second = (np.fft.rfftn(rng.standard_normal(counts)) for _ in range(2))
    turn = time * ((k2 + k0**2) / k0**2) ** (1.0 / 3.0)
    field = np.fft.irfftn(amplitude * (np.cos(turn) * first + np.sin(turn) * second), s=counts, axes=(0, 1, 2))
    spread = field.std()
    return field / spread if spread > 0.0 else field
