"""Histograms from files: those that spadwarp wrote, and measured ones (`.npy`, `.mat`, `.ptu`)."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import FileError, SpadwarpError
from spadwarp.frames.file import FramesFile, is_frames_file
from spadwarp.frames.response import InstrumentResponse, detector_response
from spadwarp.io.npy import read_npy
from spadwarp.io.paths import existing_file
from spadwarp.result.file import load_result

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["ENDINGS", "Histograms", "read_array", "read_histograms"]

ENDINGS = (".h5", ".npy", ".mat", ".ptu")


@dataclass(frozen=True, eq=False, kw_only=True)
class Histograms:
    """Histograms with what the file knows about them.

    Attributes:
        values: `[H, W, T]` or `[frames, H, W, T]`, not negative.
        bin_width: [s]; None where the file does not hold it.
        gate_start: Time of flight at the lower edge of bin 0 [s].
        background: Expected background in the unit of `values`, of a shape that `arrival_time` takes, or None.
        irf: The response that the histograms contain; None: unknown, or none.
        response: The response to filter with; differs from `irf` for expected histograms of infinitely short pulses.
        scene: Of a simulation, else None.
    """

    values: NDArray[Any]
    bin_width: float | None = None
    gate_start: float = 0.0
    background: NDArray[np.float32] | None = None
    irf: InstrumentResponse | None = None
    response: InstrumentResponse | None = None
    scene: Scene | None = None


def read_histograms(path: str | Path, *, variable: str | None = None) -> Histograms:
    """Reads histograms; the ending of the file says which kind of file it is.

    `.h5`: a result or frames of spadwarp. `.npy`: `[H, W, T]` or `[frames, H, W, T]`. `.mat`: such an array in a file
    of MATLAB, version 7.3 included. `.ptu`: a T3 image of PicoQuant, frames and channels added up; its bins count from
    the sync, or from the start of the gate that `spadwarp export` wrote in its comment.

    Args:
        path: The file.
        variable: Name of the array in a `.mat` file; default: the largest of three or four dimensions.

    Raises:
        FileError: No such file, not readable, of an unknown kind, without such an array, or with values that are
            negative or not finite; a package that is needed to read it is not installed.
    """
    path = existing_file(path)
    readers: dict[str, Callable[[Path], Histograms]] = {
        ".h5": _read_own,
        ".npy": lambda path: Histograms(values=read_array(path)),
        ".mat": lambda path: Histograms(values=read_array(path, variable)),
        ".ptu": _read_ptu,
    }
    if path.suffix.lower() not in readers:
        raise FileError(f"{path}: ending {path.suffix!r} is not one of {', '.join(ENDINGS)}")
    try:
        read = readers[path.suffix.lower()](path)
    except SpadwarpError:
        raise
    except ModuleNotFoundError as error:
        raise FileError(f"{path}: reading it needs {error.name}: pip install 'spadwarp[formats]'") from error
    except Exception as error:  # what a reader raises depends on the format
        raise FileError(f"{path}: damaged or not readable: {error}") from error
    _check(read.values, path)
    return read


def _check(values: NDArray[Any], path: Path) -> None:
    if values.ndim not in (3, 4) or values.size == 0 or values.dtype.kind not in "biuf":
        raise FileError(
            f"{path}: {values.dtype} {values.shape}; real numbers [H, W, T] or [frames, H, W, T] are needed"
        )
    if values.dtype.kind == "f" and np.isnan(values).any():
        raise FileError(f"{path}: holds NaN, as depth does; histograms are finite and not negative")
    if values.dtype.kind in "if" and not (values.min() >= 0 and math.isfinite(values.max())):
        raise FileError(f"{path}: holds {values.min()} … {values.max()}; finite values, not negative, are needed")


def _read_own(path: Path) -> Histograms:
    if is_frames_file(path):
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
    result = load_result(path)
    scene = result.scene
    return Histograms(
        values=result.histogram,
        bin_width=scene.gate.bin_width,
        gate_start=scene.gate.start,
        background=result.component("backscatter").astype(np.float32),
        response=detector_response(scene.detector, scene.laser),
        scene=scene,
    )


def read_array(path: Path, variable: str | None = None, *, dimensions: Sequence[int] = (3, 4)) -> NDArray[Any]:
    """The array of a `.npy` file, or one of a `.mat` file: `variable`, else the largest of so many dimensions.

    Raises `FileError` for a `.mat` without such an array, and what the reader of the format raises.
    """
    if path.suffix.lower() == ".npy":
        return read_npy(path)
    import h5py

    if h5py.is_hdf5(path):  # MATLAB 7.3
        with h5py.File(path, "r") as file:
            # MATLAB lays arrays out column by column: to others their dimensions are reversed.
            shapes = {name: item.shape[::-1] for name, item in file.items() if isinstance(item, h5py.Dataset)}
            return file[_chosen(path, shapes, variable, dimensions)][...].T
    from scipy.io import loadmat, whosmat

    shapes = {name: shape for name, shape, kind in whosmat(path) if kind not in ("char", "cell", "struct")}
    name = _chosen(path, shapes, variable, dimensions)
    return np.asarray(loadmat(path, variable_names=[name], spmatrix=False)[name])


def _chosen(path: Path, shapes: dict[str, tuple[int, ...]], variable: str | None, dimensions: Sequence[int]) -> str:
    listed = ", ".join(f"{name} {shape}" for name, shape in shapes.items()) or "nothing"
    if variable is not None:
        if variable not in shapes:
            raise FileError(f"{path}: no array {variable!r}; it holds {listed}")
        return variable
    found = {name: shape for name, shape in shapes.items() if len(shape) in dimensions and math.prod(shape) > 1}
    if not found:
        raise FileError(f"{path}: no array of {' or '.join(map(str, dimensions))} dimensions; it holds {listed}")
    return max(found, key=lambda name: math.prod(found[name]))


def _read_ptu(path: Path) -> Histograms:
    import ptufile

    with ptufile.PtuFile(path) as file:
        if not file.is_t3 or not file.is_image:
            raise FileError(f"{path}: not a T3 image; {file.measurement_mode.name}, {file.measurement_submode.name}")
        image = file.decode_image(frame=-1, channel=-1, dtype=np.uint32, keepdims=False)
        width = float(file.tcspc_resolution)
        start = _own_gate(file)
    if image.ndim == 2:  # a line scan
        image = image[None]
    return Histograms(values=np.ascontiguousarray(image), bin_width=width, gate_start=start)


def _own_gate(file: Any) -> float:
    """Time of flight at the start of bin 0 [s] as `spadwarp export` writes it in the comment; 0 for other writers."""
    if file.tags.get("CreatorSW_Name") != "spadwarp":
        return 0.0
    found = re.search(r"Bin 0 begins at (\S+) ns of flight", file.comment or "")
    return 1e-9 * float(found[1]) if found else 0.0
