"""The directory of a run, with its checkpoint while it is not finished; the files of depth and of a fit."""

from __future__ import annotations

import secrets
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.frames import Reduction, detector_response
from spadwarp.io.arrays import point_cloud, write_array, write_exr, write_ply
from spadwarp.io.paths import file_within, remove_temporaries, write_file
from spadwarp.io.text import write_text
from spadwarp.parallel import Forked
from spadwarp.result import Result, load_result, save_depth_exr, save_truth_maps
from spadwarp.result.file import difference, read_head
from spadwarp.scene import Scene
from spadwarp.scene.camera import to_world
from spadwarp.scene.pose import rotation_matrix
from spadwarp.transport import Spectrum
from spadwarp.values import ArgumentError, FileError, check_choice

if TYPE_CHECKING:
    from spadwarp.inverse import Fit, Unknown

__all__ = ["CHECKPOINT", "RUN_FILES", "RunFiles", "bytes_needed", "fit_files", "load_resumable", "remove_checkpoint"]
__all__ += ["line_folder", "write_depth", "write_fit", "write_run", "write_spectrum"]

CHECKPOINT = "checkpoint.h5"
"""Name of the partial result of an unfinished run."""

_KINDS, _ENDINGS = ("depth", "intensity", "histogram", "truth", "flux"), ("png", "pdf")
_PICTURES = tuple(f"{name}.{ending}" for name in _KINDS for ending in _ENDINGS)
RUN_FILES = ("result.h5", "records.h5", "scene.toml", "depth.exr", "truth.exr", CHECKPOINT, *_PICTURES)
"""Names of all files that the directory of a run may have."""

_RECORD_BYTES = 52  # of one photon's terminal state, id included
_OTHER_BYTES = 16 << 20  # pictures, maps, text
_POINT_FRAMES = {
    "camera": "camera: origin in the lens, +x right, +y down, +z forward",
    "world": "world: the axes of a camera without a pose",
}


class _Pictures:
    @staticmethod
    def plot(result: Result, folder: Path, **options: Any) -> list[Path]:
        """Draws the pictures of a run; returns their paths."""
        import spadwarp

        return spadwarp.viz.draw_result(result, folder, **options)


@dataclass(frozen=True, eq=False)
class RunFiles:
    """The files of a run."""

    written: list[Path]  # their paths
    depth: NDArray[np.float64]  # depth frame [m] `[H, W]`, by `output.depth_method`; NaN where nothing returned


def write_run(result: Result, out: str | Path, *, device: str | None = None, keep: Sequence[str] = ()) -> RunFiles:
    """Writes the files that a result's `[output]` asks for to a directory, its pictures by other processes (Linux).

    result.h5, scene.toml, depth.exr, truth.exr, and depth, intensity, histogram and truth as PNG and PDF. Files of
    these names that an earlier run has left, its checkpoint and records included, are removed.

    Args:
        result: From `spadwarp.simulate` or `spadwarp.merge`.
        out: The directory, made if it is not there.
        device: Warp device for the depth frame.
        keep: Names of earlier files that are not removed.

    Raises `FileError`: a file cannot be written; a result that does not fit goes to the folder for temporary files
    instead, which the text names.
    """
    folder, scene, output = Path(out), result.scene, result.scene.output
    written: list[Path] = []
    try:
        method, options = output.depth_method, dict[str, Any]()
        if method in ("matched", "likelihood"):
            options["irf"] = detector_response(scene.detector, scene.laser)
        depth = result.depth(method=method, device=device, **options)
        calls = _pictures(result, folder, depth)
    except BaseException:
        if output.result:  # photons must not be lost
            _save(result, folder / "result.h5")
        raise
    try:
        with Forked(calls) as pictures:
            if output.result:
                written.append(_save(result, folder / "result.h5"))
            written.append(write_text(scene.to_toml(folder=folder), folder / "scene.toml"))
            if output.exr:
                written.append(save_depth_exr(result, depth, folder / "depth.exr"))
                written.append(save_truth_maps(result, folder / "truth.exr"))
            written += [path for paths in pictures.results() for path in paths]
    finally:
        for name in _PICTURES:  # of processes that were ended
            remove_temporaries(folder / name)
    remove_checkpoint(folder)
    for name in set(RUN_FILES) - set(keep) - {path.name for path in written}:
        (folder / name).unlink(missing_ok=True)
    return RunFiles(written, depth)


