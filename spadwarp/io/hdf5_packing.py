"""Large arrays of HDF5 files, compressed by all cores; HDF5 itself compresses with one."""

from __future__ import annotations

import itertools
import os
import zlib
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["write_packed"]

_THREADS = 16
_LARGE = 1 << 22  # bytes from which threads are worth their start


def write_packed(file: Any, name: str, array: NDArray[Any], *, chunks: Sequence[int], compression: int) -> Any:
    """Writes an array to an open file with HDF5's filters shuffle, gzip and fletcher32; returns the dataset.

    Args:
        file: From `write_hdf5`.
        name: Of the dataset.
        array: Of numbers.
        chunks: Shape of a chunk; about 1 MB.
        compression: Level of gzip, 1 to 9.
    """
    options = {"compression": "gzip", "compression_opts": compression, "shuffle": True, "fletcher32": True}
    if array.nbytes < _LARGE:
        return file.create_dataset(name, data=array, chunks=tuple(chunks), **options)
    made = file.create_dataset(name, array.shape, array.dtype, chunks=tuple(chunks), **options)
    empty = _packed(np.zeros(chunks, array.dtype), compression)

    def pack(start: tuple[int, ...]) -> bytes:
        part = array[tuple(slice(first, first + size) for first, size in zip(start, chunks, strict=True))]
        if not part.any():
            return empty
        if part.shape != tuple(chunks):  # at the edges
            whole = np.zeros(chunks, array.dtype)
            whole[tuple(map(slice, part.shape))] = part
            part = whole
        return _packed(part, compression)

    starts = itertools.product(*(range(0, size, step) for size, step in zip(array.shape, chunks, strict=True)))
    for start, data in _ahead(pack, starts):
        made.id.write_direct_chunk(start, data)
    return made


def _ahead(work: Any, items: Iterator[Any]) -> Iterator[tuple[Any, Any]]:
    """Items with what `work` makes of them, in their order; threads work a little ahead, so that memory stays small."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = min(cores, _THREADS)
    with ThreadPoolExecutor(threads) as pool:
        waiting: deque[Any] = deque()
        for item in items:
            waiting.append((item, pool.submit(work, item)))
            if len(waiting) > 2 * threads:
                first, future = waiting.popleft()
                yield first, future.result()
        for first, future in waiting:
            yield first, future.result()


def _packed(part: NDArray[Any], compression: int) -> bytes:
    """A chunk after the three filters."""
    numbers = np.ascontiguousarray(part)
    shuffled = np.ascontiguousarray(numbers.view(np.uint8).reshape(-1, part.dtype.itemsize).T)
    data = zlib.compress(shuffled.data, compression)
    return data + _fletcher32(data).to_bytes(4, "little")


def _fletcher32(data: bytes) -> int:
    """HDF5's checksum: Fletcher's with words of 16 bits, the high byte first, and sums from 1 to 65535 (0: all zero).

    Source: `H5_checksum_fletcher32` of HDF5, whose sums are those modulo 65535.
    """
    words = np.frombuffer(data + b"\0" * (len(data) % 2), ">u2").astype(np.uint64)
    weights = np.arange(len(words), 0, -1, dtype=np.uint64)  # times word, up to 2^20 words: below 2^56
    sums = int(words.sum()), int((words * weights % np.uint64(65535)).sum())
    low, high = ((total - 1) % 65535 + 1 if total else 0 for total in sums)
    return (high << 16) | low
