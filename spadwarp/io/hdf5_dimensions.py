"""Names and coordinates of the dimensions of HDF5 arrays, as netCDF-4 has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

__all__ = ["PIXELS", "Coordinate", "image_coordinates", "name_dimensions"]

PIXELS = ("y", "x")

Coordinate = tuple[Any, str, str]
"""Values of a coordinate, or the name of an array of the file that holds them; unit; meaning."""

_NO_COORDINATE = "This is a netCDF dimension but not a netCDF variable.{:10d}"  # what netCDF-4 calls its scale


def name_dimensions(
    file: Any,
    coordinates: Mapping[str, Coordinate | int | None],
    arrays: Mapping[str, tuple[Sequence[str], str, str]],
) -> None:
    """Writes dimension scales to an open file and attaches them to its arrays.

    Args:
        file: From `write_hdf5`.
        coordinates: Dimension → its coordinate, or its size alone; None: a size of 0 that grows with its arrays, which
            the caller resizes.
        arrays: Name → its dimensions, unit and meaning; those that the file does not hold are passed over. Dimensions
            that no array has are not written, but arrays that are coordinates of themselves are marked as such.
    """
    held = {name: described for name, described in arrays.items() if name in file}
    used = {dimension for dimensions, _, _ in held.values() for dimension in dimensions}
    for name, coordinate in coordinates.items():
        if name in used or (isinstance(coordinate, tuple) and isinstance(coordinate[0], str)):
            _write_scale(file, name, coordinate)
    for name, (dimensions, unit, meaning) in held.items():
        array = file[name]
        array.attrs.update({"units": unit, "long_name": meaning})
        for axis, dimension in enumerate(dimensions):
            array.dims[axis].attach_scale(file[dimension])


def image_coordinates(height: int, width: int) -> dict[str, Coordinate]:
    """Of `PIXELS`, and of the axes of vectors in the camera frame."""
    return {
        "y": (np.arange(height), "1", "row of pixels, downwards"),
        "x": (np.arange(width), "1", "column of pixels, to the right"),
        "axis": (["x", "y", "z"], "1", "of the camera frame: right, down, away"),
    }


def _write_scale(file: Any, name: str, coordinate: Coordinate | int | None) -> None:
    if coordinate is None or isinstance(coordinate, int):
        size = coordinate or 0
        grows: dict[str, Any] = {"maxshape": (None,), "chunks": (1 << 16,)} if coordinate is None else {}
        file.create_dataset(name, (size,), ">f4", **grows).make_scale(_NO_COORDINATE.format(size))
        return
    values, unit, meaning = coordinate
    if not isinstance(values, str):
        file.create_dataset(name, data=values if isinstance(values, np.ndarray) else list(values))
    stored = file[name if not isinstance(values, str) else values]
    stored.attrs.update({"units": unit, "long_name": meaning})
    stored.make_scale(name)
