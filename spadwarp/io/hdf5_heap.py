"""The places where HDF5 keeps text of any length, checked before HDF5 reads them.

HDF5 walks through a "global heap collection" from object to object by sizes that stand in the file; sizes that do not
fit make it walk for ever, or out of its memory. Layout: HDF5 File Format Specification, III.E.
"""

from __future__ import annotations

import functools
import mmap
import os
import struct
from pathlib import Path

__all__ = ["heap_problem"]

_MARK = b"GCOL\x01"  # with the version, since the letters alone also occur by chance in packed numbers
_SUPERBLOCK = b"\x89HDF\r\n\x1a\n"
_HEADER = 16  # bytes, of a collection and of each object in it
_WHOLE, _ENDS = 1 << 30, 1 << 26  # of larger files the first and the last part: text stands before and behind arrays


def heap_problem(path: str | Path) -> str | None:
    """What is wrong with the text of an HDF5 file; None if it can be read. Each state of a file is looked at once."""
    found = os.stat(path)
    return _problem(str(path), found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns)


@functools.lru_cache(maxsize=4096)
def _problem(path: str, *state: int) -> str | None:
    size = state[2]
    if size == 0:
        return "is empty"
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if not _has_long_sizes(content):
            return "has sizes of another width than 8 bytes"
        parts = [(0, size)] if size <= _WHOLE else [(0, _ENDS), (size - _ENDS, size)]
        for start, stop in parts:
            place = content.find(_MARK, start, stop)
            while place >= 0:
                if not _is_whole(content, place):
                    return f"has damaged text at byte {place}"
                place = content.find(_MARK, place + 1, stop)
    return None


def _has_long_sizes(content: mmap.mmap) -> bool:
    """Whether addresses and sizes take 8 bytes each, as in all files that are not tiny by choice."""
    place = 0
    while place < len(content) and content[place : place + 8] != _SUPERBLOCK:
        place = max(2 * place, 512)  # where the format allows a superblock
    if place + 16 > len(content):
        return False
    first = place + (13 if content[place + 8] < 2 else 9)
    return content[first] == content[first + 1] == 8


def _is_whole(content: mmap.mmap, place: int) -> bool:
    """Whether the objects of a collection fill it, none beyond its end."""
    if place + _HEADER > len(content):
        return False
    (size,) = struct.unpack_from("<Q", content, place + 8)
    end = place + size
    if size < _HEADER or end > len(content):
        return False
    place += _HEADER
    while end - place >= _HEADER:
        index, length = struct.unpack_from("<H6xQ", content, place)
        needed = _HEADER + -(-length // 8) * 8 if index else length
        if not _HEADER <= needed <= end - place:
            return False
        place += needed
    return True
