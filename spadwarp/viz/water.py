"""The water of a scene cut open, with camera, laser and targets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from numpy.typing import NDArray

from spadwarp.mesh import TriangleMesh, build_mesh
from spadwarp.scene import Scene
from spadwarp.scene.camera import to_camera, to_world
from spadwarp.scene.medium import grid_cells
from spadwarp.viz.style import BLUE, BOUND_MAP, GREEN, PAGE, new_figure, paper, save

__all__ = ["draw_slice", "draw_water"]

Floats = NDArray[np.float64]

_STEPS = 400  # of the longer side
# Without cells the densest water may be everywhere: lines and the targets must show on it.
_PALE = LinearSegmentedColormap.from_list("pale water", matplotlib.colormaps[BOUND_MAP](np.linspace(0.0, 0.16, 64)))


@paper()
def draw_water(scene: Scene, path: str | Path, mesh: TriangleMesh | None = None, *, width: float = PAGE) -> Path:
    """Draws the extinction on two planes through the optical axis, from above and from the side, into one picture.

    Args:
        scene: With or without a grid of cells.
        path: The picture.
        mesh: Of the scene, if the caller has it.
        width: Of the picture [inch].

    Raises:
        MeshError: A target that cannot be read.
        FileError: The picture cannot be written, or the cells cannot be read.
    """
    figure = new_figure(width, 0.34 * width)
    mesh = build_mesh(scene) if mesh is None else mesh
    axes = figure.subplots(1, 2)
    images = [draw_slice(axis, scene, mesh, across) for across, axis in enumerate(axes)]
    for axis, title in zip(axes, ("from above", "from the side"), strict=True):
        axis.set_title(title)
    drawn = [image.get_array().max() for image in images]
    extend = "max" if max(drawn) > images[0].norm.vmax else "neither"
    figure.colorbar(images[0], ax=axes, label="extinction [1/m]", shrink=0.7, extend=extend)
    return save(figure, path)


def draw_slice(axis: Axes, scene: Scene, mesh: TriangleMesh | None, across: int) -> Any:
    """One plane through the optical axis: z to the right, x (`across` 0) or y (1) downwards; the image drawn."""
    depth, half = _extent(scene, mesh)
    z = np.linspace(0.0, depth, _STEPS)
    side = np.linspace(-half, half, max(2, round(2.0 * half / depth * _STEPS)))
    points = np.zeros((len(side), len(z), 3))
    points[..., across], points[..., 2] = side[:, None], z
    top = max(water.extinction for water in scene.medium.waters)
    if scene.medium.grid is not None:  # but the densest cells
        top = max(top, float(np.percentile(grid_cells(scene.medium).extinction, 99.5)))
    image = axis.imshow(
        _extinction(scene, points), extent=(0.0, depth, half, -half), vmin=0.0, vmax=top, aspect="equal",
        cmap=_PALE if scene.medium.grid is None else BOUND_MAP,
    )  # fmt: skip
    camera, laser = scene.camera, scene.beam
    tangent = 0.5 * camera.pixel_tangent * (camera.width, camera.height)[across]
    axis.plot([0.0, depth], [0.0, depth * tangent], color=BLUE, lw=0.8)
    axis.plot([0.0, depth], [0.0, -depth * tangent], color=BLUE, lw=0.8, label="view")
    start, along = np.array(laser.position), np.array(laser.axis)
    for sign in (-1.0, 1.0):
        slope = along[across] / max(along[2], 1e-6) + sign * np.tan(min(laser.half_angle, 1.4))
        ends = start[across] + np.array([0.0, slope * (depth - start[2])])
        axis.plot([start[2], depth], ends, color=GREEN, lw=0.8, ls="--", label="beam" if sign > 0 else None)
    if mesh is not None:
        for ends in _section(mesh, 1 - across):
            axis.plot(ends[:, 2], ends[:, across], color="black", lw=1.2)
    axis.set_xlim(0.0, depth)
    axis.set_ylim(half, -half)
    axis.set_xlabel("z [m]")
    axis.set_ylabel("xy"[across] + " [m]")
    axis.legend(loc="upper left", fontsize=6)
    return image


def _extent(scene: Scene, mesh: TriangleMesh | None) -> tuple[float, float]:
    """Depth and half the height of the picture [m]: to the far end of the targets, or the box."""
    camera = scene.camera
    depth, half = 0.5 * scene.path_limit, 0.1
    if mesh is not None:
        depth = 1.05 * float(mesh.bounds[1][2])
    elif scene.medium.grid is not None:
        cells = grid_cells(scene.medium)
        depth = float(to_camera(camera, cells.centre)[2] + 0.6 * np.linalg.norm(cells.size))
    depth = max(depth, 0.01)
    half = max(half, 0.5 * camera.pixel_tangent * max(camera.width, camera.height) * depth)
    if scene.medium.grid is not None:
        cells = grid_cells(scene.medium)
        centre = to_camera(camera, cells.centre)
        half = max(half, float(np.abs(centre[:2]).max()) + 0.5 * max(cells.size[:2]))
    return depth, min(1.15 * half, depth)


def _extinction(scene: Scene, points: Floats) -> Floats:
    """At points of the camera frame."""
    world, medium = to_world(scene.camera, points), scene.medium
    if medium.grid is not None:
        return grid_cells(medium).at(world, medium.extinction)
    values = np.full(points.shape[:-1], medium.extinction)
    along = world @ (np.array(medium.layer_axis) / np.linalg.norm(medium.layer_axis))
    for layer in medium.layers:
        values[along >= layer.start] = layer.extinction
    return values


def _section(mesh: TriangleMesh, axis: int) -> Floats:
    """Where the faces cross the plane of a coordinate 0, `[N, 2, 3]`."""
    from trimesh import Trimesh
    from trimesh.intersections import mesh_plane

    body = Trimesh(mesh.vertices, mesh.faces, process=False)
    normal = np.eye(3)[axis]
    # Beside the middle, where edges of symmetric targets often lie.
    return np.asarray(mesh_plane(body, normal, 1e-4 * normal), np.float64).reshape(-1, 2, 3)
