"""Histograms from files: those that spadwarp wrote, and measured ones (`.npy`, `.npz`, `.mat`, `.h5`, `.ptu`).

What a measured file does not say is asked for by name, or assumed with a warning; what was inferred is in the notes.
"""

from __future__ import annotations

import logging
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.frames.depth import Histograms
from spadwarp.frames.file import FramesFile, is_frames_file
from spadwarp.frames.response import InstrumentResponse, detector_response
from spadwarp.io.arrays import read_npy, read_npz
from spadwarp.io.hdf5 import hdf5_format, open_hdf5
from spadwarp.io.mat import SparseMatrix, Variable, open_mat
from spadwarp.io.paths import existing_file, reading
from spadwarp.result import Channel, analyser_channel, load_result, noise_problem
from spadwarp.values import ArgumentError, FileError, Interval, SpadwarpWarning, check_real, shown

__all__ = ["read_histograms"]

_HDF5, _ARRAYS = (".h5", ".hdf5"), (".h5", ".hdf5", ".npy", ".npz", ".mat")
ENDINGS = (*_ARRAYS, ".ptu")
"""Of files that may hold histograms."""

_LEAST_BINS = 8  # of a histogram that is worth one
_CLEARLY = 2.0  # as far from a square as the other order of axes, and the choice is clear
_LEAST_RESPONSE = 0.02  # bins: shorter ones are not used for timing
_MOST_BINS = 1_000_000  # as of a scene's gate
_MOST_VALUES = 1 << 29  # 2 GiB of counts
_TIMES = {"tag_unit": "(0, 1e-3) s", "bin_width": "(0, 1e-3) s", "gate_start": "[-1, 1] s"}
_MARKERS = 16  # of T3 records; four today
# What ptufile says about a damaged file stands in our errors, too.
logging.getLogger("ptufile").addHandler(logging.NullHandler())


