"""Scenes whose grid has other coefficients, block by block."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError
from spadwarp.scene.grid import Grid
from spadwarp.scene.medium import grid_cells

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["with_block_means"]

Floats = NDArray[np.float64]


def with_block_means(scene: Scene, means: Mapping[str, Floats], folder: Path) -> Scene:
    """The scene with other cells: the same addition to all of a block, so that its mean is the one given.

    Args:
        scene: With a grid, divided into blocks as `simulate` divides it.
        means: By "absorption" and "scattering", or by "extinction" at fixed albedo, `[x, y, z]` [1/m].
        folder: For the file of the cells, without which the scene is of no use.

    Raises `ArgumentError` where cells would be negative.
    """
    cells = grid_cells(scene.medium)
    extinction, albedo = cells.extinction.astype(np.float64), cells.albedo.astype(np.float64)
    arrays: dict[str, Any]
    if "extinction" in means:
        if len(means) > 1:
            raise ArgumentError("medium.grid.extinction goes without medium.grid.absorption and medium.grid.scattering")
        arrays = {"extinction": _moved("extinction", extinction, means["extinction"]), "albedo": albedo}
    else:
        own = {"absorption": extinction * (1.0 - albedo), "scattering": extinction * albedo}
        arrays = {kind: _moved(kind, values, means[kind]) if kind in means else values for kind, values in own.items()}
    if cells.anisotropy is not None:
        arrays["anisotropy"] = cells.anisotropy
    path = folder / "cells.npz"
    np.savez(path, size=cells.size, **arrays)
    old = scene.medium.grid
    assert old is not None
    place: dict[str, Any] = {"translation": cells.centre, "rotation_deg": old.rotation_deg, "tracking": old.tracking}
    grid = Grid(file=str(path), **place)
    return scene.model_copy(update={"medium": scene.medium.model_copy(update={"grid": grid})})


def _moved(kind: str, cells: Floats, means: Floats) -> Floats:
    shape = [n for count, along in zip(means.shape, cells.shape, strict=True) for n in (count, along // count)]
    blocks = cells.reshape(shape)
    step = means[:, None, :, None, :, None] - blocks.mean(axis=(1, 3, 5), keepdims=True)
    moved = (blocks + step).reshape(cells.shape)
    if not moved.min() >= 0.0:
        worst = float(moved.min())
        raise ArgumentError(
            f"medium.grid.{kind}: the means of the blocks make cells of {worst:.3g} 1/m, outside [0, inf)"
        )
    return moved
