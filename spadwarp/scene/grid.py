"""Water that varies from place to place, in a box: the table `medium.grid`, its files and shapes, and its cells."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from spadwarp.arrays import Floats
from spadwarp.io.arrays import read_npz
from spadwarp.io.hdf5 import read_hdf5
from spadwarp.io.paths import existing_file
from spadwarp.scene.pose import rotation_matrix, vector_of
from spadwarp.scene.sections import Counts, File, Scale, Section, Size, Vector, Whole, field, field_range, file_of
from spadwarp.values import ConfigError, FileError, Interval, SpadwarpError

COEFFICIENTS = ("absorption", "scattering", "extinction", "albedo")
"""Of water; two of them determine all."""

Cells = NDArray[np.floating]

GRID_ENDINGS = (".npz", ".h5", ".hdf5", ".nvdb")
LARGEST_CELL_COUNT = 1 << 27

# Values of a table of crossings that `optical_depths` holds at a time.
_CROSSINGS = 1 << 21


_OF_SHAPES = ("cells", "turbulence", "eddy_size", "seed")


class Grid(Section):
    """Cells of water in a box, from a file or a shape; outside the box the medium.

    A shape, or a file with `density`, adds suspended matter to the medium: `extinction` and `albedo` are those of
    density 1. A file with coefficients gives the water itself.
    """

    displaces: ClassVar = {"file": ("shape", *_OF_SHAPES), "shape": ("file",)}
    file: File = field(None, "path of a .npz, .h5 or .nvdb file with cells, relative to the scene file")
    shape: Literal["cloud", "plume", "sediment", "gradient"] | None = None
    """in place of a file: a round cloud, a plume that rises, matter stirred up from the bottom, a rise from top to
    bottom; the box's y points down"""
    size: Size | None = field(None, "edges of the box, one or three; default: those of the file [m]")
    cells: Counts = field((64,), "shape: number of cells along the edges; one number: along the longest")
    extinction: float = field(1.0, "what density 1 adds to the medium's extinction [1/m]", "[0, 1e6]")
    albedo: float = field(0.8, "single-scattering albedo of what is added", "[0, 1]")
    anisotropy: float | None = field(None, "henyey_greenstein: g of what is added; default: the medium's", "(-1, 1)")
    constituent: str | None = None
    """the medium's constituent of which density is so much more than the medium has"""
    turbulence: float = Field(0.0, ge=0, le=3)
    """shape: standard deviation of the logarithm of the density about the shape, by eddies of von Kármán's spectrum"""
    eddy_size: float | None = Field(None, ge=1e-6, le=1e9)
    """shape: the largest; default: a third of the shortest edge [m]"""
    seed: Whole = field(0, "shape: of the turbulence", "[0, 9223372036854775807]")
    frame: float = Field(0.0, ge=0, le=1e9)
    """time, for what moves: in a file's frames, between which cells are interpolated; in turnovers of a shape's largest
    eddies"""
    scale: Scale = field((1.0, 1.0, 1.0), "factor on the size, one or three")
    rotation_deg: Vector = field((0.0, 0.0, 0.0), "rotations about the box's own x, then its new y, then its new z [°]")
    translation: Vector = field((0.0, 0.0, 0.0), "shift in the world [m], the camera's frame if it has no pose")
    tracking: Literal["auto", "regular", "delta"] = "auto"
    """how photons fly through cells: "regular" from cell to cell, exact; "delta" by chance and without bias, faster
    where cells are many; "auto": the latter for more than 32 768 cells"""

    def _problems(self) -> Iterator[str]:
        if (self.file is None) == (self.shape is None):
            yield "needs either file or shape"
        if self.file is not None and Path(self.file).suffix.lower() not in GRID_ENDINGS:
            is_vdb = self.file.lower().endswith(".vdb")
            hint = "; `nanovdb_convert` of OpenVDB makes a .nvdb file of it" if is_vdb else ""
            yield self._that("file", f"does not end in {', '.join(GRID_ENDINGS)}{hint}")
        if self.constituent is not None:
            for name in ("extinction", "albedo", "anisotropy"):
                yield from self._only_with("suspended matter that is no constituent", False, name)
        if self.shape is not None and self.size is None:
            yield f"needs size with shape = {self.shape!r}"
        for name in ("size", "cells"):
            if len(getattr(self, name) or ()) == 2:
                yield self._that(name, "has two numbers; one or three are needed")
        if min(self.scale) <= 0.0:
            yield self._that("scale", "is not positive")
        yield from self._only_with("shape", self.shape is not None, *_OF_SHAPES)

    @property
    def edges(self) -> tuple[float, float, float] | None:
        """`size` as three numbers [m]."""
        return None if self.size is None else vector_of(np.broadcast_to(self.size, 3))

    @property
    def cell_counts(self) -> tuple[int, int, int]:
        """`cells` as three numbers: with one, cells are about as long as wide."""
        edges = self.edges or (1.0, 1.0, 1.0)
        even = (max(1, round(self.cells[0] * edge / max(edges))) for edge in edges)
        x, y, z = self.cells if len(self.cells) == 3 else even
        return x, y, z

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal table again."""
        hidden = () if self.file is None else _OF_SHAPES
        return {name: value for name, value in super().to_dict().items() if name not in hidden}


# Shapes


def shape_density(grid: Grid) -> Floats:
    """Density of each cell at its middle, `[x, y, z]`, of a grid with a shape."""
    counts, edges = grid.cell_counts, grid.edges
    assert edges is not None  # see Grid
    # The box's own coordinates run from -1 to 1; y points down, as in the world.
    x, y, z = np.meshgrid(*((2.0 * np.arange(n) + 1.0) / n - 1.0 for n in counts), indexing="ij", sparse=True)
    if grid.shape == "cloud":  # a Gaussian in all directions, of a standard deviation of a third of half the edge
        density = np.exp(-4.5 * (x**2 + y**2 + z**2))
    elif grid.shape == "plume":  # a Gaussian across, from the middle of the bottom upwards, at the top 4 times as wide
        width = 0.1 + 0.15 * (1.0 - y)
        density = (0.1 / width) ** 2 * np.exp(-0.5 * (x**2 + z**2) / width**2)
    elif grid.shape == "sediment":  # from the bottom it falls to 1/e in a fifth of the height, and towards the sides
        density = np.exp(-5.0 * 0.5 * (1.0 - y)) * np.cos(0.5 * np.pi * x) ** 2 * np.cos(0.5 * np.pi * z) ** 2
    else:
        density = 0.5 * (1.0 + y) + 0.0 * (x + z)  # from 0 at the top to 1 at the bottom
    if grid.turbulence > 0.0:
        eddies = turbulent_field(counts, edges, grid.eddy_size or min(edges) / 3.0, grid.seed, grid.frame)
        density = density * np.exp(grid.turbulence * eddies - 0.5 * grid.turbulence**2)
    return density


def turbulent_field(
    counts: tuple[int, int, int], edges: tuple[float, float, float], eddy_size: float, seed: int, time: float = 0.0
) -> Floats:
    """A Gaussian random field of mean 0 and variance 1 with von Kármán's spectrum, (k² + k0²)^(-11/6), k0 = 2π over
    `eddy_size` [m], in cells along the edges of a box [m]. `time` is in turnovers of the largest eddies; a mode changes
    at the rate of its own, as k^(2/3).
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