class _Raw(NamedTuple):
    """Histograms as they stand in a file, in their own order of axes, and the facts in the file."""

    values: NDArray[Any]
    notes: tuple[str, ...] = ()
    bin_width: float | None = None
    gate_start: float | None = None  # time of flight at the time from which the file counts [s]
    group_index: float | None = None
    first: float = 0.0  # begin of bin 0 after that time [s]
    ordered: bool = False  # whether the axes are `[H, W, T]` or `[frames, H, W, T]`
    options: tuple[str, ...] = ()  # what may be given of such a file, beside what every file takes


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

    `.h5`, `.hdf5`: a result or frames of spadwarp, or an array of another program. `.npy`, `.npz`, `.mat`, `.ptu`:
    as in docs/own_counts.md. Floats that are all whole count as counts.

    Args:
        path: The file.
        dataset: Name of the array in a `.mat`, `.npz` or `.h5` file; default: of a `.mat` the sparse matrix, the cells,
            else the largest array of three or four dimensions; of the others the only such array.
        axes: Order of an array's axes, a letter for each: y rows, x columns, t bins, n frames, such as "yxt", "tyx" or
            "nyxt"; default: bins last, or first if only then the image is one.
        image_size: (height, width) where pixels stand one after the other, or are scanned without an image's header.
        tag_unit: Of time tags in cells [s].
        bin_width: [s]; where the file holds it, this one counts. Of time tags: a multiple of their unit, default the
            unit.
        gate_start: Time of flight at the start of bin 0, or at tag 0 [s]. A file that does not say when the pulse left
            counts from bin 0 with a warning, unless it is given.
        irf: The response that the histograms contain.
        sum_frames: Add frames up.
        channel: Of a result: which light counts, see `spadwarp.result.analyser_channel`.

    Raises:
        FileError: No such file, not readable, of an unknown kind, without such an array, or with values that are
            negative or not finite; a package that is needed to read it is not installed.
        ArgumentError: A fact that is missing, out of range, or that the file holds itself.
    """
    path = existing_file(path)
    for name, value in {"tag_unit": tag_unit, "bin_width": bin_width, "gate_start": gate_start}.items():
        if value is not None:
            check_real(name, value, _TIMES[name])
    given: dict[str, Any] = {"dataset": dataset, "axes": axes, "image_size": image_size, "tag_unit": tag_unit}
    if is_own(path):
        given |= {"irf": irf, "bin_width": bin_width, "sum_frames": sum_frames, "gate_start": gate_start}
        if clash := [name for name, value in given.items() if value]:
            raise ArgumentError(f"{path}: the file has its own {', '.join(clash)}")
        return _read_own(path, channel)
    if channel != "I":
        raise ArgumentError(f"channel = {channel!r}: only results have channels, not {path}")
    if path.suffix.lower() not in ENDINGS:
        raise FileError(f"{path}: ending {path.suffix!r} is not one of {', '.join(ENDINGS)}")
    with reading(path):
        if path.suffix.lower() == ".ptu":
            raw = _read_ptu(path, image_size, sum_frames)
        else:
            raw = _read_arrays(path, dataset, image_size, tag_unit, bin_width)
    if idle := [name for name, value in given.items() if value is not None and name not in raw.options]:
        raise ArgumentError(f"{path}: {' and '.join(idle)} cannot be given; it takes {', '.join(raw.options)}")
    values, notes = _checked(raw.values, path), list(raw.notes)
    if not raw.ordered:
        values, note = _ordered(values, axes)
        notes += note
    if values.dtype.kind == "f":  # as MATLAB writes counts
        whole = values.max() < 2**31 and np.array_equal(values, np.rint(values))
        values = values.astype(np.int32) if whole else values
        notes.append("counts: every value is whole" if whole else "rates: not every value is whole")
    if values.ndim == 4 and sum_frames:
        values = values.sum(axis=0, dtype=np.int64 if values.dtype.kind in "iu" else np.float64)
    if gate_start is None and raw.gate_start is None:
        origin = f"{'tag' if raw.first else 'bin'} 0 is taken for the time of the pulse"
        warnings.warn(f"{path.name}: gate start is not given (gate_start): {origin}", SpadwarpWarning, stacklevel=2)
    bin_width = _fact("bin_width", bin_width, raw.bin_width, path)
    if irf is not None and bin_width is not None:
        _check_response(irf, bin_width, values.shape[-1] * bin_width, path)
    return Histograms(
        values=np.ascontiguousarray(values),
        bin_width=bin_width,
        gate_start=(_fact("gate_start", gate_start, raw.gate_start, path) or 0.0) + raw.first,
        group_index=raw.group_index,
        irf=irf,
        response=irf,
        notes=tuple(notes),
    )


def _fact(name: str, given: float | None, held: float | None, path: Path) -> float | None:
    """What is given, or else in the file. Raises `ArgumentError` where that is out of range."""
    if given is None and held is not None and held not in Interval.read(_TIMES[name]):
        raise ArgumentError(f"{path}: {name} = {held:g} is outside {_TIMES[name]}; give it, such as {name}=55ps")
    return held if given is None else given


def _check_response(irf: InstrumentResponse, bin_width: float, length: float, path: Path) -> None:
    """Refuses a response longer than the histograms [s], and warns of one far shorter than a bin."""
    if not irf.fwhm < length:
        text = f"irf = {irf.fwhm:.4g} s (full width at half maximum) is outside [0, {length:.4g}) s, the length of the"
        raise ArgumentError(f"{path}: {text} histograms; with a unit, write irf=300ps")
    if irf.fwhm < _LEAST_RESPONSE * bin_width:
        pair = f"irf = {irf.fwhm * 1e12:.4g} ps is {irf.fwhm / bin_width:.2g} of bin_width = {bin_width * 1e12:.4g} ps"
        warnings.warn(f"{path.name}: {pair}; one of the two may be of another unit", SpadwarpWarning, stacklevel=3)


def is_own(path: Path) -> bool:
    """Whether it is an HDF5 file that spadwarp wrote."""
    return path.suffix.lower() in _HDF5 and (hdf5_format(path) or "").startswith("spadwarp")


def _read_own(path: Path, channel: Channel) -> Histograms:
    if is_frames_file(path):
        if channel != "I":
            raise ArgumentError(f"channel = {channel!r}: {path} holds frames, whose channel was chosen when drawn")
        file = FramesFile.load(path)
        return Histograms(
            values=file.counts(),
            bin_width=file.bin_width,
            gate_start=file.gate_start,
            scene=file.scene,
            irf=file.irf,
            response=file.irf,
            background=file.background * np.float32(file.pulses),
            pulses=file.pulses if file.scene.detector.mode == "first_photon" else 0,
        )
    result = analyser_channel(load_result(path), channel)
    scene = result.scene
    return Histograms(
        values=result.expected(),
        bin_width=scene.gate.bin_width,
        gate_start=scene.gate.start,
        scene=scene,
        response=detector_response(scene.detector, scene.laser),
        notes=tuple(filter(None, [noise_problem(result)])),
        background=result.expected("backscatter").astype(np.float32),
    )


def _checked(values: NDArray[Any], path: Path) -> NDArray[Any]:
    if values.ndim not in (3, 4) or values.size == 0 or values.dtype.kind not in "biuf":
        needed = "real numbers [H, W, T] or [frames, H, W, T], one or more, are needed"
        hint = "; reshape [pixels, T] to [H, W, T]" if values.ndim == 2 else ""
        raise FileError(f"{path}: {values.dtype} {values.shape}; {needed}{hint}")
    if values.dtype.kind == "f" and np.isnan(values).any():
        raise FileError(f"{path}: holds NaN, as depth does (as_depth of denoise); histograms are finite, not negative")
    if values.dtype.kind in "if" and not (values.min() >= 0 and math.isfinite(values.max())):
        raise FileError(f"{path}: holds {values.min()} … {values.max()}; finite values, not negative, are needed")
    if values.dtype.kind in "iu" and values.max() >= 2**31:
        raise FileError(f"{path}: holds counts up to {values.max()}; a bin of a frame is in [0, {2**31 - 1}]")
    if not values.any():
        warnings.warn(f"{path.name}: holds no counts: all {values.size} values are 0", SpadwarpWarning, stacklevel=3)
    return values


def _check_size(shape: Sequence[int], instead: str) -> None:
    """Refuses histograms that would not fit: `ArgumentError` that says what would help."""
    if math.prod(shape) > _MOST_VALUES:
        sizes = " x ".join(map(str, shape))
        raise ArgumentError(f"{sizes} counts are more than {_MOST_VALUES}, which can be held; {instead} would help")


# The order of the axes: given, or inferred where there is one answer alone


def _ordered(values: NDArray[Any], axes: str | None) -> tuple[NDArray[Any], list[str]]:
    """Histograms `[H, W, T]` or `[frames, H, W, T]` from any order of axes, and a note of what was inferred."""
    letters, shape = "yxt" if values.ndim == 3 else "nyxt", values.shape
    orders = (letters, letters.replace("yxt", "tyx"))
    usual, note = _inferred(shape, orders), ""
    if axes is None and usual is None:
        choices = " or ".join(f"{order} ({_in_words(shape, order)})" for order in orders)
        raise ArgumentError(f"the order of the axes is missing (axes): shape {shape} may be {choices}")
    chosen = axes or usual or ""
    if sorted(chosen) != sorted(letters):
        raise ArgumentError(f"axes = {axes!r} are not the letters of {letters} in any order, for shape {shape}")
    if usual is not None and usual.index("t") != chosen.index("t"):
        note = f"; {usual} would be usual for {shape}: {_in_words(shape, usual)}"
    text = f"axes: {_in_words(shape, chosen)} (axes = {chosen}){note}"
    return np.transpose(values, [chosen.index(letter) for letter in letters]), [text]


def _inferred(shape: tuple[int, ...], orders: Sequence[str]) -> str | None:
    """Bins last or, before the image, first: the order whose image is clearly nearer to a square, if any."""
    sizes = {order: dict(zip(order, shape, strict=True)) for order in orders}
    usable = {order: size for order, size in sizes.items() if size["t"] >= _LEAST_BINS}
    ratio = {order: max(size["y"] / size["x"], size["x"] / size["y"]) for order, size in usable.items()}
    best = sorted(ratio, key=lambda order: ratio[order])
    return best[0] if len(best) == 1 or (best and ratio[best[0]] * _CLEARLY <= ratio[best[1]]) else None


def _in_words(shape: tuple[int, ...], axes: str) -> str:
    size = dict(zip(axes, shape, strict=True))
    frames = f"{size['n']} frames of " if "n" in size else ""
    return f"{frames}{size['x']} x {size['y']} pixels, {size['t']} bins"


# Arrays by their names, in NumPy's files, in HDF5 files of others and in MATLAB's


@contextmanager
def _arrays(path: Path) -> Iterator[dict[str, Variable]]:
    """Arrays of numbers of a file by name, not yet read; that of NumPy's file has the name ""."""
    ending = path.suffix.lower()
    if ending == ".mat":
        with open_mat(path) as variables:
            yield variables
    elif ending == ".npy":
        array = read_npy(path)
        yield {"": Variable("dense", array.shape, lambda: array)}
    elif ending == ".npz":
        arrays = read_npz(path, largest=_MOST_VALUES)
        yield {name: Variable("dense", array.shape, partial(np.asarray, array)) for name, array in arrays.items()}
    else:
        with closing(open_hdf5(path)) as file:
            yield {
                name: Variable("dense", shape, partial(file.array, name, dtype, shape))
                for name, (shape, dtype) in file.arrays().items()
                if dtype.kind in "biuf"
            }


