"""The water of a grid cell by cell, and what light loses on straight lines through it."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ConfigError, FileError
from spadwarp.scene.grid import Grid
from spadwarp.scene.grid_files import GridFile, read_grid
from spadwarp.scene.grid_shapes import shape_density
from spadwarp.scene.pose import rotation_matrix

if TYPE_CHECKING:
    from spadwarp.scene.medium import Medium

__all__ = ["GridCells", "grid_cells"]

# Values of a table of crossings that `optical_depths` holds at a time.
_CROSSINGS = 1 << 21


@dataclass(frozen=True, eq=False)
class GridCells:
    """Cells of water in a box.

    Attributes:
        extinction: c [1/m], `[x, y, z]` along the box's own axes.
        albedo: b/c.
        anisotropy: g; None: the medium's everywhere.
        size: Edges of the box [m].
        centre: Its middle in the world [m].
        rotation: Its own axes in the world, as columns.
    """

    extinction: NDArray[np.float32]
    albedo: NDArray[np.float32]
    anisotropy: NDArray[np.float32] | None
    size: tuple[float, float, float]
    centre: tuple[float, float, float]
    rotation: NDArray[np.float64]

    @property
    def scattering(self) -> NDArray[np.float32]:
        """b [1/m] of each cell."""
        return self.extinction * self.albedo

    def in_cells(self, points: ArrayLike) -> NDArray[np.float64]:
        """Points of the world `[..., 3]` [m] in cells: the box has 0 ... shape there."""
        shape = np.array(self.extinction.shape)
        own = (np.asarray(points, np.float64) - self.centre) @ self.rotation
        return (own / self.size + 0.5) * shape

    def _index(self, at: NDArray[np.float64]) -> NDArray[np.int32]:
        """Indices of the cells; outside the box such as no cell has."""
        return np.clip(np.floor(at), -1, self.extinction.shape).astype(np.int32)

    def at(self, points: ArrayLike, outside: float) -> NDArray[np.float64]:
        """Extinction [1/m] at points of the world `[..., 3]`, with that outside the box."""
        index = self._index(self.in_cells(points))
        inside = ((index >= 0) & (index < self.extinction.shape)).all(axis=-1)
        clipped = np.clip(index, 0, np.array(self.extinction.shape) - 1)
        return np.where(inside, self.extinction[tuple(np.moveaxis(clipped, -1, 0))], outside)

    def optical_depths(self, begin: ArrayLike, end: ArrayLike, outside: float) -> NDArray[np.float64]:
        """∫c ds along straight lines between points of the world `[..., 3]`, exact for the cells.

        A line is cut where it crosses the planes between cells, and the cell of each piece is that of its middle.
        """
        first, last = np.broadcast_arrays(np.asarray(begin, np.float64), np.asarray(end, np.float64))
        shape = first.shape[:-1]
        first, last = first.reshape(-1, 3), last.reshape(-1, 3)
        at_once = max(1, _CROSSINGS // (sum(self.extinction.shape) + 5))
        parts = [
            self._depths(first[k : k + at_once], last[k : k + at_once], outside) for k in range(0, len(first), at_once)
        ]
        return np.concatenate([np.zeros(0), *parts]).reshape(shape)

    def _depths(self, begin: NDArray[np.float64], end: NDArray[np.float64], outside: float) -> NDArray[np.float64]:
        first, along = self.in_cells(begin), self.in_cells(end) - self.in_cells(begin)
        cuts = [np.zeros((len(begin), 1)), np.ones((len(begin), 1))]
        for axis, count in enumerate(self.extinction.shape):
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing = (np.arange(count + 1) - first[:, axis, None]) / along[:, axis, None]
            cuts.append(np.clip(np.nan_to_num(crossing, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0))
        t = np.sort(np.concatenate(cuts, axis=1), axis=1)
        middle = first[:, None, :] + 0.5 * (t[:, 1:] + t[:, :-1])[..., None] * along[:, None, :]
        index = self._index(middle)
        inside = ((index >= 0) & (index < self.extinction.shape)).all(axis=-1)
        clipped = np.clip(index, 0, np.array(self.extinction.shape) - 1)
        extinction = np.where(inside, self.extinction[tuple(np.moveaxis(clipped, -1, 0))], outside)
        return (extinction * np.diff(t, axis=1)).sum(axis=1) * np.linalg.norm(end - begin, axis=1)


def grid_cells(medium: Medium) -> GridCells:
    """The cells of a medium with a grid.

    Raises:
        FileError: The file cannot be read, or has no cells.
        ConfigError: `medium.grid` does not say how large the box is, or its frame is not in the file.
    """
    grid = medium.grid
    assert grid is not None and not isinstance(medium.albedo, str)  # see Medium
    stamp: tuple[int, int] | None = None
    if grid.file is not None:
        try:
            status = Path(grid.file).stat()
            stamp = status.st_mtime_ns, status.st_size
        except OSError:
            stamp = None  # the reader says why
    has_table = medium.has_phase_table
    return _cells(grid, medium.extinction, medium.albedo, medium.anisotropy, has_table, stamp)


@functools.lru_cache(maxsize=4)
def _cells(
    grid: Grid, extinction: float, albedo: float, anisotropy: float, has_table: bool, stamp: tuple[int, int] | None
) -> GridCells:
    edges, origin = grid.edges, None
    arrays: Arrays
    if grid.file is None:
        density = shape_density(grid)
        arrays = _added(grid, density, extinction, albedo, anisotropy)
    else:
        file = _read(grid.file, stamp)
        edges, origin = edges or file.size, file.origin
        if edges is None:
            raise ConfigError(f"medium.grid: needs size; {grid.file} has no size and no cell_size")
        found = {name: _frame(grid, values) for name, values in file.arrays.items()}
        if "anisotropy" in found and has_table:
            raise ConfigError(
                f"medium.grid.file = {grid.file!r} has an anisotropy, which goes with phase_function = "
                "'henyey_greenstein' only; cells share any other"
            )
        if "density" in found:
            arrays = _added(grid, found["density"], extinction, albedo, anisotropy, found.get("anisotropy"))
        else:
            arrays = (*_coefficients(found), found.get("anisotropy"))
    size = np.array(edges) * grid.scale
    rotation = rotation_matrix(grid.rotation_deg)
    own = np.zeros(3) if origin is None else (np.array(origin) + 0.5 * np.array(edges)) * grid.scale
    centre = rotation @ own + grid.translation
    c, omega = (np.ascontiguousarray(values, np.float32) for values in arrays[:2])
    g = None if arrays[2] is None else np.ascontiguousarray(arrays[2], np.float32)
    return GridCells(c, omega, g, tuple(size.tolist()), tuple(centre.tolist()), rotation)


@functools.lru_cache(maxsize=2)
def _read(path: str, stamp: tuple[int, int] | None) -> GridFile:
    try:
        return read_grid(path)
    except FileError as error:
        raise FileError(f"medium.grid.file: {error}") from None


def _frame(grid: Grid, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The cells at `grid.frame`, between two frames the mean of both by their distance."""
    last = len(values) - 1
    if grid.frame > last:
        raise ConfigError(f"medium.grid.frame = {grid.frame:g} is outside [0, {last}], the frames of {grid.file}")
    low = min(int(grid.frame), max(last - 1, 0))
    part = np.float32(grid.frame - low)
    return values[low] if part == 0.0 else (1 - part) * values[low] + part * values[low + 1]


