"""Water cell by cell in the analytic model: what lines of sight and the beam lose in it, and what it scatters back."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene.camera import to_world
from spadwarp.scene.grid import GridCells
from spadwarp.scene.medium import grid_cells
from spadwarp.scene.scene import laser_port
from spadwarp.scene.sight import LinesOfSight, lines_of_sight

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["grid_backscatter", "passed_by_grid"]

Floats = NDArray[np.float64]

# Pieces of a line of sight, and lines of sight at a time.
_PIECES, _AT_ONCE = 400, 256


def passed_by_grid(scene: Scene, views: Floats, distances: Floats) -> Floats:
    """Part of the light that passes the cells on its way from the laser to points and on to the lens, over what passes
    the medium without cells; exact for the cells.

    Args:
        scene: The scene.
        views: Unit vectors `[P, 3]` in which the lens sees the points.
        distances: From the lens along the line of sight, which a port bends, `[P]` [m].
    """
    cells, c = grid_cells(scene.medium), scene.medium.extinction
    sights = lines_of_sight(scene, views)
    points = sights.points(distances)
    depth = np.zeros(len(points))
    for begin in (sights.start, _begin_of_light(scene, points)):
        way = np.isfinite(begin + points).all(axis=-1, keepdims=True)
        ends = (np.where(way, end, 0.0) for end in (begin, points))
        first, last = (to_world(scene.camera, end) for end in ends)
        depth += cells.optical_depths(first, last, c) - c * np.linalg.norm(last - first, axis=-1)
    return np.exp(-depth)


def _begin_of_light(scene: Scene, points: Floats) -> Floats:
    """Where the laser's light to points `[P, 3]` enters the water, or is emitted in it [m]; NaN where there is no
    way."""
    beam, port = scene.beam, laser_port(scene)
    laser, axis = np.array(beam.position), np.array(beam.axis)
    if beam.profile != "collimated":
        if port is None:
            return np.broadcast_to(laser, points.shape)
        return port.enter(laser, port.connect(points, laser)[0])[0]
    if port is None:
        return points - ((points - laser) @ axis)[:, None] * axis
    # Behind a flat port, see `_not_covered`, a parallel beam stays one.
    direction, normal = port.enter(laser, axis)[1], np.array(port.normal)
    outside = points @ normal - (port.distance + port.thickness)
    return points - (outside / (direction @ normal))[:, None] * direction


def grid_backscatter(
    scene: Scene,
    views: Floats,
    paths: NDArray[np.float32],
    cumulative: NDArray[np.float32],
    total: Floats,
    gate: tuple[float, float],
) -> NDArray[np.float32]:
    """Detections per pulse and bin of light scattered once, `[P, T]`.

    The beam's way to a point is taken to lose what the line of sight to it loses, by their lengths in the water, as it
    does for a laser beside the camera.

    Args:
        scene: The scene.
        views: Unit vectors in which the lens sees the pixels `[P, 3]`.
        paths, cumulative, total: Table of `single_scatter_table` with a scattering coefficient of 1 / m everywhere.
        gate: (start, stop) [s].
    """
    bins = max(1, round((gate[1] - gate[0]) / scene.gate.bin_width))
    edges = np.linspace(*gate, bins + 1) * scene.medium.pulse_speed
    cells, sights = grid_cells(scene.medium), lines_of_sight(scene, views)
    parts = [
        _part(scene, cells, sights[k : k + _AT_ONCE], paths[k : k + _AT_ONCE], cumulative[k : k + _AT_ONCE], edges)
        for k in range(0, len(views), _AT_ONCE)
    ]
    return (np.concatenate(parts) * total[:, None]).astype(np.float32)


def _part(
    scene: Scene,
    cells: GridCells,
    sights: LinesOfSight,
    paths: NDArray[np.float32],
    cumulative: NDArray[np.float32],
    edges: Floats,
) -> Floats:
    """The same for a total of 1, for some lines of sight and edges of bins in path [m]."""
    medium = scene.medium
    # Length in the water up to where the way by the laser has the longest path.
    reach = np.nan_to_num(sights.range_from_path(paths[:, -1].astype(np.float64)) - sights.lead)
    ends = reach[:, None] * np.linspace(0.0, 1.0, _PIECES + 1)
    middle = 0.5 * (ends[:, 1:] + ends[:, :-1])
    light, water, lengths = _light_on(sights, ends)
    points = sights.start[:, None, :] + middle[..., None] * sights.direction[:, None, :]
    at = np.nan_to_num(cells.in_cells(to_world(scene.camera, points)), nan=-1.0)
    index = np.floor(np.clip(at, -1.0, cells.extinction.shape)).astype(np.int32)
    inside = ((index >= 0) & (index < cells.extinction.shape)).all(axis=-1)
    place = tuple(np.moveaxis(np.clip(index, 0, np.array(cells.extinction.shape) - 1), -1, 0))
    extinction = np.where(inside, cells.extinction[place], medium.extinction)
    scattering = np.where(inside, cells.scattering[place], medium.scattering)
    excess = (extinction - medium.extinction) * np.diff(ends, axis=1)
    excess = np.cumsum(excess, axis=1) - 0.5 * excess
    weight = scattering * np.exp(-excess * (1.0 + water / np.maximum(middle, 1e-9)))
    if cells.anisotropy is not None:
        cosine = -(light * sights.direction[:, None, :]).sum(axis=-1)
        own = np.where(inside, cells.anisotropy[place], medium.anisotropy)
        weight *= _henyey_greenstein(cosine, own) / _henyey_greenstein(cosine, medium.anisotropy)
    weight = np.nan_to_num(weight)  # where no light comes
    result = np.zeros((len(paths), len(edges) - 1))
    for row in range(len(paths)):
        share = np.diff(np.interp(lengths[row], paths[row], cumulative[row]))
        middles = 0.5 * (lengths[row, 1:] + lengths[row, :-1])
        result[row] = np.histogram(middles, edges, weights=share * weight[row])[0]
    return result


def _light_on(sights: LinesOfSight, ends: Floats) -> tuple[Floats, Floats, Floats]:
    """The laser's light on pieces of lines of sight: unit directions and lengths of its way in the water at their
    middles, NaN where no light comes; the paths to the lens by their ends [m], there 0."""
    light, water, path = sights.light_at(sights.start[:, None, :] + ends[..., None] * sights.direction[:, None, :])
    between = light[:, 1:] + light[:, :-1]
    between = between / np.maximum(np.linalg.norm(between, axis=-1, keepdims=True), 1e-9)
    return between, 0.5 * (water[:, 1:] + water[:, :-1]), np.nan_to_num(path + ends + sights.delay[:, None])


def _henyey_greenstein(cosine: Floats, g: Floats | float) -> Floats:
    """The phase function without its factor 1/4π."""
    return (1.0 - np.square(g)) / (1.0 + np.square(g) - 2.0 * g * cosine) ** 1.5
