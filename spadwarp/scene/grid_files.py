"""Files of cells: NumPy archives, HDF5, NanoVDB."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import FileError, SpadwarpError
from spadwarp.io.arrays import read_npz
from spadwarp.io.hdf5 import read_hdf5
from spadwarp.io.paths import existing_file

__all__ = ["GRID_ARRAYS", "LARGEST_CELL_COUNT", "GridFile", "read_grid"]

LARGEST_CELL_COUNT = 1 << 27

GRID_ARRAYS = {
    "density": "[0, 1e9]",
    "extinction": "[0, 1e6]",
    "absorption": "[0, 1e6]",
    "scattering": "[0, 1e6]",
    "albedo": "[0, 1]",
    "anisotropy": "(-1, 1)",
}
"""Arrays of a file `[x, y, z]`, or of several frames `[frame, x, y, z]`, and their ranges."""


@dataclass(frozen=True, eq=False)
class GridFile:
    """What a file has.

    Attributes:
        arrays: By the names of `GRID_ARRAYS`, `[frame, x, y, z]` float32.
        size: Edges of the box [m]; None: the scene has to say.
        origin: Its lower corner in the file's own frame [m]; None: the box stands about its middle.
    """

    arrays: Mapping[str, NDArray[np.float32]]
    size: tuple[float, float, float] | None = None
    origin: tuple[float, float, float] | None = None
    frames: int = field(default=1)


def read_grid(path: str | Path) -> GridFile:
    """The cells of a file: `density`, or two of extinction, absorption, scattering and albedo; and `anisotropy`.

    `.npz` and `.h5`: arrays by these names, `[x, y, z]` or `[frame, x, y, z]`, and `size` (3 edges) or `cell_size` (one
    or 3) and `origin` [m]. `.nvdb`: grids of these names, or one grid of any name, which is the density; the box holds
    the voxels that are set.

    Raises `FileError`.
    """
    place = existing_file(path)
    reader = _READERS[place.suffix.lower()]
    try:
        return reader(place)
    except FileError:
        raise
    except (SpadwarpError, ValueError, TypeError, RuntimeError, OSError, MemoryError) as error:
        raise FileError(f"{path}: damaged or not readable: {error}") from error


def _read_npz(path: Path) -> GridFile:
    arrays = read_npz(path, names=(*GRID_ARRAYS, *_PLACES), largest=LARGEST_CELL_COUNT)
    return _checked(path, arrays)


def _read_hdf5(path: Path) -> GridFile:
    with read_hdf5(path) as file:
        found = {name: entry for name, entry in file.arrays().items() if name in (*GRID_ARRAYS, *_PLACES)}
        arrays = {name: file.array(name, kind, (None,) * len(shape)) for name, (shape, kind) in found.items()}
    return _checked(path, arrays)


def _read_nvdb(path: Path) -> GridFile:
    """By way of `wp.Volume`, on the CPU."""
    import warp as wp

    with path.open("rb") as file:
        data = file.read()
    volume: Any = wp.Volume.load_from_nvdb(data, device="cpu")
    volumes: list[Any] = []
    while volume is not None:
        volumes.append(volume)
        info = volume.get_grid_info()
        volume = volume.load_next_grid() if info.grid_index + 1 < info.grid_count else None
    named = {one.get_grid_info().name: one for one in volumes if one.get_grid_info().name in GRID_ARRAYS}
    if not named:
        if len(volumes) > 1:
            names = [one.get_grid_info().name for one in volumes]
            raise FileError(f"{path}: grids {names}, none of which is one of {', '.join(GRID_ARRAYS)}")
        named = {"density": volumes[0]}
    places = {name: one.get_voxels().numpy() for name, one in named.items()}
    if not all(len(voxels) for voxels in places.values()):
        raise FileError(f"{path}: a grid without voxels")
    low = np.min([voxels.min(axis=0) for voxels in places.values()], axis=0)
    high = np.max([voxels.max(axis=0) for voxels in places.values()], axis=0) + 1
    shape = tuple(int(n) for n in high - low)
    if np.prod(shape, dtype=np.float64) > LARGEST_CELL_COUNT:
        raise FileError(f"{path}: voxels within {shape} cells; at most {LARGEST_CELL_COUNT} are allowed")
    arrays: dict[str, NDArray[Any]] = {name: _dense(path, one, places[name], low, shape) for name, one in named.items()}
    infos = [one.get_grid_info() for one in named.values()]
    transform = np.array(infos[0].transform_matrix, np.float64).reshape(3, 3)
    cell = np.diag(transform)
    if not np.allclose(transform, np.diag(cell)) or (cell <= 0.0).any():
        raise FileError(f"{path}: a rotated or mirrored grid; rotate it by medium.grid.rotation_deg")
    # A voxel's value is that at its middle, which is the place of its index.
    origin = np.array(infos[0].translation, np.float64) + (low - 0.5) * cell
    arrays |= {"size": cell * shape, "origin": origin}
    return _checked(path, arrays)


def _dense(
    path: Path, volume: Any, voxels: NDArray[np.int32], low: NDArray[np.int32], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """The values of a sparse grid, and its background where there are none."""
    import warp as wp

    import spadwarp_kernels as sk

    if volume.dtype is not wp.float32:
        raise FileError(f"{path}: grid {volume.get_grid_info().name!r} holds {volume.dtype}; float is needed")
    values = wp.empty(len(voxels), dtype=float, device="cpu")
    indices: wp.array = wp.array(voxels, dtype=wp.vec3i, device="cpu")
    wp.launch(sk.voxel_values_kernel, len(voxels), [volume.id, indices, values], device="cpu")
    dense = np.zeros(shape, np.float32)
    dense[tuple((voxels - low).T)] = values.numpy()
    return dense


_READERS: dict[str, Callable[[Path], GridFile]] = {
    ".npz": _read_npz,
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
    ".nvdb": _read_nvdb,
}
_PLACES = ("size", "cell_size", "origin")


def _checked(path: Path, found: Mapping[str, NDArray[Any]]) -> GridFile:
    arrays: dict[str, NDArray[np.float32]] = {}
    shapes: set[tuple[int, ...]] = set()
    for name, interval in GRID_ARRAYS.items():
        if name not in found:
            continue
        values = found[name]
        if values.ndim not in (3, 4) or values.dtype.kind not in "fiu" or not 0 < values.size <= LARGEST_CELL_COUNT:
            raise FileError(
                f"{path}: {name} is {values.dtype} {values.shape}; numbers [x, y, z] or [frame, x, y, z] of at most "
                f"{LARGEST_CELL_COUNT} cells are needed"
            )
        values = values.astype(np.float32).reshape(-1, *values.shape[-3:])
        low, high = (float(text) for text in interval.strip("[]()").split(", "))
        within = (values > low) & (values < high) if interval[0] == "(" else (values >= low) & (values <= high)
        if not within.all():
            place = tuple(int(i) for i in np.argwhere(~within)[0])
            raise FileError(f"{path}: {name}{list(place[1:])} = {values[place]:g} is outside {interval}")
        arrays[name] = values
        shapes.add(values.shape)
    coefficients = [name for name in ("extinction", "absorption", "scattering", "albedo") if name in arrays]
    if ("density" in arrays) == bool(coefficients) or (coefficients and len(coefficients) != 2):
        held = ", ".join(arrays) or "none of them"
        raise FileError(
            f"{path}: holds {held}; density, or two of extinction, absorption, scattering and albedo are needed"
        )
    if len(shapes) > 1:
        raise FileError(f"{path}: arrays of different shapes, {sorted(shapes)}")
    (shape,) = shapes
    size = _place(path, found, "size", "(0, inf)")
    if size is None and (cell := _place(path, found, "cell_size", "(0, inf)")) is not None:
        size = (cell[0] * shape[1], cell[1] * shape[2], cell[2] * shape[3])
    return GridFile(arrays, size, _place(path, found, "origin", "(-inf, inf)"), shape[0])


def _place(
    path: Path, found: Mapping[str, NDArray[Any]], name: str, interval: str
) -> tuple[float, float, float] | None:
    if name not in found:
        return None
    values = np.asarray(found[name], np.float64).ravel()
    values = np.repeat(values, 3) if values.size == 1 else values
    positive = interval == "(0, inf)"
    if values.size != 3 or not np.isfinite(values).all() or (positive and (values <= 0.0).any()):
        raise FileError(f"{path}: {name} = {values.tolist()[:4]} is not three numbers in {interval}")
    x, y, z = values.tolist()
    return x, y, z
