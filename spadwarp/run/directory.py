"""The directory of a run: its result, scene, depth, truth and pictures, while it is not finished its checkpoint."""

from __future__ import annotations

import itertools
import secrets
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import FileError
from spadwarp.frames import detector_response
from spadwarp.io.atomic import atomic_path, remove_temporaries
from spadwarp.io.paths import file_within
from spadwarp.parallel import Forked
from spadwarp.result import Result, load_result, save_depth_exr, save_truth_maps
from spadwarp.result.file import read_head
from spadwarp.scene import Scene

__all__ = ["CHECKPOINT", "RUN_FILES", "RunFiles", "bytes_needed", "load_resumable", "remove_checkpoint"]
__all__ += ["write_run"]

CHECKPOINT = "checkpoint.h5"
"""Name of the partial result of an unfinished run."""

_PICTURES = tuple(
    f"{name}.{ending}" for name in ("depth", "intensity", "histogram", "truth") for ending in ("png", "pdf")
)
RUN_FILES = ("result.h5", "records.h5", "scene.toml", "depth.exr", "truth.exr", CHECKPOINT, *_PICTURES)
"""Names of all files that the directory of a run may have."""

_RECORD_BYTES = 52  # of one photon's terminal state, id included
_OTHER_BYTES = 16 << 20  # pictures, maps, text


@dataclass(frozen=True, eq=False)
class RunFiles:
    """The files of a run.

    Attributes:
        written: Their paths.
        depth: Depth frame [m], float64 `[H, W]`, by `output.depth_method`; NaN where nothing returned.
    """

    written: list[Path]
    depth: NDArray[np.float64]


def write_run(result: Result, out: str | Path, *, device: str | None = None, keep: Sequence[str] = ()) -> RunFiles:
    """Writes the files that a result's `[output]` asks for to a directory, its pictures by other processes (Linux).

    result.h5, scene.toml, depth.exr, truth.exr, and depth, intensity, histogram and truth as PNG and PDF. Files of
    these names that an earlier run has left, its checkpoint and records included, are removed.

    Args:
        result: From `spadwarp.simulate` or `spadwarp.merge`.
        out: The directory, made if it is not there.
        device: Warp device for the depth frame.
        keep: Names of earlier files that are not removed.

    Raises:
        FileError: A file cannot be written; a result that does not fit goes to the folder for temporary files instead,
            which the text names.
    """
    folder, scene, output = Path(out), result.scene, result.scene.output
    written: list[Path] = []
    try:
        depth = _depth(result, device)
        calls = _pictures(result, folder, depth)
    except BaseException:
        if output.result:  # photons must not be lost
            _save(result, folder / "result.h5")
        raise
    try:
        with Forked(calls) as pictures:
            if output.result:
                written.append(_save(result, folder / "result.h5"))
            with atomic_path(folder / "scene.toml") as temporary:
                temporary.write_text(scene.to_toml(folder=folder), encoding="utf-8")
            written.append(folder / "scene.toml")
            if output.exr:
                written.append(save_depth_exr(result, depth, folder / "depth.exr"))
                written.append(save_truth_maps(result, folder / "truth.exr"))
            written += itertools.chain.from_iterable(pictures.results())
    finally:
        for name in _PICTURES:  # of processes that were ended
            remove_temporaries(folder / name)
    remove_checkpoint(folder)
    for name in set(RUN_FILES) - set(keep) - {path.name for path in written}:
        (folder / name).unlink(missing_ok=True)
    return RunFiles(written, depth)


def _depth(result: Result, device: str | None) -> NDArray[np.float64]:
    scene, method = result.scene, result.scene.output.depth_method
    options: dict[str, Any] = {}
    if method in ("matched", "likelihood"):
        options["irf"] = detector_response(scene.detector, scene.laser)
    return result.depth(method=method, device=device, **options)


def _pictures(result: Result, folder: Path, depth: NDArray[np.float64]) -> list[Callable[[], list[Path]]]:
    output = result.scene.output
    if not (formats := [ending for ending in ("png", "pdf") if getattr(output, ending)]):
        return []
    # The whole room: a copy of this process would wait for ever for what another thread still imports.
    from spadwarp.viz import picture_calls

    return picture_calls(result, folder, depth=depth, method=output.depth_method, formats=formats)


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
    checkpoint, result = files
    try:
        heads = read_head(checkpoint), read_head(result)
        if heads[0].is_of_run(heads[1]) and heads[1].photons >= heads[0].photons:
            files = [result, checkpoint]
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


def bytes_needed(
    scene: Scene, *, batches: bool = False, records: bool = False, checkpoint: bool = False, derivatives: int = 0
) -> int:
    """Upper bound of what a run with so many derivatives writes [bytes]; compression takes off most of it."""
    signed = derivatives + len(scene.camera.tallied_channels)
    tallies = (1 + signed) * (5 if batches else 3) * 8 * scene.camera.width * scene.camera.height * scene.gate.bins
    photons = scene.transport.photons if records else 0
    return (2 if checkpoint else 1) * tallies + _OTHER_BYTES + _RECORD_BYTES * photons