def _listed(variables: Mapping[str, Variable]) -> str:
    kinds = {"dense": "", "sparse": " sparse", "cell": " cells"}
    listed = (f"{name or 'one without name'} {one.shape}{kinds[one.kind]}" for name, one in variables.items())
    return ", ".join(listed) or "no numbers"


def _unnamed(path: Path, variables: Mapping[str, Variable]) -> ArgumentError:
    """The error for a file of several arrays of which none was named."""
    return ArgumentError(f"{path}: the dataset is missing (dataset); the file holds {_listed(variables)}")


def _histograms_in(variables: Mapping[str, Variable]) -> list[str]:
    """Variables that may hold histograms, counts before rates: sparse matrices, cells, arrays by their size."""
    rank = {"sparse": 0, "cell": 1, "dense": 2}
    fits = {
        name: (rank[variable.kind], -math.prod(variable.shape))
        for name, variable in variables.items()
        if math.prod(variable.shape) > 1 and (variable.kind != "dense" or len(variable.shape) in (3, 4))
    }
    return sorted(fits, key=lambda name: fits[name])


def _read_arrays(
    path: Path, dataset: str | None, image_size: tuple[int, int] | None, tag_unit: float | None, bin_width: float | None
) -> _Raw:
    is_mat = path.suffix.lower() == ".mat"
    with _arrays(path) as variables:
        candidates = [""] if "" in variables else _histograms_in(variables)
        if dataset is None and not candidates:
            others = ", sparse matrix or cells" if is_mat else ""
            raise FileError(f"{path}: no array of 3 or 4 dimensions{others}; it holds {_listed(variables)}")
        if dataset is None and len(candidates) > 1 and not is_mat:
            raise _unnamed(path, variables)
        name = dataset or candidates[0]
        if name not in variables:
            raise FileError(f"{path}: no array {name!r} (dataset); it holds {_listed(variables)}")
        chosen = variables[name]
        if chosen.kind == "dense":
            _check_size(chosen.shape, "a part of the array")
        value = chosen.read()
        numbers = {
            key: float(np.asarray(variables[key].read()).ravel()[0])
            for key in ("bin_size", "bin_width", "gate_start", "group_index")
            if key in variables and variables[key].kind == "dense" and math.prod(variables[key].shape) == 1
        }
    others = f", not {', '.join(candidates[1:])}" if len(candidates) > 1 else ""
    notes = [f"reads {name}{others}"] if name and not dataset and (others or not is_mat) else []
    if chosen.kind == "cell":
        if tag_unit is None:
            needed = "tag_unit=8ps,bin_width=64ps,gate_start=0,group_index=1.3566,irf=300ps"
            raise ArgumentError(f"{path}: the unit of the time tags in {name} is missing (tag_unit); usual is {needed}")
        return _of_tags(value, tag_unit, bin_width, notes)
    width = numbers.get("bin_size", numbers.get("bin_width"))
    if bin_width is None and width is not None:
        notes.append(f"bin width {width * 1e12:g} ps from the file")
    index = numbers.get("group_index", 0.0)
    is_sparse = isinstance(value, SparseMatrix)
    if is_sparse:
        value = _of_sparse(value, image_size, variables)
        notes.append(f"{value.shape[1]} x {value.shape[0]} pixels, column by column")
    options = ("dataset", "image_size" if is_sparse else "axes")[not name :]
    facts = (width, numbers.get("gate_start"), index if 1.0 <= index <= 3.0 else None)
    return _Raw(value, tuple(notes), *facts, ordered=is_sparse, options=options)