def _pictures(result: Result, folder: Path, depth: NDArray[np.float64]) -> list[Callable[[], list[Path]]]:
    output = result.scene.output
    formats = [ending for ending in _ENDINGS if getattr(output, ending)]
    draw = partial(_Pictures.plot, result, folder, depth=depth, method=output.depth_method, formats=formats)
    kinds: tuple[str, ...] = _KINDS[:-1] if result.scene.transport.estimator != "none" else ()
    kinds += _KINDS[-1:] if result.scene.flux else ()
    return [partial(draw, kinds=(kind,)) for kind in kinds] if formats else []


def line_folder(out: str | Path, wavelength: float) -> Path:
    """The directory of the run of one wavelength [nm] in that of several."""
    return Path(out) / f"{wavelength:.9g}nm"


def write_spectrum(spectrum: Spectrum, out: str | Path, *, device: str | None = None) -> list[Path]:
    """Writes runs at several wavelengths to a directory: spectrum.h5, all histograms and depths with an axis of
    wavelength, and spectrum.png; returns the paths.

    Of the lines of the laser's spectrum also the files of `write_run` of their sum, in the same directory; of
    wavelengths of one's own, or with flux, or after an interrupt those of each, in directories such as `532nm`. Raises
    `FileError`.
    """
    written, folder = list[Path](), Path(out)
    if spectrum.scene.laser.wavelengths_nm == "spectrum" and not (spectrum.partial or spectrum.scene.flux):
        written += write_run(spectrum.combined(), folder, device=device).written
        depth = {line: one.depth(device=device) for line, one in spectrum.results.items()}
    else:
        depth = {}
        for line, one in spectrum.results.items():
            files = write_run(one, line_folder(folder, line), device=device)
            written, depth[line] = written + files.written, files.depth
    written.append(spectrum.save(folder / "spectrum.h5", depth=depth))
    if spectrum.scene.output.png:
        written.append(spectrum.plot(folder / "spectrum.png", depth=depth))
    return written


def _save(result: Result, path: Path) -> Path:
    """Saves the result, if need be elsewhere: a full disk must not cost hours of photons."""
    try:
        return result.save(path)
    except FileError as error:
        refuge = Path(tempfile.gettempdir()) / f"spadwarp-{secrets.token_hex(8)}-result.h5"
        result.save(refuge)
        raise FileError(f"{error}\n{refuge}: the result is here instead") from error


def load_resumable(path: str | Path) -> tuple[Result, Path]:
    """The result to resume and its file: of a directory its result or its checkpoint.

    Of one run that which has more photons, whatever the clock said when they were written; of two runs the checkpoint,
    since the result is then an earlier one that the unfinished run replaces. Where one cannot be read, the other, with
    a warning. Raises `FileError`.
    """
    folder = Path(path)
    files = [file for name in (CHECKPOINT, "result.h5") if (file := folder / name).is_file()]
    if len(files) < 2:
        file = files[0] if files else file_within(folder, ("result.h5",))
        return load_result(file), file
    try:
        checkpoint, result = map(read_head, files)
        one_run = not difference(checkpoint, result) and checkpoint.requested[0] == result.requested[0]
        if one_run and result.photons >= checkpoint.photons:
            files.reverse()
        return load_result(files[0]), files[0]
    except FileError as error:
        for file in files:
            with suppress(FileError):
                earlier = load_result(file)
                warnings.warn(f"{error}; {file} is resumed instead", RuntimeWarning, stacklevel=2)
                return earlier, file
        raise


def remove_checkpoint(out: str | Path) -> None:
    """Removes the checkpoint of a directory, and the parts of one that a killed run has left."""
    path = Path(out) / CHECKPOINT
    path.unlink(missing_ok=True)
    remove_temporaries(path)


def bytes_needed(scene: Scene, *, records: bool = False, checkpoint: bool = False, derivatives: int = 0) -> int:
    """Upper bound of what a run with so many derivatives writes [bytes]; compression takes off most of it."""
    signed = derivatives + len(scene.tallied_channels)
    # Tallies and squares by bin; of light the tallies of one half of the photons, and its reconstruction in float32.
    tallies = (10 + 5 * signed) * 8 * scene.camera.width * scene.camera.height * scene.gate.bins
    photons = scene.transport.photons if records and scene.transport.photons != "auto" else 0
    return (2 if checkpoint else 1) * tallies + _OTHER_BYTES + _RECORD_BYTES * photons


