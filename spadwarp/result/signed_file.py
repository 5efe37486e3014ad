"""Tallies with a sign in the HDF5 file of a result: groups `derivatives` and `channels`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from spadwarp.io.hdf5 import PIXELS, Hdf5File, write_packed
from spadwarp.result.signed_tallies import SignedTallies

__all__ = ["SIGNED_DIMENSIONS", "read_signed", "write_signed"]

SIGNED_DIMENSIONS = {
    "derivatives/tallies": (
        ("parameter", "component", *PIXELS, "time"),
        "1",
        "times derivatives/unit over photons: derivative of the fraction of the emitted photons",
    ),
    "derivatives/second_moment": (
        ("word", "parameter", *PIXELS, "time"),
        "1",
        "sum over batches of the squared tally of the derivative",
    ),
    "derivatives/unit": (("parameter",), "1", "of the tallies of each parameter"),
    "channels/tallies": (
        ("channel", "component", *PIXELS, "time"),
        "1",
        "times channels/unit over photons: fraction of the emitted photons in each channel",
    ),
    "channels/second_moment": (
        ("word", "channel", *PIXELS, "time"),
        "1",
        "sum over batches of the squared tally of the channel",
    ),
    "channels/unit": (("channel",), "1", "of the tallies of each channel"),
}
"""Dimensions, unit and meaning of the arrays."""


def write_signed(
    file: Any, group: str, found: SignedTallies | None, *, chunks: Sequence[int], compression: int
) -> None:
    """Writes the tallies to a group of an open file, as `write_packed`; their names are the file's attribute of that
    name."""
    if found is None:
        return
    file.attrs[group] = list(found.names)
    for name, array in {"tallies": found.tallies, "second_moment": found.second_moment}.items():
        if array is not None:
            write_packed(file, f"{group}/{name}", array, chunks=chunks, compression=compression)
    file.create_dataset(f"{group}/unit", data=np.array(found.units))


def read_signed(file: Hdf5File, group: str, shape: tuple[int, ...], batches: bool) -> SignedTallies | None:
    """What `write_signed` wrote beside tallies of a shape, with second moments where there are batches; None without.

    Raises `FileError`.
    """
    if group not in file:
        return None
    names = tuple(np.ravel(file.attribute(group)).tolist())
    count = len(names)
    if not all(isinstance(name, str) for name in names) or len(set(names)) < count:
        file.refuse(group, "are not names")
    units = file.array(f"{group}/unit", np.float64, (count,))
    if not all(unit > 0 and np.frexp(unit)[0] == 0.5 for unit in units):
        file.refuse(f"{group}/unit", "are not powers of two")
    return SignedTallies(
        names,
        file.array(f"{group}/tallies", np.int64, (count, *shape)),
        tuple(map(float, units)),
        file.array(f"{group}/second_moment", np.uint64, (2, count, *shape[1:])) if batches else None,
    )