def _of_sparse(
    matrix: SparseMatrix, image_size: tuple[int, int] | None, variables: Mapping[str, Variable]
) -> NDArray[Any]:
    """`[H, W, T]` of a matrix `[pixels, T]`, pixels column by column as in MATLAB; the image's size is given, or is the
    only shape of other arrays with as many pixels."""
    pixels, bins = matrix.shape
    shapes = {one.shape for one in variables.values() if one.kind == "dense"}
    fitting = [shape for shape in shapes if len(shape) == 2 and min(shape) > 1 and math.prod(shape) == pixels]
    if image_size is None and len(fitting) != 1:
        raise ArgumentError(f"the image's size is missing (image_size): {pixels} pixels, one after the other")
    height, width = image_size or fitting[0]
    if height * width != pixels:
        raise ArgumentError(f"image size = {width} x {height} has {height * width} pixels, not {pixels}")
    _check_size((height, width, bins), "a part of the image")
    whole = bool((matrix.value == np.rint(matrix.value)).all() and (np.abs(matrix.value) < 2**31).all())
    cube = np.zeros((height, width, bins), np.int32 if whole else np.float32)
    column, row = np.divmod(matrix.row, height)
    cube[row, column, matrix.column] = matrix.value
    return cube


def _of_tags(cells: NDArray[Any], unit: float, bin_width: float | None, notes: list[str]) -> _Raw:
    """Counts from the tags of each pixel `[H, W]`, whole numbers of the unit [s], from the first tag of the image to
    the last, in bins of a multiple of the unit, by default the unit."""
    step = round((width := bin_width or unit) / unit)
    if step < 1 or abs(step * unit - width) > 1e-6 * width:
        raise ArgumentError(f"bin width = {width * 1e12:g} ps is not a multiple of the tags' unit, {unit * 1e12:g} ps")
    sizes = np.array([cell.size for cell in cells.flat])
    if not sizes.any():
        raise FileError("no pixel has a time tag")
    tags = np.concatenate([cell for cell in cells.flat if cell.size])
    whole = tags.dtype.kind in "iu"
    if tags.dtype.kind == "f":  # no NaN, no inf
        whole = bool((tags == np.rint(tags)).all() and np.abs(tags).max() < 2**53)
    if not whole:
        raise FileError(f"time tags are not all whole numbers: {tags.dtype}")
    if not -(2**62) < int(tags.min()) <= int(tags.max()) < 2**62:
        raise FileError(f"time tags from {tags.min()} to {tags.max()} are beyond 2^62")
    tags = tags.astype(np.int64)
    first = int(tags.min()) // step * step
    bins = (int(tags.max()) - first) // step + 1
    wider = f"a wider bin than {step * unit * 1e12:g} ps (bin_width)"
    if bins > _MOST_BINS:
        raise ArgumentError(
            f"time tags from {tags.min()} to {tags.max()} are {bins} bins, more than {_MOST_BINS}; {wider} would help,"
            " unless a tag is wrong"
        )
    height, across = cells.shape
    _check_size((height, across, bins), wider)
    counts = np.zeros(cells.size * bins, np.int32)
    np.add.at(counts, np.repeat(np.arange(cells.size), sizes) * bins + (tags - first) // step, 1)
    text = f"time tags of {across} x {height} pixels, bins of {step * unit * 1e12:g} ps from tag {first}"
    cube = counts.reshape(height, across, bins)
    return _Raw(cube, (*notes, text), step * unit, first=first * unit, ordered=True, options=("dataset", "tag_unit"))


def stored_images(path: Path, dataset: str | None, *, several: bool) -> tuple[NDArray[Any], str] | None:
    """An image `[H, W]`, or if there may be `several` also images `[N, H, W]`, from `.npy`, `.mat` or `.h5`; None where
    the file or the dataset of that name holds histograms. Without a name: of a `.mat` without histograms the largest,
    of a `.h5` without them the only one. With it a text that names the image taken and those left; "" without a choice.

    Raises `FileError`, and `ArgumentError` where several of a `.mat` are the largest, or a `.h5` has several.
    """
    ending = path.suffix.lower()
    if ending not in _ARRAYS or is_own(path):
        return None
    with _arrays(path) as variables:
        dense = {name: one for name, one in variables.items() if one.kind == "dense"}
        name, choice = "" if ending == ".npy" and dataset is None else dataset, ""
        if name is None:
            sizes = {name: one.shape for name, one in dense.items() if math.prod(one.shape) > 1}
            holds_cubes = any(len(shape) in (3, 4) for shape in sizes.values())
            sides: tuple[int, ...] = (2,) if not holds_cubes else (3,) if several else ()
            if ending == ".mat":
                sides = () if _histograms_in(variables) and not several else (2, 3)
            found = [name for name, shape in sizes.items() if len(shape) in sides]
            most = max((math.prod(sizes[name]) for name in found), default=0)
            largest = [name for name in found if math.prod(sizes[name]) == most or ending != ".mat"]
            if len(largest) > 1:
                raise _unnamed(path, variables)
            others = ", ".join(name for name in found if name not in largest)
            name = largest[0] if largest else None
            choice = f"{name}, not {others}" if others else ""
        if name not in dense or len(dense[name].shape) not in ((2, 3) if several else (2,)):
            return None
        return np.asarray(dense[name].read()), choice


# PicoQuant's files of T3 records: images, and other scans by their markers


def _read_ptu(path: Path, image_size: tuple[int, int] | None, sum_frames: bool) -> _Raw:
    """Counts of all channels. Raises `ArgumentError` for a size that is missing or does not fit the markers."""
    import ptufile

    with ptufile.PtuFile(path) as file:
        _check_ptu(file, path)
        if file.is_image and image_size is None:
            frames, height, width, _, bins = file.shape
            _check_size((1 if sum_frames else frames, height, width, bins), "adding up the frames (sum_frames)")
            options: Any = {"frame": -1 if sum_frames or frames == 1 else None, "channel": -1}
            image = file.decode_image(**options, dtype=np.uint32, keepdims=False)
            counts, text = np.ascontiguousarray(image).view(np.int32), "pixels by the image in its header"
        else:
            counts, text = _ptu_scan(file, image_size)
        if (channels := file.number_channels) > 1:
            text += f"; {channels} channels, added up"
        notes = [text, f"{len(counts)} frames; sum_frames adds them up"][: counts.ndim - 2]
        # Time of flight at the start of bin 0, and the group index, which `spadwarp export` writes in the comment.
        comment = file.comment or "" if file.tags.get("CreatorSW_Name") == "spadwarp" else ""
        gate, water = (re.search(text, comment) for text in (r"Bin 0 begins at (\S+) ns", r"group index (\S+\d)"))
        facts = (1e-9 * float(gate[1]) if gate else None, float(water[1]) if water else None)
        return _Raw(counts, tuple(notes), float(file.tcspc_resolution), *facts, ordered=True, options=("image_size",))


def _check_ptu(file: Any, path: Path) -> None:
    """Refuses numbers of the header that its reader would compute with for minutes, and records that are not there."""
    for name in ("ImgHdr_LineStart", "ImgHdr_LineStop", "ImgHdr_Frame"):  # a marker, a power of two of it
        if not 0 <= (marker := file.tags.get(name) or 0) <= _MARKERS:
            raise FileError(f"{path}: {name} = {shown(marker)} is outside [0, {_MARKERS}], the markers of a record")
    count, size = file.tags.get("TTResult_NumberOfRecords") or 0, path.stat().st_size
    if not 4 * count <= size:
        raise FileError(f"{path}: TTResult_NumberOfRecords = {shown(count)} is more than a file of {size} bytes holds")
    if not file.is_t3:
        raise FileError(f"{path}: T2 records have no time since the pulse; T3 records are needed")
    file.cache_records = True
    if (readable := len(file.read_records())) < file.number_records:
        raise FileError(f"{path}: cut: of {file.number_records} records {readable} are there")
    if not 1e-15 < (width := float(file.tcspc_resolution)) < 1e-3:
        raise FileError(f"{path}: MeasDesc_Resolution = {width} s is outside (1e-15, 1e-3) s")


def _ptu_scan(file: Any, image_size: tuple[int, int] | None) -> tuple[NDArray[np.int32], str]:
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
    _check_size((height, width, bins), "a smaller image")
    start, text = _ptu_starts(records, marks, height, width)
    pixel = np.searchsorted(start, records["time"][photon].astype(np.float64), side="right") - 1
    inside = (pixel >= 0) & (pixel < height * width)
    counts = np.zeros(height * width * bins, np.int32)
    np.add.at(counts, pixel[inside] * bins + dtime[inside], 1)
    return counts.reshape(height, width, bins), text


def _ptu_starts(records: Any, marks: NDArray[np.intp], height: int, width: int) -> tuple[NDArray[np.float64], str]:
    """Times at which the pixels begin, and the last one ends: by the kind of marker that fits."""
    kinds = records["marker"][marks]
    times = {int(kind): records["time"][marks[kinds == kind]].astype(np.float64) for kind in np.unique(kinds)}
    lines = "a line at each marker {}, its pixels equally long"
    for pieces, text in ((height * width, "a pixel at each marker {}"), (height, lines)):
        for kind, time in times.items():
            if time.size not in (pieces, pieces + 1):
                continue
            step = float(np.median(np.diff(time))) if time.size > 1 else np.inf
            ends = np.append(time, time[-1] + step)[: pieces + 1]
            if pieces != height * width:
                start = (ends[:-1, None] + np.arange(width) / width * np.diff(ends)[:, None]).ravel()
                ends = np.append(start, ends[-1])
            return ends, text.format(kind)
    markers = ", ".join(f"{time.size} of kind {kind}" for kind, time in times.items()) or "none"
    raise ArgumentError(
        f"image size = {width} x {height}: {height * width} markers of one kind, or {height}, are needed; "
        f"the file has {markers}"
    )
