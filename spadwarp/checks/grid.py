"""Water that varies: where its box lies, and what light loses in it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from spadwarp.checks.message import CheckMessage, note, warning
from spadwarp.checks.survey import Survey
from spadwarp.scene import Scene
from spadwarp.scene.camera import to_camera
from spadwarp.scene.grid import GridCells
from spadwarp.scene.medium import grid_cells
from spadwarp.scene.sight import beam_planes, view_planes

__all__ = ["check_grid", "grid_summary"]


def check_grid(survey: Survey) -> Iterator[CheckMessage]:
    """Findings about the cells of `medium.grid`."""
    scene = survey.scene
    if scene.medium.grid is None:
        return
    cells = grid_cells(scene.medium)
    reach = 0.5 * scene.path_limit
    if _misses(scene, cells):
        text = "lies beside the view and the beam: single scattering does not show it"
        yield warning("medium.grid", text)
    else:
        begin, end = (0.0, 0.0, 0.0), (0.0, 0.0, survey.distance or reach)
        depth, without = scene.optical_depth(begin, end), scene.medium.extinction * end[2]
        where = "to the target's range" if survey.distance is not None else "to the end of the gate"
        text = f"optical depth along the axis {where} ({end[2]:.4g} m): {depth:.3g} one way, {without:.3g} without it"
        yield note("medium.grid", text, optical_depth=depth, without_grid=without)
    thickest = float(cells.extinction.max()) * max(
        edge / count for edge, count in zip(cells.size, cells.extinction.shape, strict=True)
    )
    if thickest > 1.0:
        text = f"a cell has an optical depth of up to {thickest:.3g} and does not resolve what varies in it; take more"
        yield warning("medium.grid.cells", text, cell_optical_depth=thickest)


def _misses(scene: Scene, cells: GridCells) -> bool:
    """Whether one plane of the view, and one of the beam, has the whole box behind it."""
    half = 0.5 * np.array(cells.size)
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    corners = to_camera(scene.camera, (signs * half) @ cells.rotation.T + cells.centre)

    def behind(planes: Any) -> bool:
        return bool(((corners @ planes[:, :3].T + planes[:, 3]) < 0.0).all(axis=0).any())

    beam = beam_planes(scene.beam) if scene.scan_positions == 1 else view_planes(scene.camera)
    return behind(view_planes(scene.camera)) and behind(beam)


def grid_summary(scene: Scene) -> dict[str, Any] | None:
    """Numbers of the cells: counts, edges [m], least and largest extinction [1/m], memory on a device [bytes], and the
    optical depth on the axis through the whole box, one way; None without a grid."""
    if scene.medium.grid is None:
        return None
    cells = grid_cells(scene.medium)
    centre = to_camera(scene.camera, cells.centre)
    reach = float(centre[2]) + math.hypot(*cells.size)
    return {
        "cells": list(cells.extinction.shape),
        "size": list(cells.size),
        "extinction": [float(cells.extinction.min()), float(cells.extinction.max())],
        "optical_depth": scene.optical_depth((0.0, 0.0, 0.0), (0.0, 0.0, max(reach, 0.0))),
        "bytes": cells.extinction.size * (8 if cells.anisotropy is None else 12),
    }