# Files: NumPy archives, HDF5, NanoVDB

_MATTER = field_range(Grid, "extinction")
GRID_ARRAYS = {
    "density": Interval.read("[0, 1e9]"),
    "extinction": _MATTER,
    "absorption": _MATTER,
    "scattering": _MATTER,
    "albedo": field_range(Grid, "albedo"),
    "anisotropy": field_range(Grid, "anisotropy"),
}
"""Arrays of a file `[x, y, z]`, or of several frames `[frame, x, y, z]`, and their ranges."""
_PLACES = {"size": "(0, inf)", "cell_size": "(0, inf)", "origin": "(-inf, inf)"}


class GridFile(NamedTuple):
    """Cells of a file: arrays by the names of `GRID_ARRAYS`, `[frame, x, y, z]` float32; edges of the box [m], None if
    the scene has to say; its lower corner in the file's own frame [m], None if it stands about its middle."""

    arrays: Mapping[str, NDArray[np.float32]]
    size: Vector | None = None
    origin: Vector | None = None


def read_grid(path: str | Path) -> GridFile:
    """The cells of a file: `density`, or two of extinction, absorption, scattering and albedo; and `anisotropy`.

    `.npz` and `.h5`: arrays by these names, `[x, y, z]` or `[frame, x, y, z]`, and `size` (3 edges) or `cell_size` (one
    or 3) and `origin` [m]. `.nvdb`: grids of these names, or one grid of any name, which is the density; the box holds
    the voxels that are set. Raises `FileError`.
    """
    place, names = existing_file(path), (*GRID_ARRAYS, *_PLACES)
    try:
        if place.suffix.lower() == ".nvdb":
            return _checked(_read_nvdb(place))
        if place.suffix.lower() == ".npz":
            return _checked(read_npz(place, names=names, largest=LARGEST_CELL_COUNT))
        with read_hdf5(place) as file:
            found = {name: entry for name, entry in file.arrays().items() if name in names}
            return _checked({n: file.array(n, kind, (None,) * len(shape)) for n, (shape, kind) in found.items()})
    except ConfigError as error:
        raise FileError(f"{path}: {error}") from None
    except (SpadwarpError, ValueError, TypeError, RuntimeError, OSError, MemoryError) as error:
        text = str(error) if isinstance(error, FileError) else f"{path}: damaged or not readable: {error}"
        raise FileError(text) from error


