"""Time tags in HDF5 files: a growing column for each of their fields."""

from __future__ import annotations

from typing import Any

import numpy as np

from spadwarp.frames.frames import TimeTags

__all__ = ["PACKED", "TAG_DIMENSION", "add_tags", "create_tag_columns", "described_tags"]

PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
TAG_DIMENSION = "tags/detection"

_CHUNK = 1 << 16
_KINDS: dict[str, Any] = {"frame": np.int64, "y": np.int32, "x": np.int32, "pulse": np.int64, "bin": np.int32}


def create_tag_columns(file: Any) -> None:
    """Empty columns in an h5py file."""
    for name, kind in _KINDS.items():
        file.create_dataset(f"tags/{name}", (0,), kind, maxshape=(None,), chunks=(_CHUNK,), **PACKED)


def add_tags(file: Any, tags: TimeTags) -> None:
    """Appends tags to the columns, and as many places to their dimension."""
    for name, values in tags._asdict().items():
        column = file[f"tags/{name}"]
        before = column.shape[0]
        column.resize((before + len(values),))
        column[before:] = values
    file[TAG_DIMENSION].resize(column.shape)


def described_tags() -> dict[str, tuple[tuple[str, ...], str, str]]:
    """Dimension, unit and meaning of each column."""
    return {f"tags/{name}": ((TAG_DIMENSION,), "1", f"{name} of the detection") for name in _KINDS}
