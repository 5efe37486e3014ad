"""Histograms from files: those that spadwarp wrote, and measured ones (`.npy`, `.mat`, `.h5`, `.ptu`).

What a measured file does not say is asked for by name, or assumed with a warning; what was inferred is in the notes.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, FileError, SpadwarpError, SpadwarpWarning
from spadwarp.frames.axes import image_shape, to_frames
from spadwarp.frames.file import FramesFile, is_frames_file
from spadwarp.frames.ptu import read_ptu
from spadwarp.frames.response import InstrumentResponse, detector_response
from spadwarp.frames.time_tags import histogram_of_tags, most_values
from spadwarp.io.hdf5 import hdf5_format, read_hdf5
from spadwarp.io.mat import MatEntry, SparseMatrix, mat_entries, read_mat
from spadwarp.io.npy import read_npy
from spadwarp.io.paths import existing_file
from spadwarp.limits import check_real
from spadwarp.result.file import load_result
from spadwarp.result.received import Channel, received

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["ENDINGS", "Histograms", "histograms_in", "is_own", "listed_arrays", "read_histograms", "unnamed_dataset"]

ENDINGS = (".h5", ".hdf5", ".npy", ".mat", ".ptu")


@dataclass(frozen=True, eq=False, kw_only=True)
class Histograms:
    """Histograms with what the file knows about them.

    Attributes:
        values: `[H, W, T]` or `[frames, H, W, T]`, not negative; counts are integers, rates are not.
        bin_width: [s]; None where the file does not hold it.
        gate_start: Time of flight at the lower edge of bin 0 [s].
        background: Expected background in the unit of `values`, of a shape that `arrival_time` takes, or None.
        irf: The response that the histograms contain; None: unknown, or none.
        response: The response to filter with; differs from `irf` for expected histograms of infinitely short pulses.
        scene: Of a simulation, else None.
        notes: What was inferred from the file, in words.
    """

    values: NDArray[Any]
    bin_width: float | None = None
    gate_start: float = 0.0
    background: NDArray[np.float32] | None = None
    irf: InstrumentResponse | None = None
    response: InstrumentResponse | None = None
    scene: Scene | None = None
    notes: tuple[str, ...] = ()

    @property
    def background_per_bin(self) -> NDArray[np.float32] | None:
        """The background where it has a value for each bin `[..., T]`, else None."""
        known = self.background
        return known if known is not None and known.ndim and known.shape[-1] == self.values.shape[-1] else None


@dataclass(frozen=True, kw_only=True)
class _Asked:
    """What the caller says about a file, as in `read_histograms`."""

    dataset: str | None
    axes: str | None
    image_size: tuple[int, int] | None
    tag_unit: float | None
    bin_width: float | None
    sum_frames: bool


@dataclass(frozen=True, kw_only=True)
class _Raw:
    """Histograms as they stand in a file, in their own order of axes, with what the file says."""

    values: NDArray[Any]
    bin_width: float | None = None
    first: float = 0.0  # begin of bin 0 after the time from which the file counts [s]
    gate_start: float | None = None  # time of flight at that time [s]
    ordered: bool = False  # whether the axes are `[H, W, T]` or `[frames, H, W, T]`
    notes: tuple[str, ...] = ()


def read_histograms(
    path: str | Path,
    *,
    dataset: str | None = None,
    axes: str | None = None,
    image_size: tuple[int, int] | None = None,
    tag_unit: float | None = None,
    bin_width: float | None = None,
    gate_start: float | None = None,
    irf: InstrumentResponse | None = None,
    sum_frames: bool = False,
    channel: Channel = "I",
) -> Histograms:
    """Reads histograms; the ending of the file says which kind of file it is.

    `.h5`, `.hdf5`: a result or frames of spadwarp, or an array of another program. `.npy`: an array. `.mat`, version
    7.3 included: an array, a sparse matrix `[pixels, T]` whose pixels stand column by column, or cells `[H, W]` of time
    tags. `.ptu`: T3 records of PicoQuant, channels added up. Floats that are all whole count as counts.

    Args:
        path: The file.
        dataset: Name of the array in a `.mat` or `.h5` file; default: of a `.mat` the sparse matrix, the cells, else
            the largest array of three or four dimensions; of a `.h5` the only such array.
        axes: Order of an array's axes, a letter for each: y rows, x columns, t bins, n frames, such as "yxt", "tyx" or
            "nyxt"; default: bins last, or first if only then the image is one.
        image_size: (height, width) where pixels stand one after the other, or are scanned without an image's header.
        tag_unit: Of time tags in cells [s].
        bin_width: [s]; where the file holds it, this one counts. Of time tags: a multiple of their unit, default the
            unit.
        gate_start: Time of flight at the start of bin 0, or at tag 0 [s].
        irf: The response that the histograms contain.
        sum_frames: Add frames up.
        channel: Of a result: which light counts, see `spadwarp.result.received`.

    Raises:
        FileError: No such file, not readable, of an unknown kind, without such an array, or with values that are
            negative or not finite; a package that is needed to read it is not installed.
        ArgumentError: A fact that is missing, out of range, or that the file holds itself.

    A file that does not say when the pulse left counts from bin 0 with a warning, unless `gate_start` is given.
    """
    path = existing_file(path)
    for name, value in {"tag_unit": tag_unit, "bin_width": bin_width}.items():
        if value is not None:
            check_real(f"{name} [s]", value, "(0, 0.001)")
    if gate_start is not None:
        check_real("gate_start [s]", gate_start, "[-1, 1]")
    asked = _Asked(
        dataset=dataset, axes=axes, image_size=image_size, tag_unit=tag_unit, bin_width=bin_width, sum_frames=sum_frames
    )
    ending = path.suffix.lower()
    if ending in (".h5", ".hdf5") and is_own(path):
        given = {**vars(asked), "gate_start": gate_start, "irf": irf}
        if clash := [name.replace("_", " ") for name, value in given.items() if value]:
            raise ArgumentError(f"{path}: the file has its own {', '.join(clash)}")
        return _read_own(path, channel)
    if channel != "I":
        raise ArgumentError(f"channel = {channel!r}: only results have channels, not {path}")
    raw = _read(path, ending, asked)
    values, notes = raw.values, list(raw.notes)
    _check(values, path)
    if not raw.ordered:
        values, said = to_frames(values, axes)
        notes += [] if said is None else [said]
    elif axes is not None:
        raise ArgumentError(f"{path}: the file has its own axes")
    values, said = _counts_or_rates(values)
    notes += [] if said is None else [said]
    if values.ndim == 4 and sum_frames:
        values = values.sum(axis=0, dtype=np.int64 if values.dtype.kind in "iu" else np.float64)
    if gate_start is None and raw.gate_start is None:
        origin = "tag 0" if raw.first else "bin 0"
        text = f"{path.name}: gate start is not given (gate_start): {origin} is taken for the time of the pulse"
        warnings.warn(text, SpadwarpWarning, stacklevel=2)
    return Histograms(
        values=np.ascontiguousarray(values),
        bin_width=raw.bin_width if bin_width is None else bin_width,
        gate_start=(gate_start if gate_start is not None else raw.gate_start or 0.0) + raw.first,
        irf=irf,
        response=irf,
        notes=tuple(notes),
    )


# Kinds of files


def is_own(path: Path) -> bool:
    """Whether spadwarp wrote this HDF5 file."""
    return (hdf5_format(path) or "").startswith("spadwarp")


def _read_own(path: Path, channel: Channel) -> Histograms:
    if is_frames_file(path):
        if channel != "I":
            raise ArgumentError(f"channel = {channel!r}: {path} holds frames, whose channel was chosen when drawn")
        file = FramesFile.load(path)
        return Histograms(
            values=file.counts(),
            bin_width=file.bin_width,
            gate_start=file.gate_start,
            background=None if file.background is None else file.background * np.float32(file.pulses),
            irf=file.irf,
            response=file.irf,
            scene=file.scene,
        )
    result = received(load_result(path), channel)
    scene = result.scene
    return Histograms(
        values=result.histogram,
        bin_width=scene.gate.bin_width,
        gate_start=scene.gate.start,
        background=result.component("backscatter").astype(np.float32),
        response=detector_response(scene.detector, scene.laser),
        scene=scene,
    )


def _read(path: Path, ending: str, asked: _Asked) -> _Raw:
    readers: dict[str, Callable[[Path, _Asked], _Raw]] = {
        ".h5": _read_hdf5,
        ".hdf5": _read_hdf5,
        ".npy": lambda path, asked: _Raw(values=read_npy(path)),
        ".mat": _read_mat,
        ".ptu": _read_ptu,
    }
    if ending not in readers:
        raise FileError(f"{path}: ending {path.suffix!r} is not one of {', '.join(ENDINGS)}")
    try:
        return readers[ending](path, asked)
    except (SpadwarpError, MemoryError):
        raise
    except ModuleNotFoundError as error:
        raise FileError(f"{path}: reading it needs {error.name}: pip install 'spadwarp[formats]'") from error
    except Exception as error:  # what a reader raises depends on the format
        raise FileError(f"{path}: damaged or not readable: {error}") from error


def listed_arrays(arrays: Mapping[str, tuple[tuple[int, ...], np.dtype[Any]]]) -> str:
    """Names and shapes of arrays, as an error lists them."""
    return ", ".join(f"{name} {shape}" for name, (shape, _) in arrays.items()) or "nothing"


def unnamed_dataset(path: Path, listed: str) -> ArgumentError:
    """The error for a file of several arrays of which none was named."""
    return ArgumentError(f"{path}: the dataset is missing (dataset); the file holds {listed}")


def _read_hdf5(path: Path, asked: _Asked) -> _Raw:
    with read_hdf5(path) as file:
        arrays = file.arrays()
        listed = listed_arrays(arrays)
        cubes = [name for name, (shape, dtype) in arrays.items() if len(shape) in (3, 4) and dtype.kind in "biuf"]
    name = asked.dataset or (cubes[0] if len(cubes) == 1 else None)
    if name is None and not cubes:
        raise FileError(f"{path}: no array of 3 or 4 dimensions; it holds {listed}")
    if name is None:
        raise unnamed_dataset(path, listed)
    if name not in arrays:
        raise FileError(f"{path}: no array {name!r}; it holds {listed}")
    shape, dtype = arrays[name]
    most_values(shape, "a part of the array")
    with read_hdf5(path) as file:
        return _Raw(values=file.array(name, dtype, shape), notes=() if asked.dataset else (f"reads {name}",))


def _read_mat(path: Path, asked: _Asked) -> _Raw:
    entries = mat_entries(path)
    found = histograms_in(entries)
    listed = ", ".join(f"{name} {one.shape} {one.kind}" for name, one in entries.items()) or "no numbers"
    name = asked.dataset or (found[0] if found else None)
    if name is None:
        raise FileError(f"{path}: no array of 3 or 4 dimensions, sparse matrix or cells; it holds {listed}")
    if name not in entries:
        raise FileError(f"{path}: no array {name!r}; it holds {listed}")
    entry, notes = (
        entries[name],
        [] if asked.dataset or len(found) == 1 else [f"reads {name}, not {', '.join(found[1:])}"],
    )
    if entry.kind == "dense":
        most_values(entry.shape, "a part of the array")
    value = read_mat(path, name, entry)
    facts = {
        key: float(np.asarray(read_mat(path, key, entries[key])).ravel()[0])
        for key in ("bin_size", "gate_start")
        if key in entries and entries[key].kind == "dense" and math.prod(entries[key].shape) == 1
    }
    width = facts.get("bin_size")
    width = width if width is not None and 1e-15 < width < 1e-3 else None
    if entry.kind == "cell":
        if asked.tag_unit is None:
            raise ArgumentError(f"{path}: the unit of the time tags in {name} is missing (tag_unit)")
        counts, step, first = histogram_of_tags(np.asarray(value), unit=asked.tag_unit, bin_width=asked.bin_width)
        notes.append(
            f"time tags of {counts.shape[1]} x {counts.shape[0]} pixels, bins of {step * 1e12:g} ps from tag {first}"
        )
        return _Raw(values=counts, bin_width=step, first=first * asked.tag_unit, ordered=True, notes=tuple(notes))
    if asked.bin_width is None and width is not None:
        notes.append(f"bin width {width * 1e12:g} ps from bin_size")
    common: dict[str, Any] = {"bin_width": width, "gate_start": facts.get("gate_start")}
    if isinstance(value, SparseMatrix):
        shapes = [one.shape for one in entries.values() if one.kind == "dense"]
        height, across = image_shape(value.shape[0], asked.image_size, shapes)
        notes.append(f"{across} x {height} pixels, column by column")
        return _Raw(values=_dense(value, height, across), ordered=True, notes=tuple(notes), **common)
    return _Raw(values=value, notes=tuple(notes), **common)


def histograms_in(entries: Mapping[str, MatEntry]) -> list[str]:
    """Variables that may hold histograms, counts before rates: sparse matrices, cells, arrays by their size."""
    rank = {"sparse": 0, "cell": 1, "dense": 2}
    fits = [
        name
        for name, (kind, shape) in entries.items()
        if math.prod(shape) > 1 and (kind != "dense" or len(shape) in (3, 4))
    ]
    return sorted(fits, key=lambda name: (rank[entries[name].kind], -math.prod(entries[name].shape)))


def _dense(matrix: SparseMatrix, height: int, width: int) -> NDArray[Any]:
    """`[H, W, T]` of a matrix `[pixels, T]` whose pixels stand column by column, as in MATLAB."""
    bins = matrix.shape[1]
    most_values((height, width, bins), "a part of the image")
    whole = bool((matrix.value == np.rint(matrix.value)).all() and (np.abs(matrix.value) < 2**31).all())
    cube = np.zeros((height, width, bins), np.int32 if whole else np.float32)
    column, row = np.divmod(matrix.row, height)
    cube[row, column, matrix.column] = matrix.value
    return cube


def _read_ptu(path: Path, asked: _Asked) -> _Raw:
    counts, width, start, text = read_ptu(path, image_size=asked.image_size, sum_frames=asked.sum_frames)
    notes = [text]
    if counts.ndim == 4:
        notes.append(f"{len(counts)} frames; sum_frames adds them up")
    return _Raw(values=counts, bin_width=width, gate_start=start, ordered=True, notes=tuple(notes))


# Values


def _check(values: NDArray[Any], path: Path) -> None:
    if values.ndim not in (3, 4) or values.size == 0 or values.dtype.kind not in "biuf":
        raise FileError(
            f"{path}: {values.dtype} {values.shape}; real numbers [H, W, T] or [frames, H, W, T] are needed"
        )
    if values.dtype.kind == "f" and np.isnan(values).any():
        raise FileError(f"{path}: holds NaN, as depth does; histograms are finite and not negative")
    if values.dtype.kind in "if" and not (values.min() >= 0 and math.isfinite(values.max())):
        raise FileError(f"{path}: holds {values.min()} … {values.max()}; finite values, not negative, are needed")


def _counts_or_rates(values: NDArray[Any]) -> tuple[NDArray[Any], str | None]:
    """Integers of floats that are all whole, as MATLAB writes counts; what was found, in words."""
    if values.dtype.kind != "f":
        return values, None
    if values.max() < 2**31 and np.array_equal(values, np.rint(values)):
        return values.astype(np.int32), "counts: every value is whole"
    return values, "rates: not every value is whole"