def _read_nvdb(path: Path) -> dict[str, NDArray[Any]]:
    """By way of `wp.Volume`, on the CPU: the voxels of sparse grids, and their background where there are none."""
    import warp as wp

    import spadwarp_kernels as sk

    volume: Any = wp.Volume.load_from_nvdb(path.read_bytes(), device="cpu")
    volumes: list[tuple[Any, Any]] = []
    while volume is not None:
        volumes.append((info := volume.get_grid_info(), volume))
        volume = volume.load_next_grid() if info.grid_index + 1 < info.grid_count else None
    named = {info.name: (info, one) for info, one in volumes if info.name in GRID_ARRAYS}
    if not named and len(volumes) > 1:
        names = [info.name for info, _ in volumes]
        raise ConfigError(f"grids {names}, none of which is one of {', '.join(GRID_ARRAYS)}")
    named = named or {"density": volumes[0]}
    voxels = {name: one.get_voxels().numpy() for name, (_, one) in named.items()}
    if not all(map(len, voxels.values())):
        raise ConfigError("a grid without voxels")
    low = np.min([one.min(axis=0) for one in voxels.values()], axis=0)
    shape = tuple(int(n) for n in np.max([one.max(axis=0) for one in voxels.values()], axis=0) + 1 - low)
    if np.prod(shape, dtype=np.float64) > LARGEST_CELL_COUNT:
        raise ConfigError(f"voxels within {shape} cells; at most {LARGEST_CELL_COUNT} are allowed")
    info = next(iter(named.values()))[0]
    transform = np.array(info.transform_matrix, np.float64).reshape(3, 3)
    cell = np.diag(transform)
    if not np.allclose(transform, np.diag(cell)) or (cell <= 0.0).any():
        raise ConfigError("a rotated or mirrored grid; rotate it by medium.grid.rotation_deg")
    arrays: dict[str, NDArray[Any]] = {}
    for name, (info, one) in named.items():
        if one.dtype is not wp.float32:
            raise ConfigError(f"grid {info.name!r} holds {one.dtype}; float is needed")
        values = wp.empty(len(voxels[name]), dtype=float, device="cpu")
        indices: wp.array = wp.array(voxels[name], dtype=wp.vec3i, device="cpu")
        wp.launch(sk.voxel_values_kernel, len(voxels[name]), [one.id, indices, values], device="cpu")
        arrays[name] = np.zeros(shape, np.float32)
        arrays[name][tuple((voxels[name] - low).T)] = values.numpy()
    # A voxel's value is that at its middle, which is the place of its index.
    origin = np.array(named[next(iter(named))][0].translation, np.float64) + (low - 0.5) * cell
    return {**arrays, "size": cell * shape, "origin": origin}


