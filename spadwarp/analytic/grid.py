"""Water cell by cell in the analytic model: what lines of sight and the beam lose in it, and what it scatters back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene.grid_cells import GridCells, grid_cells
from spadwarp.scene.pose import to_world

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["grid_backscatter", "passed_by_grid"]

Floats = NDArray[np.float64]

# Pieces of a line of sight, and lines of sight at a time.
_PIECES, _AT_ONCE = 400, 256


def passed_by_grid(scene: Scene, points: Floats) -> Floats:
    """Part of the light that passes the cells on its way from the laser to points `[P, 3]` of the camera frame [m] and
    on to the lens, over what passes the medium without cells; exact for the cells."""
    cells, c = grid_cells(scene.medium), scene.medium.extinction
    at = to_world(scene.camera, points)
    depth = np.zeros(len(points))
    for end in ((0.0, 0.0, 0.0), scene.beam.position):
        depth += cells.optical_depths(to_world(scene.camera, end), at, c)
        depth -= c * np.linalg.norm(points - np.array(end), axis=1)
    return np.exp(-depth)


def grid_backscatter(
    scene: Scene,
    views: Floats,
    paths: NDArray[np.float32],
    cumulative: NDArray[np.float32],
    total: Floats,
    gate: tuple[float, float],
) -> NDArray[np.float32]:
    """Detections per pulse and bin of light scattered once, `[P, T]`.

    The beam's way to a point is taken to lose what the line of sight to it loses, by their lengths, as it does for a
    laser beside the camera.

    Args:
        scene: The scene, without ports.
        views: Unit vectors of the lines of sight `[P, 3]`.
        paths, cumulative, total: Table of `single_scatter_table` with a scattering coefficient of 1 / m everywhere.
        gate: (start, stop) [s].
    """
    bins = max(1, round((gate[1] - gate[0]) / scene.gate.bin_width))
    edges = np.linspace(*gate, bins + 1) * scene.medium.pulse_speed
    cells = grid_cells(scene.medium)
    parts = [
        _part(scene, cells, views[k : k + _AT_ONCE], paths[k : k + _AT_ONCE], cumulative[k : k + _AT_ONCE], edges)
        for k in range(0, len(views), _AT_ONCE)
    ]
    return (np.concatenate(parts) * total[:, None]).astype(np.float32)


def _part(
    scene: Scene,
    cells: GridCells,
    views: Floats,
    paths: NDArray[np.float32],
    cumulative: NDArray[np.float32],
    edges: Floats,
) -> Floats:
    """The same for a total of 1, for some lines of sight and edges of bins in path [m]."""
    medium, laser = scene.medium, np.array(scene.beam.position)
    along = views @ laser
    longest = paths[:, -1].astype(np.float64)
    # Where the way by the laser has the longest path.
    reach = (longest**2 - laser @ laser) / (2.0 * np.maximum(longest - along, 1e-9))
    ends = reach[:, None] * np.linspace(0.0, 1.0, _PIECES + 1)
    middle = 0.5 * (ends[:, 1:] + ends[:, :-1])
    points = middle[..., None] * views[:, None, :]
    from_laser = np.linalg.norm(points - laser, axis=-1)
    at = cells.in_cells(to_world(scene.camera, points))
    index = np.floor(at).astype(np.int32)
    inside = ((index >= 0) & (index < cells.extinction.shape)).all(axis=-1)
    place = tuple(np.moveaxis(np.clip(index, 0, np.array(cells.extinction.shape) - 1), -1, 0))
    extinction = np.where(inside, cells.extinction[place], medium.extinction)
    scattering = np.where(inside, cells.scattering[place], medium.scattering)
    excess = (extinction - medium.extinction) * np.diff(ends, axis=1)
    excess = np.cumsum(excess, axis=1) - 0.5 * excess
    weight = scattering * np.exp(-excess * (1.0 + from_laser / np.maximum(middle, 1e-9)))
    if cells.anisotropy is not None:
        cosine = -((points - laser) * views[:, None, :]).sum(axis=-1) / np.maximum(from_laser, 1e-9)
        own = np.where(inside, cells.anisotropy[place], medium.anisotropy)
        weight *= _henyey_greenstein(cosine, own) / _henyey_greenstein(cosine, medium.anisotropy)
    result = np.zeros((len(views), len(edges) - 1))
    lengths = ends + np.linalg.norm(ends[..., None] * views[:, None, :] - laser, axis=-1)
    for row in range(len(views)):
        share = np.diff(np.interp(lengths[row], paths[row], cumulative[row]))
        middles = 0.5 * (lengths[row, 1:] + lengths[row, :-1])
        result[row] = np.histogram(middles, edges, weights=share * weight[row])[0]
    return result


def _henyey_greenstein(cosine: Floats, g: Floats | float) -> Floats:
    """The phase function without its factor 1/4π."""
    return (1.0 - np.square(g)) / (1.0 + np.square(g) - 2.0 * g * cosine) ** 1.5
