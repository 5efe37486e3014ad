"""PicoQuant's .ptu files of T3 records: images, and other scans by their markers."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, FileError
from spadwarp.frames.time_tags import most_values
from spadwarp.limits import shown

__all__ = ["read_ptu"]

_MARKERS = 16  # of T3 records; four today
# What ptufile says about a damaged file stands in our errors, too.
logging.getLogger("ptufile").addHandler(logging.NullHandler())


def read_ptu(
    path: Path, *, image_size: tuple[int, int] | None = None, sum_frames: bool = False
) -> tuple[NDArray[np.int32], float, float | None, str]:
    """Counts `[H, W, T]` or `[frames, H, W, T]` of all channels, width of a bin [s], time of flight at bin 0 [s] or
    None, and how the pixels were found.

    Args:
        path: The file.
        image_size: (height, width) of a scan whose file has no image, but a marker at the start of each pixel or line.
        sum_frames: Add the frames of an image up.

    Raises:
        ArgumentError: A size that is missing, or that does not fit the markers; an image that is too large.
        FileError: No T3 records.
    """
    import ptufile

    with ptufile.PtuFile(path) as file:
        _check_tags(file, path)
        if not file.is_t3:
            raise FileError(f"{path}: T2 records have no time since the pulse; T3 records are needed")
        file.cache_records = True
        if (there := len(file.read_records())) < file.number_records:
            raise FileError(f"{path}: cut: of {file.number_records} records {there} are there")
        width = float(file.tcspc_resolution)
        if not 1e-15 < width < 1e-3:
            raise FileError(f"{path}: MeasDesc_Resolution = {width} s is outside (1e-15, 1e-3)")
        if file.is_image and image_size is None:
            counts, text = _image(file, sum_frames), "pixels by the image in its header"
        else:
            counts, text = _scan(file, image_size)
        if (channels := file.number_channels) > 1:
            text += f"; {channels} channels, added up"
        return counts, width, _own_gate(file), text


def _check_tags(file: Any, path: Path) -> None:
    """Refuses numbers of the header that its reader would compute with for minutes."""
    for name in ("ImgHdr_LineStart", "ImgHdr_LineStop", "ImgHdr_Frame"):  # a marker, a power of two of it
        if not 0 <= (marker := file.tags.get(name) or 0) <= _MARKERS:
            raise FileError(f"{path}: {name} = {shown(marker)} is outside [0, {_MARKERS}], the markers of a record")
    count, size = file.tags.get("TTResult_NumberOfRecords") or 0, path.stat().st_size
    if not 4 * count <= size:
        raise FileError(f"{path}: TTResult_NumberOfRecords = {shown(count)} is more than a file of {size} bytes holds")


def _image(file: Any, sum_frames: bool) -> NDArray[np.int32]:
    frames, height, width, _, bins = file.shape
    most_values((1 if sum_frames else frames, height, width, bins), "adding up the frames (sum_frames)")
    options: dict[str, Any] = {"channel": -1, "dtype": np.uint32, "keepdims": False}
    counts = file.decode_image(frame=-1 if sum_frames or frames == 1 else None, **options)
    return np.ascontiguousarray(counts).view(np.int32)


def _scan(file: Any, image_size: tuple[int, int] | None) -> tuple[NDArray[np.int32], str]:
    """A point, or a scan with a marker at the start of each pixel or line, and maybe one more at its end."""
    records = file.decode_records()
    photon = records["channel"] >= 0
    dtime = records["dtime"][photon].astype(np.int64)
    marks = np.flatnonzero(~photon & (records["marker"] > 0))
    bins = int(dtime.max(initial=0)) + 1
    if image_size is None:
        if marks.size:
            raise ArgumentError(f"the image's size is missing (image_size): a scan of {marks.size} markers")
        return np.bincount(dtime, minlength=bins).astype(np.int32)[None, None], "one point"
    height, width = image_size
    most_values((height, width, bins), "a smaller image")
    start, text = _starts(records, marks, height, width)
    pixel = np.searchsorted(start, records["time"][photon].astype(np.float64), side="right") - 1
    inside = (pixel >= 0) & (pixel < height * width)
    counts = np.zeros(height * width * bins, np.int32)
    np.add.at(counts, pixel[inside] * bins + dtime[inside], 1)
    return counts.reshape(height, width, bins), text


def _starts(records: Any, marks: NDArray[np.intp], height: int, width: int) -> tuple[NDArray[np.float64], str]:
    """Times at which the pixels begin, and the last one ends: by the kind of marker that fits."""
    kinds = records["marker"][marks]
    times = {int(kind): records["time"][marks[kinds == kind]].astype(np.float64) for kind in np.unique(kinds)}
    for kind, time in times.items():
        if time.size in (height * width, height * width + 1):
            step = float(np.median(np.diff(time))) if time.size > 1 else np.inf
            return np.append(time, time[-1] + step)[: height * width + 1], f"a pixel at each marker {kind}"
    for kind, time in times.items():
        if time.size in (height, height + 1):
            step = float(np.median(np.diff(time))) if time.size > 1 else np.inf
            ends = np.append(time, time[-1] + step)[: height + 1]
            part = np.arange(width) / width
            start = (ends[:-1, None] + part * np.diff(ends)[:, None]).ravel()
            return np.append(start, ends[-1]), f"a line at each marker {kind}, its pixels equally long"
    found = ", ".join(f"{time.size} of kind {kind}" for kind, time in times.items()) or "none"
    raise ArgumentError(
        f"image size = {width} x {height}: {height * width} markers of one kind, or {height}, are needed; "
        f"the file has {found}"
    )


def _own_gate(file: Any) -> float | None:
    """Time of flight at the start of bin 0 [s], which `spadwarp export` writes in the comment; None for others."""
    if file.tags.get("CreatorSW_Name") != "spadwarp":
        return None
    found = re.search(r"Bin 0 begins at (\S+) ns of flight", file.comment or "")
    return 1e-9 * float(found[1]) if found else None