def _checked(found: Mapping[str, NDArray[Any]]) -> GridFile:
    arrays: dict[str, NDArray[np.float32]] = {}
    for name, interval in GRID_ARRAYS.items():
        if (values := found.get(name)) is None:
            continue
        if values.ndim not in (3, 4) or values.dtype.kind not in "fiu" or not 0 < values.size <= LARGEST_CELL_COUNT:
            raise ConfigError(
                f"{name} is {values.dtype} {values.shape}; numbers [x, y, z] or [frame, x, y, z] of at most "
                f"{LARGEST_CELL_COUNT} cells are needed"
            )
        values = values.astype(np.float32).reshape(-1, *values.shape[-3:])
        if not (inside := interval.holds(values)).all():
            place = tuple(int(i) for i in np.argwhere(~inside)[0])
            raise ConfigError(f"{name}{list(place[1:])} = {values[place]:g} is outside {interval}")
        arrays[name] = values
    coefficients = set(COEFFICIENTS) & set(arrays)
    if ("density" in arrays) == bool(coefficients) or len(coefficients) not in (0, 2):
        needed = "density, or two of extinction, absorption, scattering and albedo are needed"
        raise ConfigError(f"holds {', '.join(arrays) or 'none of them'}; {needed}")
    shapes = {values.shape for values in arrays.values()}
    if len(shapes) > 1:
        raise ConfigError(f"arrays of different shapes, {sorted(shapes)}")
    places: dict[str, NDArray[np.float64]] = {}
    for name, within in _PLACES.items():
        if name in found:
            values = np.asarray(found[name], np.float64).ravel()
            places[name] = np.repeat(values, 3) if values.size == 1 else values
            if places[name].size != 3 or not Interval.read(within).holds(values).all():
                raise ConfigError(f"{name} = {places[name].tolist()[:4]} is not three numbers in {within}")
    if "cell_size" in places:
        places.setdefault("size", places["cell_size"] * shapes.pop()[1:])
    return GridFile(arrays, *(vector_of(places[name]) if name in places else None for name in ("size", "origin")))


# Cells


