"""Images in files of others: one of depth, or several."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.frames.measured import histograms_in, is_own, listed_arrays, unnamed_dataset
from spadwarp.io.hdf5 import read_hdf5
from spadwarp.io.mat import mat_entries, read_mat
from spadwarp.io.npy import read_npy

__all__ = ["stored_images"]


def stored_images(path: Path, dataset: str | None, *, several: bool) -> tuple[NDArray[Any], str] | None:
    """An image `[H, W]`, or if there may be `several` also images `[N, H, W]`, from `.npy`, `.mat` or `.h5`; None where
    the file or the dataset of that name holds histograms. Without a name: of a `.mat` without histograms the largest,
    of a `.h5` without them the only one. With it a text that names the image taken and those left; "" without a choice.

    Raises `FileError`, and `ArgumentError` where several of a `.mat` are the largest, or a `.h5` has several.
    """
    ending = path.suffix.lower()
    if ending == ".npy":
        array = read_npy(path)
        return (array, "") if array.ndim == 2 or (several and array.ndim == 3) else None
    if ending == ".mat":
        entries = mat_entries(path)
        images = {name: one for name, one in entries.items() if one.kind == "dense" and len(one.shape) in (2, 3)}
        name, choice = dataset, ""
        if name is None and (several or not histograms_in(entries)):
            name, choice = _largest(path, {name: one.shape for name, one in images.items() if math.prod(one.shape) > 1})
        if name not in images or (len(images[name].shape) == 3 and not several):
            return None
        return np.asarray(read_mat(path, name, images[name])), choice
    if ending in (".h5", ".hdf5") and not is_own(path):
        with read_hdf5(path) as file:
            arrays = file.arrays()
        name = _only_image(path, arrays, several=several) if dataset is None else dataset
        shape, dtype = arrays.get(name, ((), np.dtype(float)))
        if len(shape) == 2 or (several and len(shape) == 3):
            with read_hdf5(path) as file:
                return file.array(name, dtype, shape), ""
    return None


def _largest(path: Path, shapes: Mapping[str, tuple[int, ...]]) -> tuple[str | None, str]:
    """Name of the largest image, None without any, and a text that names it and the others, "" without others. Raises
    `ArgumentError` where several are the largest."""
    if not shapes:
        return None, ""
    most = max(map(math.prod, shapes.values()))
    largest = [name for name, shape in shapes.items() if math.prod(shape) == most]
    if len(largest) > 1:
        raise unnamed_dataset(path, ", ".join(f"{name} {shape}" for name, shape in shapes.items()))
    others = [name for name in shapes if name != largest[0]]
    return largest[0], f"{largest[0]}, not {', '.join(others)}" if others else ""


def _only_image(path: Path, arrays: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]], *, several: bool) -> str:
    """Name of the only array of an HDF5 file that may be an image, or if there may be `several` images; "" where it may
    hold histograms, or has no images. Raises `ArgumentError` where there are more."""
    numbers = {name: len(shape) for name, (shape, dtype) in arrays.items() if dtype.kind in "biuf"}
    cubes = [name for name, axes in numbers.items() if axes in (3, 4)]
    found = [name for name in cubes if several and numbers[name] == 3]
    if not found and not cubes:
        found = [name for name, axes in numbers.items() if axes == 2 and math.prod(arrays[name][0]) > 1]
    if len(found) > 1:
        raise unnamed_dataset(path, listed_arrays(arrays))
    return found[0] if found else ""
