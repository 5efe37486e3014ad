"""The files of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from spadwarp.io import write_text
from spadwarp.io.atomic import atomic_path

if TYPE_CHECKING:
    from spadwarp.inverse import Fit, Unknown

__all__ = ["fit_files", "write_fit"]


def fit_files(unknowns: Sequence[Unknown]) -> list[str]:
    """Names of the files that `write_fit` writes for these unknowns."""
    maps = [_file_name(one.name) for one in unknowns if one.per_pixel]
    return ["fit.png", "scene.toml", *(f"{name}{ending}.npy" for name in maps for ending in ("", "_error"))]


def write_fit(fit: Fit, directory: str | Path) -> list[Path]:
    """Writes `fit.png` (counts, fit, residuals), `scene.toml` (with the estimates), and of each unknown of the pixels
    its map and standard error, `NAME.npy` and `NAME_error.npy`, float64 `[H, W]`; returns the paths.

    Raises `FileError`.
    """
    from spadwarp.viz import draw_fit

    folder = Path(directory)
    written = [draw_fit(fit, folder / "fit.png"), write_text(fit.scene.to_toml(folder=folder), folder / "scene.toml")]
    for one in fit.maps.values():
        for ending, array in (("", one.value), ("_error", one.standard_error)):
            path = folder / f"{_file_name(one.name)}{ending}.npy"
            with atomic_path(path) as temporary, temporary.open("wb") as file:
                np.save(file, array)
            written.append(path)
    return written


def _file_name(name: str) -> str:
    """`targets[0].reflectance` as `targets_0_reflectance`."""
    return name.replace("[", "_").replace("].", "_").replace(".", "_")