Arrays = tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating] | None]


def _added(
    grid: Grid,
    density: NDArray[np.floating],
    extinction: float,
    albedo: float,
    anisotropy: float,
    own_anisotropy: NDArray[np.floating] | None = None,
) -> Arrays:
    """The medium with suspended matter: coefficients add up, the mean cosine is that of both scatterings together."""
    added = grid.extinction * density
    c = extinction + added
    b = extinction * albedo + grid.albedo * added
    g = grid.anisotropy if own_anisotropy is None else own_anisotropy
    mean: NDArray[np.floating] | None = None
    if g is not None:
        both = (extinction * albedo * anisotropy + grid.albedo * added * g) / np.maximum(b, 1e-30)
        mean = np.where(b > 0.0, both, anisotropy)
    return c, np.clip(b / np.maximum(c, 1e-30), 0.0, 1.0), mean


def _coefficients(found: dict[str, NDArray[np.float32]]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Extinction and albedo from two of the four coefficients."""
    values: list[NDArray[Any] | None] = [
        found.get(name) for name in ("absorption", "scattering", "extinction", "albedo")
    ]
    a, b, c, omega = values
    if c is None:
        if a is not None and b is not None:
            c = a + b
        elif omega is not None and b is not None:
            c = b / np.maximum(omega, np.float32(1e-30)) * (omega > 0.0)
        elif omega is not None and a is not None:
            c = a / np.maximum(1.0 - omega, np.float32(1e-30)) * (omega < 1.0)
    assert c is not None  # two of the four are there
    if omega is None:
        scattered = b if b is not None else np.maximum(c - (a if a is not None else 0.0), 0.0)
        omega = np.clip(scattered / np.maximum(c, np.float32(1e-30)), 0.0, 1.0)
    return c, omega
