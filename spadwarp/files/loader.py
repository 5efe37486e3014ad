"""One loader for all files that spadwarp writes as HDF5."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

from spadwarp.analytic import AnalyticFile
from spadwarp.dataset import FrameReader
from spadwarp.errors import FileError
from spadwarp.frames import FramesFile
from spadwarp.frames.sequence_file import SequenceFile
from spadwarp.io.hdf5 import read_hdf5
from spadwarp.io.paths import file_within
from spadwarp.result import Result, load_result
from spadwarp.transport import PhotonRecords, load_records

__all__ = ["Held", "holds_own_file", "is_own_file", "load", "locate"]

Held = Result | FramesFile | SequenceFile | AnalyticFile | FrameReader | PhotonRecords
"""What a file of ours holds."""

_NAMES = ("frames.h5", "result.h5", "analytic.h5", "sequence.h5")
_DATASET, _CHECKPOINT = "manifest.json", "checkpoint.h5"
_LOADERS: dict[str, Callable[[Path], Held]] = {
    "spadwarp result": load_result,
    "spadwarp frames": FramesFile.load,
    "spadwarp analytic": AnalyticFile.load,
    "spadwarp records": load_records,
    "spadwarp sequence": SequenceFile.load,
}


def load(path: str | os.PathLike[str]) -> Held:
    """What a file that spadwarp wrote holds.

    - `result.h5`, `checkpoint.h5`: a `Result`.
    - `frames.h5` of `detect`: a `FramesFile`, which reads counts and depth when asked.
    - `analytic.h5`: an `AnalyticFile`, likewise.
    - A dataset's folder or one of its shards: a `FrameReader` of all its frames.
    - `records.h5`: `PhotonRecords`.
    - `sequence.h5` of `simulate --trajectory`: a `SequenceFile`, which reads frames of a scene that moves when asked.
    - A directory with one of these files, such as that of a run: the same. A checkpoint counts if there is no result.

    Raises:
        FileError: Not a file of ours, damaged, or a directory that holds none or several of them.
    """
    place = locate(path)
    if place.is_dir():
        return FrameReader(place, "all")
    with read_hdf5(place) as file:
        kind, shard = file.attribute("format", None), file.attribute("shard", None)
    if shard is not None:
        return FrameReader(place, "all")
    loader = _LOADERS.get(kind) if isinstance(kind, str) else None
    if loader is None:
        known = ", ".join(_LOADERS)
        raise FileError(f"{place}: an HDF5 file, but none of ours: its format is {kind!r}, not one of {known}")
    return loader(place)


def locate(path: str | os.PathLike[str]) -> Path:
    """A file as it is; of a directory the only result, frames or analytic file in it, else its checkpoint.

    A dataset's folder stays a folder. Raises `FileError` for a directory that holds none of them, or several.
    """
    place = Path(path)
    if not os.path.isdir(place) or (place / _DATASET).is_file():
        return place
    if not any((place / name).is_file() for name in _NAMES) and (place / _CHECKPOINT).is_file():
        return place / _CHECKPOINT
    return file_within(place, _NAMES)


def holds_own_file(folder: str | os.PathLike[str]) -> bool:
    """Whether a directory is that of a run, of frames, of an analytic file or of a dataset."""
    return any((Path(folder) / name).is_file() for name in (*_NAMES, _DATASET, _CHECKPOINT))


def is_own_file(place: Path) -> bool:
    """Whether a path from `locate` is a dataset's folder, or an HDF5 file that spadwarp wrote; raises `FileError` for a
    damaged one."""
    if place.is_dir():
        return True
    if place.suffix.lower() not in (".h5", ".hdf5"):
        return False
    with read_hdf5(place) as file:
        kind = file.attribute("format", None)
        return file.attribute("shard", None) is not None or (isinstance(kind, str) and kind.startswith("spadwarp"))