# Depth


def write_depth(
    reduction: Reduction,
    directory: str | Path,
    *,
    ply: str | Path | None = None,
    ply_frame: Literal["camera", "world"] = "camera",
    comment: str = "",
) -> list[Path]:
    """Writes `depth.npy` (all frames, float32), `depth.exr` and `depth.png` (the first); returns the paths. Of counts
    also `significance.npy`.

    Without a field of view the names begin with `range`. `ply`: the points of the first frame, with normals and
    intensity, in the frame `ply_frame`, which a comment of the file names.

    Raises `ArgumentError`: a point cloud was asked for and the field of view is not known, or in the world where the
    camera's pose is not known; `FileError`: a file cannot be written.
    """
    check_choice("ply_frame", ply_frame, tuple(_POINT_FRAMES))
    if ply is not None and reduction.lines is None:
        raise ArgumentError("a point cloud needs the horizontal field of view (horizontal_fov_deg)")
    if ply is not None and ply_frame == "world" and reduction.camera is None:
        raise ArgumentError("points in the world need the pose of the camera: those of a measurement are in its frame")
    folder, name = Path(directory), reduction.quantity
    array = reduction.values.astype(np.float32)
    channels = {"range": reduction.range[0], "intensity": reduction.intensity[0].astype(np.float32)}
    if name == "depth":
        channels["Z"] = reduction.first
    metadata = {"content": "measured depth", "method": reduction.method, "frame": "+x right, +y down, +z forward"}
    written = [
        write_array(folder / f"{name}.npy", array if reduction.frames > 1 else array[0]),
        write_exr(folder / f"{name}.exr", channels, metadata),
        reduction.plot(folder / f"{name}.png", quantity=name, title=f"{name.capitalize()} ({reduction.method})"),
    ]
    if (found := reduction.significance) is not None:
        written.append(write_array(folder / "significance.npy", found if reduction.frames > 1 else found[0]))
    return written if ply is None else [*written, _write_points(reduction, ply, ply_frame, comment)]


def _write_points(reduction: Reduction, path: str | Path, frame: str, comment: str) -> Path:
    assert reduction.lines is not None
    distance = reduction.range[0]
    points: Any
    normals: Any
    points, normals = point_cloud(distance, reduction.lines.directions_to(distance))
    if not len(points):
        raise FileError(f"{path}: nothing returned in any pixel: there are no points to write")
    if frame == "world":
        assert reduction.camera is not None
        points = to_world(reduction.camera, points)
        normals = normals @ rotation_matrix(reduction.camera.rotation_deg).T
    columns = dict(zip(("x", "y", "z", "nx", "ny", "nz"), (*points.T, *normals.T), strict=True))
    columns["intensity"] = reduction.intensity[0][np.isfinite(distance)]
    return write_ply(path, columns, comment=f"{comment}; frame {_POINT_FRAMES[frame]}")


# A fit


def fit_files(unknowns: Sequence[Unknown]) -> list[str]:
    """Names of the files that `write_fit` writes for these unknowns."""
    maps = [_file_name(unknown.name) for unknown in unknowns if unknown.per_pixel]
    return ["fit.png", "scene.toml", *(f"{name}{ending}.npy" for name in maps for ending in ("", "_error"))]


def write_fit(fit: Fit, directory: str | Path) -> list[Path]:
    """Writes `fit.png` (counts, fit, residuals), `scene.toml` (with the estimates), and of each unknown of the pixels
    its map and standard error, `NAME.npy` and `NAME_error.npy`, float64 `[H, W]`; returns the paths.

    Raises `FileError`.
    """
    folder = Path(directory)
    written = [write_file(folder / "fit.png", partial(fit.plot().savefig, format="png"))]
    written.append(write_text(fit.scene.to_toml(folder=folder), folder / "scene.toml"))
    for estimate in fit.maps.values():
        name = _file_name(estimate.name)
        written += [write_array(folder / f"{name}.npy", estimate.value)]
        written += [write_array(folder / f"{name}_error.npy", estimate.standard_error)]
    return written


def _file_name(name: str) -> str:
    """`targets[0].reflectance` as `targets_0_reflectance`."""
    return name.replace("[", "_").replace("].", "_").replace(".", "_")
