"""A scene's grid of cells as the kernels take it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.scene import Scene
from spadwarp.scene.camera import to_camera
from spadwarp.scene.medium import grid_cells
from spadwarp.scene.pose import rotation_matrix

if TYPE_CHECKING:
    import warp as wp

__all__ = ["grid_layers", "grid_tracking"]

# Regular tracking is the faster one up to about this many cells.
_MOST_REGULAR_CELLS = 32**3


def grid_tracking(scene: Scene) -> Any:
    """How photons fly through the cells; None without a grid."""
    import spadwarp_kernels as sk

    grid = scene.medium.grid
    if grid is None:
        return None
    regular = grid.tracking == "regular"
    if grid.tracking == "auto":
        regular = grid_cells(scene.medium).extinction.size <= _MOST_REGULAR_CELLS
    return sk.REGULAR_TRACKING if regular else sk.DELTA_TRACKING


def grid_layers(scene: Scene, device: wp.Device) -> Any:
    """The grid on a device, in the camera's frame."""
    import spadwarp_kernels as sk

    cells, camera = grid_cells(scene.medium), scene.camera
    layers = sk.Layers()
    layers.grid = sk.make_grid(
        cells.extinction,
        np.clip(cells.albedo, 0.0, 1.0),
        cells.anisotropy,
        size=cells.size,
        centre=tuple(to_camera(camera, cells.centre).tolist()),
        rotation=rotation_matrix(camera.rotation_deg).T @ cells.rotation,
        device=device,
    )
    return layers