@dataclass(frozen=True, eq=False)
class GridCells:
    """Cells of water in a box, and what light loses on straight lines through it."""

    extinction: NDArray[np.float32]  # c [1/m], `[x, y, z]` along the box's own axes
    albedo: NDArray[np.float32]  # b/c
    anisotropy: NDArray[np.float32] | None  # g; None: the medium's everywhere
    size: Vector  # edges of the box [m]
    centre: Vector  # its middle in the world [m]
    rotation: Floats  # its own axes in the world, as columns

    @property
    def scattering(self) -> NDArray[np.float32]:
        """b [1/m] of each cell."""
        return self.extinction * self.albedo

    def at(self, points: ArrayLike, outside: float) -> Floats:
        """Extinction [1/m] at points of the world `[..., 3]`, with that outside the box."""
        return self._at(self.in_cells(points), outside)

    def in_cells(self, points: ArrayLike) -> Floats:
        """Points of the world `[..., 3]` [m] in cells: the box has 0 ... shape there."""
        own = (np.asarray(points, np.float64) - self.centre) @ self.rotation
        return (own / self.size + 0.5) * np.array(self.extinction.shape)

    def index_of(self, places: Floats) -> tuple[tuple[Any, ...], Any]:
        """Indices of the cells at places of `in_cells`, outside the box of the nearest, and whether they are in it."""
        shape = np.array(self.extinction.shape)
        index = np.clip(np.nan_to_num(np.floor(places), nan=-1.0), -1, shape).astype(np.int32)
        inside = ((index >= 0) & (index < shape)).all(axis=-1)
        return tuple(np.moveaxis(np.clip(index, 0, shape - 1), -1, 0)), inside

    def _at(self, places: Floats, outside: float) -> Floats:
        index, inside = self.index_of(places)
        return np.where(inside, self.extinction[index], outside)

    def optical_depths(self, begin: ArrayLike, end: ArrayLike, outside: float) -> Floats:
        """∫c ds along straight lines between points of the world `[..., 3]`, exact for the cells.

        A line is cut where it crosses the planes between cells, and the cell of each piece is that of its middle.
        """
        first, last = np.broadcast_arrays(np.asarray(begin, np.float64), np.asarray(end, np.float64))
        shape = first.shape[:-1]
        first, last = first.reshape(-1, 3), last.reshape(-1, 3)
        size = max(1, _CROSSINGS // (sum(self.extinction.shape) + 5))
        parts = [self._depths(first[k : k + size], last[k : k + size], outside) for k in range(0, len(first), size)]
        return np.concatenate([np.zeros(0), *parts]).reshape(shape)

    def _depths(self, begin: Floats, end: Floats, outside: float) -> Floats:
        first, along = self.in_cells(begin), self.in_cells(end) - self.in_cells(begin)
        cuts = [np.zeros((len(begin), 1)), np.ones((len(begin), 1))]
        for axis, count in enumerate(self.extinction.shape):
            with np.errstate(divide="ignore", invalid="ignore"):
                crossing = (np.arange(count + 1) - first[:, axis, None]) / along[:, axis, None]
            cuts.append(np.clip(np.nan_to_num(crossing, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0))
        t = np.sort(np.concatenate(cuts, axis=1), axis=1)
        middle = first[:, None, :] + 0.5 * (t[:, 1:] + t[:, :-1])[..., None] * along[:, None, :]
        return (self._at(middle, outside) * np.diff(t, axis=1)).sum(axis=1) * np.linalg.norm(end - begin, axis=1)


@functools.lru_cache(maxsize=4)
def cells_of(grid: Grid, water: tuple[float, float, float], has_table: bool, stamp: Any) -> GridCells:
    """The cells of a grid in water of an extinction [1/m], an albedo and an anisotropy.

    `has_table`: whether scattering is drawn from a table, which all cells share. `stamp` changes when the file does.
    """
    edges, origin = grid.edges, None
    found: dict[str, Any]
    if grid.file is None:
        found = {"density": shape_density(grid)}
    else:
        file = _read(grid.file, stamp)
        edges, origin = edges or file.size, file.origin
        if edges is None:
            raise ConfigError(f"medium.grid: needs size; {grid.file} has no size and no cell_size")
        found = {name: _frame(grid, values) for name, values in file.arrays.items()}
    if grid.constituent is not None and "density" not in found:
        raise ConfigError(f"medium.grid.constituent = {grid.constituent!r} needs density, which {grid.file} has not")
    g = found.get("anisotropy")
    if g is not None and has_table:
        raise ConfigError(
            f"medium.grid.file = {grid.file!r} has an anisotropy, which goes with phase_function = "
            "'henyey_greenstein' only; cells share any other"
        )
    if "density" in found:  # coefficients add up, the mean cosine is that of both scatterings together
        extinction, albedo, anisotropy = water
        added, g = grid.extinction * found["density"], grid.anisotropy if g is None else g
        c = extinction + added
        b = extinction * albedo + grid.albedo * added
        omega = np.clip(b / np.maximum(c, 1e-30), 0.0, 1.0)
        if g is not None:
            both = (extinction * albedo * anisotropy + grid.albedo * added * g) / np.maximum(b, 1e-30)
            g = np.where(b > 0.0, both, anisotropy)
    else:
        c, omega = _coefficients(found)
    size = np.array(edges) * grid.scale
    rotation = rotation_matrix(grid.rotation_deg)
    own = np.zeros(3) if origin is None else (np.array(origin) + 0.5 * np.array(edges)) * grid.scale
    c, omega = np.ascontiguousarray(c, np.float32), np.ascontiguousarray(omega, np.float32)
    g = None if g is None else np.ascontiguousarray(g, np.float32)
    return GridCells(c, omega, g, vector_of(size), vector_of(rotation @ own + grid.translation), rotation)


@functools.lru_cache(maxsize=2)
def _read(path: str, stamp: Any) -> GridFile:
    with file_of("medium.grid.file"):
        return read_grid(path)


def _frame(grid: Grid, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The cells at `grid.frame`, between two frames the mean of both by their distance."""
    last = len(values) - 1
    if grid.frame > last:
        raise ConfigError(f"medium.grid.frame = {grid.frame:g} is outside [0, {last}], the frames of {grid.file}")
    low = min(int(grid.frame), max(last - 1, 0))
    part = np.float32(grid.frame - low)
    return values[low] if part == 0.0 else (1 - part) * values[low] + part * values[low + 1]


def _coefficients(found: Mapping[str, NDArray[np.float32]]) -> tuple[Cells, Cells]:
    """Extinction and albedo from two of the four coefficients."""
    a, b, c, omega = (found.get(name) for name in COEFFICIENTS)  # type: Any, Any, Any, Any
    tiny = np.float32(1e-30)
    if omega is not None:
        if b is not None:
            return b / np.maximum(omega, tiny) * (omega > 0.0), omega
        return (c if a is None else a / np.maximum(1.0 - omega, tiny) * (omega < 1.0)), omega
    c = a + b if c is None else c
    scattered = np.maximum(c - a, 0.0) if b is None else b
    return c, np.clip(scattered / np.maximum(c, tiny), 0.0, 1.0)
